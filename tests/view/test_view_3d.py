"""The 3-D view of a report: the replay's poses, MuJoCo's shapes, and the three.js that NOTICE names."""

import base64
import hashlib
import html
import json
import re
from importlib.resources import files
from pathlib import Path

import mujoco
import numpy as np
import pytest
from chromium import WITH_WEBGL, WITHOUT_WEBGL, browse, with_browser

import planner
from planner.view.render.environment import visible_model
from planner.view.report.page import write_report
from planner.view.report.view_3d import MOST_ENDS, drawn_shapes, ends, film_of, mesh_of, simplified, view_data

ROOT = Path(__file__).parents[2]
ASSETS = files("planner.view") / "assets"


@pytest.fixture(scope="module")
def proof():
    return planner.prove(planner.solve(planner.cases.hopper()), rollouts=0)


@pytest.fixture(scope="module")
def data(proof):
    return json.loads(json.dumps(view_data(film_of(proof.replay))))


def unpacked(text, *shape):
    return np.frombuffer(base64.b64decode(text), np.float32).reshape(shape)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_shapes_are_where_mujoco_has_them(proof, data, share):
    """Each shape that moves, by the pose of its body: the centre that mj_forward gives it."""
    frame = round(share * (len(data["t"]) - 1))
    t = data["t"][frame]
    model = visible_model([film_of(proof.replay)])
    state = mujoco.MjData(model)
    state.qpos[:] = [np.interp(t, proof.replay.t, column) for column in proof.replay.qpos.T]
    mujoco.mj_forward(model, state)
    poses = unpacked(data["poses"], len(data["t"]), data["bodies"], 7)[frame].astype(float)
    centres = []
    for shape in data["shapes"]:
        if shape["body"] >= 0:
            turned, pose = np.empty(3), poses[shape["body"]]
            mujoco.mju_rotVecQuat(turned, np.array(shape["at"][:3]), pose[3:])
            centres.append(pose[:3] + turned)
    drawn = (model.geom_bodyid > 0) & (model.geom_rgba[:, 3] > 0.0) & (model.geom_group < 3)
    distance = np.linalg.norm(np.array(centres)[:, None] - state.geom_xpos[drawn], axis=-1)
    size = model.stat.extent
    assert len(centres) == np.count_nonzero(drawn)
    assert distance.min(axis=1).max() < 1e-5 * size  # single precision and six digits


def test_the_ghost_is_the_plan_and_forces_act_in_the_stance(proof, data):
    frames = len(data["t"])
    apart = unpacked(data["poses"], frames, -1) - unpacked(data["ghost"], frames, -1)
    assert 0.0 < np.abs(apart).max() < 0.5  # in: the replay is near its plan, and not the plan
    forces = unpacked(data["forces"], frames, data["contacts"], 6)
    up = forces[..., 5] > 0.0
    assert 0.1 < up.mean() < 0.9  # some of the time, the rest is flight
    assert data["tendons"][0]["points"] == 2  # the spring


def test_the_page_holds_the_view_and_asks_for_nothing(proof, tmp_path):
    text = write_report(proof.replay.plan, proof, tmp_path).read_text(encoding="utf-8")
    assert 5e5 < len(text) < 8e6
    block = re.search(r'<script type="application/json" id="view-data">(.*?)</script>', text, re.DOTALL)
    assert json.loads(block[1])["bodies"] > 0
    assert not re.search(r"<script[^>]* src|<link|@import|import\(|fetch\(\"http", text)


def test_a_mesh_is_simplified_to_its_share_and_keeps_its_shape():
    """A ball of 20,000 triangles."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 101)[:-1], np.linspace(0, np.pi, 101), indexing="ij")
    points = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
    at = np.arange(100 * 101).reshape(100, 101)
    a, b, c, d = at[:, :-1], np.roll(at, -1, 0)[:, :-1], np.roll(at, -1, 0)[:, 1:], at[:, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    vertices, triangles = simplified(points.reshape(-1, 3), faces, 2000)
    assert 1000 < len(triangles) <= 2000
    assert np.linalg.norm(vertices, axis=1).min() > 0.95  # a cell is a tenth of the radius wide
    same = simplified(points.reshape(-1, 3), faces, len(faces))
    assert same[1] is faces


HILLS = """
<mujoco><asset><hfield name="hills" nrow="3" ncol="4" size="1.5 1 0.4 0.1"
  elevation="0 1 2 0  3 1 4 1  0 2 0 5"/></asset>
<worldbody><geom type="hfield" hfield="hills" pos="1 0 0.2"/></worldbody></mujoco>
"""


def test_a_height_field_is_drawn_where_mujoco_has_it():
    """Rays straight down end on the triangle that is drawn there."""
    model = mujoco.MjModel.from_xml_string(HILLS)
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    ((_, kind, _, place, _, mesh),) = drawn_shapes(model, state)
    assert kind == "mesh"
    vertices, faces = mesh_of(model, mesh)
    assert len(faces) == 2 * 2 * 3
    weights = np.array([0.6, 0.3, 0.1])  # inside of each triangle
    for corners in vertices[faces]:
        point = place[:3] + weights @ corners
        distance = mujoco.mj_ray(model, state, [*point[:2], 9.0], [0.0, 0.0, -1.0], None, 1, -1, np.zeros(1, np.int32))
        assert 9.0 - distance == pytest.approx(point[2], abs=1e-6)  # MuJoCo keeps heights in single precision
        assert np.cross(corners[1] - corners[0], corners[2] - corners[0])[2] > 0.0  # its outside is above


def test_three_js_is_the_one_that_notice_names():
    digest = hashlib.sha256((ASSETS / "three.min.js").read_bytes()).hexdigest()
    notice = (ROOT / "NOTICE").read_text(encoding="utf-8")
    assert digest in notice
    version = re.search(r"three\.js (\S+),", notice)[1]
    assert f"three@{version} " in (ROOT / "Makefile").read_text(encoding="utf-8")
    assert f'"{version.split(".")[1]}"' in (ASSETS / "three.min.js").read_text(encoding="utf-8")  # its REVISION
    assert "MIT License" in (ASSETS / "LICENSE-three.txt").read_text(encoding="utf-8")


BRANCHES = """<mujoco><worldbody>
  <body name="base"><joint/><geom size="0.1"/>
    <body name="arm" pos="0 0 1"><joint/><geom size="0.1"/><site name="elbow" pos="0 0 0.2"/>
      <body name="hand" pos="0 0 0.5"><geom size="0.1"/></body></body>
    <body name="foot" pos="0 0 -1"><joint/><geom size="0.1"/><site name="sole" pos="0 0 -0.3"/></body></body>
  <body name="belt"><joint type="slide"/><geom size="0.1"/></body></worldbody></mujoco>"""


def test_ends_are_the_farthest_frames_of_the_last_bodies_of_the_machine():
    """A hand that is welded to its arm and a sole, but no base, no elbow and no belt."""
    model = mujoco.MjModel.from_xml_string(BRANCHES)
    scenery = np.arange(model.nbody) == model.body("belt").id
    assert ends(model, scenery) == ("hand", "sole")
    assert "belt" in ends(model, scenery & False)


def test_ends_of_a_hand_of_many_fingers_are_not_drawn():
    fingers = "".join(f'<body name="{k}"><joint/><geom size="0.1"/></body>' for k in range(MOST_ENDS + 1))
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{fingers}</worldbody></mujoco>")
    assert ends(model, np.zeros(model.nbody, dtype=bool)) == ()


def test_a_floor_with_a_picture_has_no_colour_of_its_own(data):
    """The hopper's has squares, which the view paints itself."""
    assert [shape["colour"] for shape in data["shapes"] if shape["kind"] == "plane"] == [[1.0, 1.0, 1.0, 1.0]]


# What the page's reader may do, and what the canvas then shows: the share of its pixels that differ.
TRY = """<script>addEventListener("load", () => setTimeout(() => {
  const done = {}, figure = document.getElementById("view"), canvas = figure.querySelector("canvas");
  const drawn = () => {
    const copy = Object.assign(document.createElement("canvas"), {width: canvas.width, height: canvas.height});
    const one = copy.getContext("2d");
    plannerView.draw();
    one.drawImage(canvas, 0, 0);
    return one.getImageData(0, 0, copy.width, copy.height).data;
  };
  const differ = (a, b) => a.filter((value, k) => Math.abs(value - b[k]) > 12).length / a.length;
  try {
    [...document.querySelectorAll("#view-tabs button")].find(one => one.textContent === "3-D view")?.click();
    plannerView.pose(Math.round(0.5 * (plannerView.frames - 1)));
    const first = drawn();
    done.nothing = differ(first, drawn());
    for (const label of figure.querySelectorAll("label")) {
      label.click();
      done[label.textContent.trim()] = differ(first, drawn());
      label.click();
    }
    done.again = differ(first, drawn());
    const slider = figure.querySelector("input[type=range]");
    slider.value = 1;
    slider.dispatchEvent(new Event("input"));
    done.scrubbed = differ(first, drawn());
    done.time = figure.querySelector("output").value;
    const at = (type, x, y) => canvas.dispatchEvent(new PointerEvent(type, {pointerId: 1, button: 0, buttons: 1,
      clientX: x, clientY: y, pageX: x, pageY: y, bubbles: true, pointerType: "mouse"}));
    canvas.setPointerCapture = canvas.releasePointerCapture = () => {};
    const last = drawn();
    at("pointerdown", 300, 300); at("pointermove", 420, 340); at("pointerup", 420, 340);
    done.turned = differ(last, drawn());
    figure.querySelector(".keys button").click();
    done.home = differ(last, drawn());
  } catch (error) { done.error = String(error); }
  document.body.dataset.done = JSON.stringify(done);
}, 300));</script></body>"""


@with_browser
def test_a_reader_turns_the_view_moves_its_time_and_hides_what_he_does_not_want(proof, tmp_path):
    page = write_report(proof.replay.plan, proof, tmp_path)
    page.write_text(page.read_text(encoding="utf-8").replace("</body>", TRY), encoding="utf-8")
    dom, console = browse(page, *WITH_WEBGL, "--window-size=800,900", "--virtual-time-budget=20000", "--dump-dom")
    done = json.loads(html.unescape(re.search(r'data-done="([^"]*)"', dom)[1]))
    assert [line for line in console if "GPU stall" not in line] == []  # reading the canvas, which no reader does
    assert "error" not in done
    assert done["nothing"] == done["again"] == 0.0
    assert all(1e-4 < done[layer] < 0.1 for layer in ("ghost", "trails and goals", "contact forces"))
    assert 0.01 < done["scrubbed"] < 0.3
    assert done["time"] == f"t = {proof.replay.t[-1]:.3f} s"
    assert done["turned"] > 0.1
    assert done["home"] < 1e-3


@with_browser
def test_without_webgl_the_page_does_without_the_view(proof, tmp_path):
    page = write_report(proof.replay.plan, proof, tmp_path)
    dom, console = browse(page, *WITHOUT_WEBGL, "--dump-dom")
    assert console == []
    assert re.search(r'<figure id="view" hidden', dom)
    assert "view-tabs" not in re.sub(r"<script.*?</script>", "", dom, flags=re.DOTALL)
