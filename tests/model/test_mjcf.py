"""The models: they load, run without a complaint, are documented, and have the physics that the paper states."""

import numpy as np
import pytest
from places import ROOT

from planner.base.gl import load_mujoco

MJCF = ROOT / "mjcf"
SCENES = sorted(MJCF.glob("*/scene.xml"))
# Those of cases in Python. The others are written as users write theirs; their problem files have start and goal.
OF_CASES = [path for path in SCENES if not path.with_name(f"{path.parent.name}.toml").is_file()]

mujoco = load_mujoco()


@pytest.fixture(params=SCENES, ids=lambda path: path.parent.name)
def scene(request):
    return request.param


@pytest.fixture(params=OF_CASES, ids=lambda path: path.parent.name)
def case_scene(request):
    return request.param


def simulate(model, seconds=1.0):
    """One second of seeded noise, held for 10 ms each: (steps, nq + nv + na)."""
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    held = max(1, round(0.01 / model.opt.timestep))
    states = []
    for step in range(round(seconds / model.opt.timestep)):
        if step % held == 0:
            data.ctrl[:] = rng.normal(scale=20.0, size=model.nu)
        mujoco.mj_step(model, data)
        states.append(np.concatenate([data.qpos, data.qvel, data.act]))
    return np.array(states), data


def test_there_are_models():
    assert [path.parent.name for path in SCENES]


def test_scene_runs_without_warnings(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo would write its log
    states, data = simulate(mujoco.MjModel.from_xml_path(str(scene)))
    assert np.all(np.isfinite(states))
    assert all(warning.number == 0 for warning in data.warning)
    assert not list(tmp_path.iterdir())


def test_scene_adds_nothing_to_the_physics(case_scene):
    """Bit for bit: floor, light and rod are only seen."""
    scene = case_scene
    machine = scene.with_name(f"{scene.parent.name}.xml")
    alone, _ = simulate(mujoco.MjModel.from_xml_path(str(machine)), 0.3)
    staged, _ = simulate(mujoco.MjModel.from_xml_path(str(scene)), 0.3)
    np.testing.assert_array_equal(alone, staged)


def test_scene_has_keyframes_and_cameras(case_scene):
    model = mujoco.MjModel.from_xml_path(str(case_scene))
    for name in ("start", "goal"):
        assert model.key(name).id >= 0
    for name in ("side", "follow"):
        assert model.camera(name).id >= 0


def test_scene_has_a_row(scene):
    name = scene.parent.name
    assert f"| [`{name}`]({name}/{name}.xml)" in (MJCF / "README.md").read_text(encoding="utf-8")


def test_machine_states_its_masses_and_hides_no_friction(case_scene):
    scene = case_scene
    model = mujoco.MjModel.from_xml_path(str(scene))
    text = scene.with_name(f"{scene.parent.name}.xml").read_text(encoding="utf-8")
    assert text.count("<inertial") == np.sum(model.body_mass > 0) == np.sum(model.body_weldid > 0)
    assert np.all(model.dof_frictionloss == 0)
    if scene.parent.name != "human_step":  # its passive joints are in test_human_step.py
        assert np.all(model.dof_damping == 0)
        assert np.all(model.jnt_stiffness == 0)
    if scene.parent.name != "puma":  # its armature is that of its motors, in test_puma.py
        assert np.all(model.dof_armature == 0)
    assert not np.any(model.actuator_ctrllimited)
    for word in ("damping", "armature", "frictionloss"):
        assert f'{word}="0"' in text


def test_decorations_touch_nothing(case_scene):
    model = mujoco.MjModel.from_xml_path(str(case_scene))
    seen = model.geom_group != 3
    assert not np.any(model.geom_contype[seen] | model.geom_conaffinity[seen])


def test_hopper_is_the_papers():
    model = mujoco.MjModel.from_xml_path(str(MJCF / "hopper" / "scene.xml"))
    mass, foot = model.body("mass"), model.body("foot")
    assert mass.mass[0] == 1.0
    assert foot.mass[0] == 1e-5
    np.testing.assert_array_equal(model.opt.gravity, [0, 0, -386.4])  # section 4
    piston = model.actuator("piston")
    assert piston.gainprm[0] == 100.0  # section 4, k/m
    np.testing.assert_array_equal(piston.biasprm[:3], [0, -100, 0])
    assert piston.trnid[0] == model.joint("leg").id
    assert piston.dyntype[0] == mujoco.mjtDyn.mjDYN_INTEGRATOR  # section 2.4, y_p' = u
    assert model.opt.timestep == 1e-4
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.jacobian == mujoco.mjtJacobian.mjJAC_DENSE
    assert model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert (model.opt.iterations, model.opt.tolerance) == (50, 1e-15)
    for name in ("ground", "sole"):
        geom = model.geom(name)
        np.testing.assert_array_equal(geom.solref, [0.0002, 1.0])
        np.testing.assert_array_equal(geom.solimp[:3], [0.9999, 0.9999, 0.001])
        assert geom.condim[0] == 1


def test_hopper_stands_in_equilibrium_and_spring_only_pushes():
    """Standing, k (y_p - s) carries the weight; in the air the leg is as long as the piston says and m falls freely."""
    model = mujoco.MjModel.from_xml_path(str(MJCF / "hopper" / "hopper.xml"))
    data = mujoco.MjData(model)
    data.qpos[:], data.act[:] = 0.0, 386.4 / 100
    mujoco.mj_forward(model, data)
    assert abs(data.qacc[0]) < 1e-2 * 386.4  # the foot presses into a contact that is hard, not rigid
    data.qpos[:], data.act[:] = [10.0, 2.0], 2.0
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    assert data.qacc[0] == pytest.approx(-386.4)


def test_hopper_keyframes():
    model = mujoco.MjModel.from_xml_path(str(MJCF / "hopper" / "scene.xml"))
    start, goal = model.key("start"), model.key("goal")
    assert start.act[0] == -0.05  # -alpha/2
    assert start.qpos[0] == 0.0
    assert goal.qpos[0] == 20.0
    for key in (start, goal):
        assert key.qpos[1] == key.act[0]  # the foot hangs at the spring's rest length
