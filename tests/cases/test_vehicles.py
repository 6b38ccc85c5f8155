"""Machines on wheels: what rolls, on which spheres, and goals in the plane that need steering."""

import numpy as np
import pytest
from trees import mujoco

import planner
from planner.cases.problem_file import load
from planner.dynamics.contacts import contact_forces
from planner.dynamics.statics import rolling_dofs
from planner.model.capabilities import rolling_radii
from planner.model.mjcf.contact_shapes import ROUND, wheel_of
from planner.problem.costs.tracking import tracking_of
from planner.proof.diagnostics import suggested_fixes
from planner.proof.skating import skating

RADIUS, HALF = 0.06, 0.015  # m
TYRES = {
    "cylinder": f'type="cylinder" size="{RADIUS} {HALF}" euler="90 0 0"',
    "mesh": 'type="mesh" mesh="tyre"',
    "ellipsoid": f'type="ellipsoid" size="{RADIUS} {HALF} {RADIUS}"',
}
# A prism of 48 sides: its flats are 0.2 % of the radius inside its corners.
TURNS = 2.0 * np.pi * np.arange(48) / 48
PRISM = " ".join(
    f"{RADIUS * np.cos(a):.8f} {y} {RADIUS * np.sin(a):.8f}" for y in (-HALF, HALF) for a in TURNS.tolist()
)
WHEEL = """<body name="{side}" pos="0 {y} 0"><joint name="{side}" axis="0 1 0" damping=".01"/>
  <geom name="{side}" {tyre} mass=".2"/></body>"""


def drive(tyre="cylinder"):
    """A base on two wheels with a motor each, and two balls without friction before and behind."""
    wheels = "".join(WHEEL.format(side=side, y=y, tyre=TYRES[tyre]) for side, y in (("left", 0.12), ("right", -0.12)))
    balls = "".join(
        f'<geom name="ball{x}" size=".02" pos="{x} 0 -.04" mass=".05" condim="1" priority="1"/>' for x in (-0.12, 0.12)
    )
    return f"""<mujoco><option timestep="0.002"/><asset><mesh name="tyre" vertex="{PRISM}"/></asset><worldbody>
      <geom name="floor" type="plane" size="5 5 .1"/><body name="base" pos="0 0 {RADIUS}"><freejoint/>
        <geom type="box" size=".15 .1 .03" mass="3" pos="0 0 .02"/>{balls}{wheels}</body></worldbody>
      <actuator><motor joint="left" ctrlrange="-2 2"/><motor joint="right" ctrlrange="-2 2"/></actuator></mujoco>"""


def task(folder, position, duration=2.5, more=""):
    (folder / "drive.xml").write_text(drive(), encoding="utf-8")
    lines = ['model = "drive.xml"', 'start = "home"', f"duration = {duration}", "[[goal]]", 'frame = "base"']
    (folder / "drive.toml").write_text("\n".join([*lines, f"position = {position}", more]), encoding="utf-8")
    return load(folder / "drive.toml").problem


@pytest.mark.parametrize("tyre", TYRES)
def test_a_wheel_rolls_on_spheres_that_touch_where_it_does(tyre):
    machine, model = planner.Mechanism.from_mjcf(drive(tyre)), mujoco.MjModel.from_xml_string(drive(tyre))
    found = wheel_of(model, model.geom("left").id)
    assert found.radius == pytest.approx(RADIUS, rel=1e-3)
    tread = np.sqrt(1.0 - (1.0 - ROUND) ** 2) if tyre == "ellipsoid" else 1.0  # of the width is as high as its middle
    assert found.half_width == pytest.approx(tread * HALF, rel=0.05)
    wheels = [machine.joint(side).start for side in ("left", "right")]
    np.testing.assert_allclose(rolling_radii(machine)[wheels], found.radius)
    assert np.count_nonzero(rolling_radii(machine)) == 2
    mine = [k for k, contact in enumerate(machine.contacts) if contact.link in wheels]
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(10):  # level, turned about the vertical, the wheels anyhow
        turn = rng.uniform(-3.0, 3.0)
        q = np.concatenate([[0.0, 0.0, 0.1, np.cos(turn), 0.0, 0.0, np.sin(turn)], rng.uniform(-9.0, 9.0, 2)])
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        true = mujoco.mj_geomDistance(model, data, model.geom("floor").id, model.geom("left").id, 1.0, None)
        depths = contact_forces(machine, q, np.zeros(machine.nv)).depths[mine]
        # of a prism the flats lie above the circle of its corners, as far as ROUND allows
        assert -1e-5 <= true + depths.max() <= (ROUND * RADIUS if tyre == "mesh" else 1e-5)


@pytest.mark.parametrize(
    "change",
    [('axis="0 1 0"', 'axis="0 1 1"'), ('euler="90 0 0"', 'euler="90 0 0" pos=".01 0 0"'), ('euler="90 0 0"', "")],
)
def test_what_turns_about_another_axis_is_no_wheel(change):
    model = mujoco.MjModel.from_xml_string(drive().replace(*change))
    assert wheel_of(model, model.geom("left").id) is None


def test_a_hinge_with_a_range_is_no_wheel():
    """A round foot on an ankle: it has a pose to be held at."""
    machine = planner.Mechanism.from_mjcf(drive().replace('damping=".01"', 'damping=".01" range="-90 90"'))
    assert not rolling_radii(machine).any()


@pytest.fixture(scope="module")
def beside(tmp_path_factory):
    """The task of a goal ahead and to the left."""
    return task(tmp_path_factory.mktemp("drive"), [0.8, 0.3, RADIUS])


def test_a_vehicles_wheels_and_place_have_no_pose_to_be_held_at(beside):
    problem, machine = beside, beside.dynamics.mechanism
    np.testing.assert_array_equal(
        np.flatnonzero(rolling_dofs(machine, problem.x0[: machine.nq])), [0, 1, 5]
    )  # x, y, yaw
    weights = np.diagonal(tracking_of(problem.cost).Q[-2])
    wheels = [machine.joint(side).start for side in ("left", "right")]
    np.testing.assert_array_equal(weights[[0, 1, 5, *wheels]], 0.0)
    assert np.all(weights[[2, 3, 4]] > 0.0)  # its height and its tilt


def test_a_vehicle_steers_to_a_goal_beside_it(beside):
    plan = planner.solve(beside)
    assert plan.success, plan.message
    assert plan.total_iterations <= 30  # 11 measured; on an octagon's corners it did not converge in 275
    assert skating(plan, beside) == ()  # the balls are there to slide


def test_a_goal_that_is_nearly_met_needs_weight_and_no_softer_contacts(tmp_path):
    plan = planner.solve(task(tmp_path, [0.8, 0.3, RADIUS], more="[weights]\ngoal = 0.02\n"))
    assert plan.status is planner.Status.GOAL_MISSED
    assert "relaxation" not in plan.options
    (fix,) = [one for one in suggested_fixes(plan) if one.key == "weights.goal"]
    assert fix.value > 0.02


@pytest.mark.slow
def test_a_drive_straight_ahead_passes(tmp_path):
    proof = planner.prove(planner.solve(task(tmp_path, [0.8, 0.0, RADIUS])), rollouts=0)
    assert proof.passed, proof.reason


SERVOS = drive().replace("<motor ", '<velocity kv=".5" forcerange="-2 2" ').replace('ctrlrange="-2 2"', "")
AHEAD = '[[goal]]\nframe = "base"\nposition = [1, 0, 0.06]'
TURN = '[[goal]]\nframe = "base"\nposition = [0, 0, 0.06]\norientation = { yaw = 90 }'


PLAIN = "goal = { root = [1, 0, 0.06, 1, 0, 0, 0] }"


@pytest.mark.slow
@pytest.mark.parametrize("goal", [PLAIN, AHEAD, TURN], ids=["plain", "ahead", "turn"])
def test_servos_of_velocity_drive_a_metre_and_turn(tmp_path, goal):
    """To tell a wheel to roll as the vehicle goes is no effort, and a plain goal leaves open how far it turns.

    Nothing lifts the base to the height of its goal, above which it sinks in by less than what passes.
    """
    (tmp_path / "drive.xml").write_text(SERVOS.replace("<freejoint/>", '<freejoint name="root"/>'), encoding="utf-8")
    (tmp_path / "drive.toml").write_text(f'model = "drive.xml"\nduration = 3.0\n{goal}', encoding="utf-8")
    plan = planner.solve(load(tmp_path / "drive.toml").problem)
    assert plan.converged
    assert plan.nit < 20  # of 60, after which softer ground is tried
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof


def test_a_servo_that_steers_is_not_held_straight(tmp_path):
    """Where it is to be told to go is not known: of a fork that carries a wheel the weight is that of a swing."""
    wheel = WHEEL.format(side="front", y=0, tyre=TYRES["cylinder"])
    fork = f"""<body pos=".25 0 0"><joint name="steer" axis="0 0 1" range="-57 57" damping=".1" armature=".01"/>
      <inertial pos="0 0 0" mass=".2" diaginertia="1e-3 1e-3 1e-3"/>{wheel}</body>"""
    arm = """<body pos="0 0 .1"><joint name="arm" axis="0 1 0"/>
      <geom size=".05" mass=".2" pos="0 0 .1" contype="0" conaffinity="0"/></body>"""
    servo = '<actuator><position name="{0}" joint="{0}" kp="30" kv="1"/></actuator>'
    text = SERVOS.replace('<body name="left"', f'{fork}{arm}<body name="left"', 1)
    text = text.replace("</mujoco>", f"{servo.format('steer')}{servo.format('arm')}</mujoco>")
    (tmp_path / "drive.xml").write_text(text, encoding="utf-8")
    (tmp_path / "drive.toml").write_text(
        f'model = "drive.xml"\nduration = 3.0\nguess = "hold"\n{AHEAD}', encoding="utf-8"
    )
    weights = load(tmp_path / "drive.toml").problem.parameters["resolved"]["weights"]["effort"]
    assert weights[2] == pytest.approx(1.0 / 0.25**2)  # the module's MIN_DISPLACEMENT, in rad
    assert weights[3] > 100.0 * weights[2]  # the reference says where the arm is to be


@pytest.mark.slow
def test_a_goal_straight_beside_a_vehicle_is_reached_from_shaken_controls(tmp_path):
    """From rest no small change of the wheels' torques moves it sideways: the first guess is a saddle."""
    plan = planner.solve(task(tmp_path, [0.0, 0.3, RADIUS], duration=3.0))
    np.testing.assert_allclose(plan.xs[-1, :2], [0.0, 0.3], atol=0.005)
    steps = plan.options["relaxation"]["steps"]
    assert [step[0] for step in steps] == ["direct", "shaken"]
    assert plan.total_iterations <= 60
