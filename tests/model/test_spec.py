"""Mechanism.from_mjcf of a MjSpec and of an element of dm_control: every digit, the caller's object as it was."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from places import ROOT

import planner
from planner import Mechanism, ModelError
from planner.base.gl import load_mujoco

mujoco = load_mujoco()
OLDER = Path(sys.prefix) / "mujoco-3.3"
THIRD = 1 / 3  # a double whose digits do not end
CUBE = """v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""


def arm():
    """A spec with a mesh in memory, and numbers of which six digits are not enough."""
    spec = mujoco.MjSpec()
    spec.assets = {"meshes/cube.obj": CUBE.encode()}
    spec.option.gravity = [0, 0, -9 - THIRD]
    spec.add_mesh(name="cube", file="meshes/cube.obj", scale=[THIRD] * 3)
    upper = spec.worldbody.add_body(name="upper", pos=[THIRD, 0, 2 * THIRD])
    upper.add_joint(name="shoulder", axis=[0, 1, THIRD], stiffness=THIRD, range=[-20 * THIRD, 100 * THIRD])
    upper.add_geom(
        name="link", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[THIRD / 9, 0, 0], fromto=[0, 0, 0, THIRD, 0.1, 0]
    )
    hand = upper.add_body(name="hand", pos=[THIRD, 0.1, 0])
    hand.add_joint(name="wrist", axis=[THIRD, 0, 1])
    hand.add_geom(name="cube", type=mujoco.mjtGeom.mjGEOM_MESH, meshname="cube", density=100 * THIRD)
    hand.add_site(name="tip", pos=[THIRD, 0, 0])
    motor = spec.add_actuator(name="motor", target="shoulder", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.ctrlrange, motor.gear = [-THIRD, THIRD], [7 * THIRD, 0, 0, 0, 0, 0]
    return spec


def compiled(spec):
    return spec.copy().compile()


def same_model(mechanism, model):
    """Everything that moves the mechanism has the compiled model's bits, or its rounding where frames are turned."""
    assert np.array_equal(mechanism.gravity, model.opt.gravity)
    assert np.array_equal(mechanism.stiffness, model.jnt_stiffness)
    assert np.array_equal(mechanism.joint_range[0], model.jnt_range[0])
    assert np.array_equal(mechanism.S[:, :3], model.jnt_axis)
    assert np.allclose(mechanism.mass, model.body_mass[1:], rtol=1e-14, atol=0)
    assert np.array_equal(mechanism.T_home[:, :3, 3], model.body_pos[1:])


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_spec_is_read_to_the_last_digit_and_stays_as_it_was():
    spec = arm()
    before, model = compiled(spec), compiled(spec)
    mechanism = Mechanism.from_mjcf(spec)
    same_model(mechanism, model)
    assert mechanism.origin == {}
    assert list(spec.assets) == ["meshes/cube.obj"]
    assert np.array_equal(compiled(spec).body_inertia, before.body_inertia)
    spec.body("hand").pos = [9, 9, 9]  # what the caller does next is not the mechanism's
    assert mechanism.T_home[1, 0, 3] == THIRD
    assert planner.parity(mechanism).passed


def test_a_spec_finds_its_files_on_disk(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "cube.obj").write_text(CUBE)
    file = tmp_path / "arm.xml"
    file.write_text(
        '<mujoco><compiler meshdir="meshes"/><asset><mesh name="cube" file="cube.obj"/></asset><worldbody><body>'
        '<joint/><geom type="mesh" mesh="cube"/></body></worldbody></mujoco>'
    )
    spec = mujoco.MjSpec.from_file(str(file))
    given, read = Mechanism.from_mjcf(file), Mechanism.from_mjcf(spec)
    assert list(read.assets) == ["cube.obj"]
    assert np.allclose(read.inertia, given.inertia, rtol=1e-12)
    spec.body("world").add_geom(size=[THIRD, 0, 0])  # the caller's spec can still be edited and compiled
    assert spec.compile().ngeom == 2


def test_a_plan_of_a_spec_is_proved_in_a_spec():
    mechanism = Mechanism.from_mjcf(arm())
    assert planner.parity(mechanism, arm()).passed
    other = arm()
    other.body("hand").pos = [0.5, 0.1, 0]
    assert not planner.parity(mechanism, other).passed


def test_what_the_written_text_would_change_is_refused(monkeypatch):
    """As of a MuJoCo without its function for all digits: six of them are another model."""
    from planner.model.mjcf import model_file as module

    monkeypatch.setattr(module, "DIGITS", 6)
    with pytest.raises(ModelError, match=r"has another .* than the spec itself: pass the text or the path"):
        Mechanism.from_mjcf(arm())


def test_what_is_no_text_path_or_spec_is_told_what_to_pass():
    with pytest.raises(ModelError, match=r"a compiled MjModel, .* pass that text, its path, or a spec of it"):
        Mechanism.from_mjcf(compiled(arm()))
    with pytest.raises(ModelError, match=r"the model is a int, expected MJCF text, the path of a file, a mujoco.MjSp"):
        Mechanism.from_mjcf(3)
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(size=[0, 0, 0])
    with pytest.raises(ModelError, match=r"MuJoCo refuses the model: .*size"):
        Mechanism.from_mjcf(spec)


def test_an_element_of_dm_control_is_read_by_its_xml_and_assets():
    mjcf = pytest.importorskip("dm_control.mjcf")
    root = mjcf.RootElement(model="arm")
    root.asset.add("mesh", name="cube", file=mjcf.Asset(CUBE.encode(), ".obj"))
    body = root.worldbody.add("body", name="upper", pos=[THIRD, 0, 0])
    body.add("joint", name="shoulder", axis=[0, 1, 0], stiffness=THIRD)
    body.add("geom", type="mesh", mesh="cube")
    before = root.to_xml_string()
    for element in (root, body):
        mechanism = Mechanism.from_mjcf(element)
        assert mechanism.stiffness[0] == mechanism.T_home[0, 0, 3] == THIRD
    assert root.to_xml_string() == before


class Element:
    """What is used of an element of dm_control.mjcf, where that package is not there."""

    root = property(lambda self: self)

    def to_xml_string(self):
        return f'''<mujoco><asset><mesh name="cube" file="cube-0af.obj"/></asset><worldbody><body>
          <joint stiffness="{THIRD!r}"/><geom type="mesh" mesh="cube"/></body></worldbody></mujoco>'''

    def get_assets(self):
        return {"cube-0af.obj": CUBE.encode()}


def test_what_has_xml_and_assets_is_read_by_them():
    mechanism = Mechanism.from_mjcf(Element())
    assert (mechanism.stiffness[0], list(mechanism.assets)) == (THIRD, ["cube-0af.obj"])


@pytest.mark.skipif(not OLDER.is_dir(), reason=f"no MuJoCo 3.3 in {OLDER.name}: .ci/setup test fetches it")
def test_a_spec_is_read_to_the_last_digit_in_the_oldest_mujoco():
    test = test_a_spec_is_read_to_the_last_digit_and_stays_as_it_was.__name__
    code = f"import test_spec; print(test_spec.mujoco.__version__); test_spec.{test}()"
    path = os.pathsep.join(map(str, [OLDER, ROOT, ROOT / "tests", Path(__file__).parent]))
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout.split()) == (0, ["3.3.0"]), done.stderr
