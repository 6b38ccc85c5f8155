"""Meshes that are only seen are stored coarse: nothing that moves or touches changes; other meshes stay as they are."""

import numpy as np
import pytest

import planner
from planner.model.mjcf.model_file import LARGE
from planner.model.mjcf.model_index import compile_model, pose
from planner.model.mjcf.read import read

RINGS, CORNERS = 1000, 12


def rod(length=1.0, radius=0.02):
    """An OBJ of a closed rod along x with 12 000 vertices, five to a cell of the coarse grid along it."""
    angle = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    x = np.repeat(np.linspace(0.0, length, RINGS), CORNERS)
    points = np.column_stack([x, np.tile(radius * np.cos(angle), RINGS), np.tile(radius * np.sin(angle), RINGS)])
    lines = [f"v {x:.12f} {y:.12f} {z:.12f}" for x, y, z in points]
    for ring in range(RINGS - 1):
        for i in range(CORNERS):
            a, b = ring * CORNERS + i + 1, ring * CORNERS + (i + 1) % CORNERS + 1
            lines += [f"f {a} {b} {b + CORNERS}", f"f {a} {b + CORNERS} {a + CORNERS}"]
    last = (RINGS - 1) * CORNERS
    for i in range(1, CORNERS - 1):
        lines += [f"f 1 {i + 2} {i + 1}", f"f {last + 1} {last + i + 1} {last + i + 2}"]
    return "\n".join(lines).encode()


ROD = rod()
SEEN = 'contype="0" conaffinity="0"'
TEXTURED = """<texture name="skin" type="2d" builtin="flat" width="8" height="8"/>
  <material name="skin" texture="skin"/>"""
INERTIAL = '<inertial pos=".5 0 0" mass="2" diaginertia=".1 .2 .2"/>'


def arm(geom=SEEN, inertial=INERTIAL, mesh="", assets="", default=""):
    """A pendulum that looks like a rod and touches the ground with a sphere."""
    return f"""<mujoco><option><flag contact="disable"/></option><default>{default}</default>
  <asset>{assets}<mesh name="rod" file="rod.obj" {mesh}/></asset>
  <worldbody><geom name="ground" type="plane" size="5 5 .1" pos="0 0 -2"/>
    <body name="arm">{inertial}<joint name="pivot" axis="0 -1 0"/><geom name="look" type="mesh" mesh="rod" {geom}/>
      <geom name="tip" type="sphere" pos="1 0 0" size=".05" mass="0"/></body></worldbody>
  <actuator><motor joint="pivot"/></actuator></mujoco>"""


def both(text, files=None):
    """The mechanism as it is read, the compiled model of its text, and that of the file as it was written."""
    files = {"rod.obj": ROD} | (files or {})
    machine = read(text, assets=files)
    return machine, compile_model(machine.mjcf, machine.assets), compile_model(text, files)


def box_of(model):
    """(2, 3) m, the corners of the box about the mesh, in the frame of its geom's body."""
    geom = model.geom("look").id
    mesh = model.geom_dataid[geom]
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    T = pose(model.geom_pos[geom], model.geom_quat[geom])
    points = model.mesh_vert[first : first + count] @ T[:3, :3].T + T[:3, 3]
    return np.array([points.min(axis=0), points.max(axis=0)])


def test_a_large_mesh_that_is_only_seen_becomes_coarse():
    machine, coarse, full = both(arm())
    assert LARGE < len(ROD) > 5 * sum(map(len, machine.assets.values()))
    assert coarse.nmeshvert < full.nmeshvert / 2
    np.testing.assert_allclose(box_of(coarse), box_of(full), atol=1.0 / 200)
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_invweight0", "dof_M0"):
        np.testing.assert_array_equal(getattr(coarse, name), getattr(full, name), err_msg=name)
    for geom in ("ground", "tip"):
        for name in ("pos", "quat", "size", "type", "contype", "conaffinity", "friction", "solref", "margin"):
            one, other = (getattr(model.geom(geom), name) for model in (coarse, full))
            np.testing.assert_array_equal(one, other, err_msg=f"{name} of {geom}")


@pytest.mark.parametrize(
    ("mesh", "default"),
    [
        ('scale="2 2 2"', ""),
        ("", '<mesh scale=".5 .5 .5"/>'),
        ('class="small"', '<default class="small"><mesh scale=".5 .5 .5"/></default>'),
        ('refpos=".1 .2 .3" refquat="1 1 0 0"', ""),
        ('scale="1 -1 1"', ""),
    ],
    ids=["scale", "scale by default", "scale of a class", "reference pose", "mirrored"],
)  # fmt: skip
def test_scales_and_reference_poses_are_in_the_coarse_mesh(mesh, default):
    machine, coarse, full = both(arm(mesh=mesh, default=default))
    assert list(machine.assets) == ["rod.coarse.obj"]
    np.testing.assert_allclose(box_of(coarse), box_of(full), atol=2.0 / 200)


@pytest.mark.parametrize(
    "text",
    [
        arm(geom=""),
        arm(geom='contype="0" conaffinity="1"'),
        arm(geom=SEEN + ' density="1000"', inertial=""),
        arm(geom=SEEN + ' material="skin"', assets=TEXTURED),
        arm().replace("<mujoco>", '<mujoco><compiler inertiafromgeom="true"/>'),
        arm().replace("</mujoco>", '<contact><pair geom1="look" geom2="ground"/></contact></mujoco>'),
    ],
    ids=["collides", "is collided with", "gives mass", "has a texture", "inertia from geoms", "is in a pair"],
)  # fmt: skip
def test_any_other_mesh_stays(text):
    machine, kept, full = both(text)
    assert machine.assets == {"rod.obj": ROD}
    np.testing.assert_array_equal(kept.mesh_vert, full.mesh_vert)


def test_a_mesh_of_two_geoms_stays_where_one_of_them_touches():
    text = arm().replace("</worldbody>", '<geom type="mesh" mesh="rod" pos="0 3 0"/></worldbody>')
    assert both(text)[0].assets == {"rod.obj": ROD}


def test_a_small_file_stays():
    small = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    assert read(arm(), assets={"rod.obj": small}).assets == {"rod.obj": small}


def sheet(n=100):
    """An OBJ of a square without thickness."""
    x, y = np.meshgrid(np.linspace(0.0, 1.0, n), np.linspace(0.0, 1.0, n))
    lines = [f"v {a:.12f} {b:.12f} 0" for a, b in zip(x.ravel(), y.ravel(), strict=True)]
    for a in (i * n + j + 1 for i in range(n - 1) for j in range(n - 1)):
        lines += [f"f {a} {a + 1} {a + n + 1}", f"f {a} {a + n + 1} {a + n}"]
    return "\n".join(lines).encode()


def test_a_mesh_without_volume_becomes_coarse_too():
    machine = read(arm(mesh='inertia="shell"'), assets={"rod.obj": sheet()})
    assert list(machine.assets) == ["rod.coarse.obj"]


def test_a_mesh_that_would_be_a_line_stays():
    wire = rod(radius=0.002)  # in one row of cells
    assert read(arm(), assets={"rod.obj": wire}).assets == {"rod.obj": wire}


def test_the_file_of_a_plan_is_small(tmp_path):
    machine = read(arm(), assets={"rod.obj": ROD})
    dynamics = planner.RigidBodyDynamics(machine, 0.05)
    cost = planner.TrackingCost.joints(dynamics, machine.home, 10, effort=1.0, final_position=1.0)
    plan = planner.solve(planner.Problem(dynamics, cost, machine.home), max_iterations=1)
    path = plan.save(tmp_path / "plan.npz")
    assert path.stat().st_size < LARGE
    assert planner.load_plan(path).twin.assets == machine.assets


def test_a_mesh_that_a_primitive_is_fitted_to_stays_as_it_is():
    """The box that touches has its size from the mesh, which is seen besides."""
    fitted = '<geom name="fit" type="box" mesh="rod"/><geom name="tip"'
    machine, stored, written = both(arm().replace('<geom name="tip"', fitted))
    assert machine.assets["rod.obj"] == ROD
    np.testing.assert_array_equal(stored.geom("fit").size, written.geom("fit").size)
