"""The files that a URDF names, and files that are no URDF."""

import json
import struct

import numpy as np
import pytest
from urdfs import ARM, BALL, inertial, joint, link, robot, shape

from planner import Mechanism, PlannerError
from planner.model.mjcf.model_index import compile_model
from planner.model.urdf.meshes import MAX_FACES, hull, mesh_triangles, on_grid, stl
from planner.model.urdf.parse import robot_of
from planner.model.urdf.shapes import packages_of
from planner.model.urdf.write import mjcf_of

CORNERS = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.3]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
TETRAHEDRON = CORNERS[FACES]


def with_mesh(file, kinds=("visual", "collision"), more=""):
    shapes = (shape(kind, f'<mesh filename="{file}" {more}/>') for kind in kinds)
    return robot(link("a"), link("b", inertial(), *shapes), joint("j", "a", "b"))


def written(urdf, path, *package_path):
    read = robot_of(urdf, "the model")
    text, files = mjcf_of(read, packages_of(path, package_path, read.meshdir), "the model")
    return compile_model(text, files), files


@pytest.mark.parametrize(
    ("file", "place"),
    [
        ("package://arm_description/meshes/m.stl", "ws/arm_description/meshes/m.stl"),  # the URDF's own package
        ("package://other/m.stl", "ws/other/m.stl"),  # one beside it
        ("package://gone/meshes/m.stl", "ws/arm_description/meshes/m.stl"),  # in a folder of another name
        ("model://arm_description/m.stl", "ws/arm_description/m.stl"),
        ("m.stl", "ws/arm_description/urdf/m.stl"),
        ("../meshes/m%20m.stl", "ws/arm_description/meshes/m%20m.stl"),
        ("package://far/m.stl", "elsewhere/far/m.stl"),  # below the folder of package_path
        ("package://elsewhere/m.stl", "elsewhere/m.stl"),  # package_path is the package
    ],
)
def test_files_are_found(file, place, tmp_path):
    (tmp_path / place).parent.mkdir(parents=True)
    (tmp_path / place).write_bytes(stl(TETRAHEDRON))
    urdf = tmp_path / "ws" / "arm_description" / "urdf" / "arm.urdf"
    urdf.parent.mkdir(parents=True, exist_ok=True)
    model, _ = written(with_mesh(file), urdf, str(tmp_path / "elsewhere"))
    assert model.ngeom == 2


def test_file_addresses_are_paths(tmp_path):
    (tmp_path / "a b.stl").write_bytes(stl(TETRAHEDRON))
    model, _ = written(with_mesh(f"file://{tmp_path}/a%20b.stl"), None)
    assert model.ngeom == 2


def test_missing_meshes_are_left_out_and_said(tmp_path):
    path = tmp_path / "arm.urdf"
    (tmp_path / "m.ply").write_text("ply")
    both = with_mesh("gone.stl", ("visual", "visual", "collision")).replace(
        "</link>", shape("collision", '<mesh filename="m.ply"/>') + shape("visual", BALL) + "</link>"
    )
    path.write_text(both)
    m = Mechanism.from_urdf(path, contacts="off")
    assert [phrase for phrase in m.ignored if "mesh" in phrase][:2] == [
        "the collision mesh 'm.ply' of link 'a' (.ply is not read, expected .stl, .obj, .dae, .glb)",
        "the collision mesh 'gone.stl' of link 'b' (there is no such file)",
    ]
    assert "1 visual mesh (e.g. 'gone.stl': there is no such file)" in m.ignored
    with pytest.raises(PlannerError, match="package_path is 'nowhere', expected a folder"):
        Mechanism.from_urdf(path, package_path="nowhere")


def test_shapes_that_touch_are_drawn_where_a_link_has_no_others(tmp_path):
    (tmp_path / "m.stl").write_bytes(stl(TETRAHEDRON))
    for kinds, groups in ((("visual", "collision"), [2, 3]), (("collision",), [2])):
        model, _ = written(with_mesh("m.stl", kinds), tmp_path / "arm.urdf")
        assert list(model.geom_group) == groups
        assert [bool(kind) for kind in model.geom_contype] == [kind == "collision" for kind in kinds]


def dae(place="", unit="1", faces=FACES):
    numbers, indices = " ".join(map(str, CORNERS.ravel())), " ".join(f"{i} 0" for i in faces.ravel())
    return f"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
      <asset><unit meter="{unit}"/><up_axis>Y_UP</up_axis></asset><library_geometries><geometry id="g"><mesh>
      <source id="p"><float_array id="pa" count="12">{numbers}</float_array><technique_common>
      <accessor source="#pa" count="4" stride="3"/></technique_common></source>
      <source id="n"><float_array id="na" count="3">0 0 1</float_array></source>
      <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
      <polylist count="4"><input semantic="VERTEX" source="#v" offset="0"/>
      <input semantic="NORMAL" source="#n" offset="1"/><vcount>3 3 3 3</vcount><p>{indices}</p></polylist>
      </mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s">
      <node>{place}<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes></COLLADA>""".encode()


def glb(**node):
    points, indices = CORNERS.astype("<f4").tobytes(), FACES.astype("<u2").tobytes()
    scene = {
        "nodes": [{"children": [1]}, {"mesh": 0, **node}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
                      {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"}],
        "bufferViews": [{"byteLength": len(points)}, {"byteOffset": len(points), "byteLength": len(indices)}],
    }  # fmt: skip
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    binary = struct.pack("<II", len(points + indices), 0x004E4942) + points + indices
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(binary), len(text), 0x4E4F534A) + text + binary


OBJ = (
    "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
    + "vn 0 0 1\nf 1 3 2\nf 1/1/1 2/1/1 4/1/1\nf -4//1 -1//1 -2//1\nf 2 3 4\n"
)
TEXT = "".join(
    "\n".join(["facet outer loop", *(f"vertex {x} {y} {z}" for x, y, z in face), ""]) for face in TETRAHEDRON
)
FORMS = {
    "a.obj": OBJ.encode(),
    "a.STL": f"solid t\n{TEXT}endsolid t".encode(),
    "b.stl": stl(TETRAHEDRON),
    "a.dae": dae(),
    "a.glb": glb(),
}


@pytest.mark.parametrize("name", FORMS)
def test_every_form_of_a_mesh_has_the_same_triangles(name, tmp_path):
    (tmp_path / name).write_bytes(FORMS[name])
    np.testing.assert_allclose(mesh_triangles(tmp_path / name), TETRAHEDRON, atol=1e-8)  # float32 of 0.3 m


def test_polygons_are_cut_in_fans(tmp_path):
    polygons = [[0, 1, 2, 3], [1, 3], [3, 2, 1]]
    numbers = " ".join(f"{i} 0" for one in polygons for i in one)
    counts, rest = dae().decode().replace("<vcount>3 3 3 3<", "<vcount>4 2 3<").split("<p>")
    (tmp_path / "a.dae").write_text(f"{counts}<p>{numbers}</p>{rest.split('</p>')[1]}")
    expected = CORNERS[[[0, 1, 2], [0, 2, 3], [3, 2, 1]]]
    np.testing.assert_array_equal(mesh_triangles(tmp_path / "a.dae"), expected)


def test_nodes_place_meshes(tmp_path):
    """A quarter turn about z, then a step along x; COLLADA's unit scales it all, its up axis does not count."""
    expected = TETRAHEDRON @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + [1, 0, 0]
    steps = "<translate>1 0 0</translate><rotate>0 0 1 90</rotate>"
    matrix = "<matrix>0 -1 0 1  1 0 0 0  0 0 1 0  0 0 0 1</matrix>"
    half = 0.5**0.5
    forms = {
        "a.dae": (dae(steps, "0.01"), 0.01), "b.dae": (dae(matrix), 1.0),
        "c.glb": (glb(rotation=[0, 0, half, half], translation=[1, 0, 0]), 1.0),
        "d.glb": (glb(matrix=[0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 1, 0, 0, 1]), 1.0),
    }  # fmt: skip
    for name, (content, unit) in forms.items():
        (tmp_path / name).write_bytes(content)
        np.testing.assert_allclose(mesh_triangles(tmp_path / name), unit * expected, atol=1e-7)  # float32 of 1 m


BROKEN = {
    "a.stl": b"x" * 90, "b.stl": b"", "c.stl": stl(TETRAHEDRON * np.nan), "a.obj": b"v 0 0 0\nf 1 2 3\n",
    "b.obj": b"nothing", "a.dae": b"<COLLADA", "b.dae": b"<!DOCTYPE x [<!ENTITY a 'b'>]><COLLADA>&a;</COLLADA>",
    "c.dae": dae(faces=FACES + 7), "a.glb": b"glTF", "b.glb": glb(children=[0]), "c.glb": glb()[:-8], "a.ply": b"ply",
    "d.stl": stl(0.0 * TETRAHEDRON), "none": b"",
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_broken_meshes_are_left_out(name, tmp_path):
    (tmp_path / name).write_bytes(BROKEN[name])
    path = tmp_path / "arm.urdf"
    path.write_text(with_mesh(name))
    m = Mechanism.from_urdf(path, contacts="off")
    assert m.assets == {}
    assert len([phrase for phrase in m.ignored if repr(name) in phrase]) == 2


def sphere(n):
    """Triangles of a sphere with a dent, so that it is not convex."""
    u, v = np.meshgrid(np.linspace(0, np.pi, n), np.linspace(0, 2 * np.pi, n), indexing="ij")
    r = 0.1 * np.where(u < 0.5, 0.8, 1.0)
    points = np.stack([r * np.sin(u) * np.cos(v), r * np.sin(u) * np.sin(v), r * np.cos(u)], axis=-1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]).reshape(-1, 3, 3)
    return faces[np.linalg.norm(np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]), axis=1) > 1e-12]


def test_large_meshes_are_stored_as_what_is_seen_and_what_touches(tmp_path):
    full = sphere(130)
    (tmp_path / "m.stl").write_bytes(stl(full))
    _, files = written(with_mesh("m.stl"), tmp_path / "arm.urdf")
    sizes = {name: len(content) for name, content in files.items()}
    assert list(sizes) == ["m.coarse.stl", "m hull.stl"]
    assert sizes["m.coarse.stl"] < len(stl(full))
    cells = np.abs(on_grid(full)).max(axis=(0, 1)) - np.abs(full).max(axis=(0, 1))
    assert np.abs(cells).max() < 0.2 / 200  # a cell of the grid
    outside, inside = hull(full), full[::499].reshape(-1, 3)
    assert set(map(tuple, outside.reshape(-1, 3).astype("f4"))) <= set(map(tuple, full.reshape(-1, 3).astype("f4")))
    outside = outside[::50]
    normals = np.cross(outside[:, 1] - outside[:, 0], outside[:, 2] - outside[:, 0])
    normals *= np.sign(np.einsum("ij,ij->i", normals, outside[:, 0]))[:, None]  # away from the origin, which is inside
    reach = np.einsum("ij,ij->i", normals, outside[:, 0])
    assert np.all(inside @ normals.T <= reach + 1e-7 * np.linalg.norm(normals, axis=1))  # float32 of 0.1 m


def test_meshes_have_no_more_faces_than_mujoco_reads():
    with pytest.raises(PlannerError, match=f"{MAX_FACES + 4} faces"):
        stl(np.repeat(TETRAHEDRON, MAX_FACES // 4 + 1, axis=0))


def test_scales_and_names_are_kept_apart(tmp_path):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "M.stl").write_bytes(stl(TETRAHEDRON * (1 + len(folder + "x" * (folder == "two")))))
    shapes = [shape("collision", f'<mesh filename="{file}" scale="{scale}"/>')
              for file, scale in (("one/M.stl", "1 1 1"), ("two/M.stl", "1 1 1"), ("one/M.stl", "2 2 -2"))]  # fmt: skip
    urdf = robot(link("a"), link("b", inertial(), *shapes), joint("j", "a", "b"))
    model, files = written(urdf, tmp_path / "arm.urdf")
    assert sorted(files) == ["M 2.stl", "M.stl"]
    assert model.nmesh == 3
    size = model.geom_rbound  # of the box of a mesh
    np.testing.assert_allclose(size[[1, 2]] / size[0], [5 / 4, 2.0], rtol=1e-6)  # float32


XACRO = '<robot xmlns:xacro="http://wiki.ros.org/xacro"><xacro:arm/></robot>'
WRONG = {
    "<robot": "not well-formed XML",
    "<sdf/>": "root element <sdf>, expected <robot>",
    '<robot name="r"/>': "has no links",
    '<!DOCTYPE x [<!ENTITY a "b"><!ENTITY c "&a;&a;">]><robot>&c;</robot>': "declares XML entities",
    '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot>&a;</robot>': "declares XML entities",
    XACRO: "run `xacro arm.urdf.xacro > arm.urdf` first",
    "<robot><xacro:arm/></robot>": "is xacro",
    robot(link("a"), link("${side}"), joint("j", "a", "${side}")): "is xacro",
    "<robot>" + "<a>" * 5000 + "</a>" * 5000 + "</robot>": "nested too deeply",
    robot(link("a"), link("a")): "two links 'a'",
    robot(link("a"), link("")): "a link with the name ''",
    robot(link("a"), link("b"), joint("j", "a", "c")): "names the link 'c', which it does not have",
    robot(link("a"), link("b")): "2 links that hang on no joint ('a', 'b')",
    robot(link("a"), link("b"), joint("j", "a", "b"), joint("k", "a", "b")): "hangs on the joints 'j' and 'k'",
    robot(link("a"), link("b"), joint("j", "a", "b"), joint("k", "b", "a")): "part of a loop",
    robot(link("a"), link("b"), link("c"), joint("j", "b", "c"), joint("k", "c", "b")): "part of a loop",
    robot(link("a"), link("b"), link("c"), joint("j", "a", "b"), joint("j", "b", "c")): "two joints 'j'",
    robot(link("a"), link("b"), joint("j", "a", "b", "screw")): "has the type 'screw', expected one of: revolute",
    robot(link("a"), link("b"), '<joint name="j" type="fixed"><child link="b"/></joint>'): "has no parent",
    robot(link("a"), link("b", inertial()), joint("j", "a", "b", axis="0 0 0")): "the axis of joint 'j'",
    robot(link("a"), link("b", inertial()), joint("j", "a", "b", xyz="0 nan 0")): "xyz of joint 'j'",
    robot(link("a"), link("b", inertial()), joint("j", "a", "b", rpy="0 0")): "is '0 0', expected 3 numbers",
    robot(link("a"), link("b", inertial(-1.0)), joint("j", "a", "b")): "is -1 kg, expected at least 0",
    robot(link("a"), link("b", inertial(float("inf"))), joint("j", "a", "b")): "the mass of link 'b'",
    robot(link("a"), link("b", inertial()), joint("j", "a", "b", more='<limit effort="-2"/>')): "the effort of",
    robot(link("a"), link("b", inertial()), joint("j", "a", "b", more='<mimic joint="k"/>')): "mimics 'k'",
    robot(link("a"), link("b", inertial()), joint("j", "a", "b", more='<mimic joint="j"/>')): "mimics itself",
    robot(link("a"), link("b", inertial(), shape("visual", '<sphere radius="-1"/>')), joint("j", "a", "b")): "radius",
    robot(link("a\u009b2J"), link("b", inertial()), joint("j", "a\u009b2J", "b")): "expected printable characters",
    robot(link("a", inertial())): "has no joints that move",
}  # fmt: skip


@pytest.mark.parametrize(("text", "sentence"), WRONG.items(), ids=range(len(WRONG)))
def test_wrong_files_are_refused_in_one_sentence(text, sentence):
    with pytest.raises(PlannerError) as error:
        Mechanism.from_urdf(text)
    assert sentence in str(error.value)
    assert "the model" in str(error.value)
    assert "\n" not in str(error.value)


def test_xacro_files_are_told_their_command(tmp_path):
    path = tmp_path / "lift.urdf.xacro"
    path.write_text(XACRO)
    with pytest.raises(PlannerError, match=f"run `xacro {path} > {tmp_path / 'lift.urdf'}` first"):
        Mechanism.from_urdf(path)


def test_files_as_others_write_them(tmp_path):
    """A blank line before the declaration, and prefixes that are not declared: readers of URDF take both."""
    text = "\n" + ARM.replace("</robot>", "<sensor:camera/><gazebo><sensor:camera/></gazebo></robot>")
    (tmp_path / "arm.urdf").write_text(text)
    assert Mechanism.from_urdf(tmp_path / "arm.urdf").nv == 3


def test_a_world_that_is_no_link_of_the_file_is_the_world():
    hung = link("b", inertial()), joint("j", "world", "b", xyz="0.1 0.2 0.3")
    without, with_it = (Mechanism.from_urdf(robot(*parts)) for parts in (hung, (link("world"), *hung)))
    assert without.nv == 1
    np.testing.assert_array_equal(without.T_home, with_it.T_home)
    np.testing.assert_array_equal(without.com, with_it.com)
