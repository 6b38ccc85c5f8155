"""The high dive: momentum against MuJoCo, its conservation to the integrator's order, the body, the count of turns."""

import numpy as np
import pytest

import planner
from planner.base.gl import load_mujoco
from planner.cases import anthropometry
from planner.cases.high_dive import flight
from planner.cases.high_dive.case import enters, misses, momentum_drift, rotated_up
from planner.cases.high_dive.flight import Diver
from planner.dynamics.kinematics import angular_momentum, center_of_mass
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import model_path
from planner.view.render.film import Film

mujoco = load_mujoco()

BALL = """<mujoco><worldbody><body name="post" pos="0 0 1"><geom size="0.1"/><body name="bob" pos="0.3 0 0">
  <joint type="ball"/><inertial pos="0.1 0 0.2" mass="2" diaginertia="0.1 0.2 0.25"/>
  <body pos="0 0.2 0"><joint type="slide" axis="1 0 0"/><inertial pos="0 0 0.1" mass="1" diaginertia="0.1 0.1 0.1"/>
  </body></body></body></worldbody><actuator><motor joint="push"/></actuator></mujoco>""".replace(
    '<joint type="slide"', '<joint name="push" type="slide"'
)


@pytest.fixture(scope="module")
def diver():
    return Diver(70.0, 1.75, 10.0, 9.81)


@pytest.fixture(scope="module")
def plan():
    return planner.solve(planner.cases.high_dive())


def random_states(mechanism, K):
    rng = np.random.default_rng(0)
    dx = rng.normal(size=(K, mechanism.space.ndx))
    return mechanism.space.integrate(np.tile(mechanism.home, (K, 1)), dx)


@pytest.mark.parametrize("model", [model_path("high_dive") / "high_dive.xml", BALL], ids=["diver", "ball"])
def test_momentum_is_mujocos(model):
    mechanism = Mechanism.from_mjcf(model, contacts="off") if model is BALL else Mechanism.from_mjcf(model)
    xs = random_states(mechanism, 5)
    q, qd = xs[:, : mechanism.nq], xs[:, mechanism.nq :]
    own = mujoco.MjModel.from_xml_string(mechanism.mjcf)
    data = mujoco.MjData(own)
    root = 1 if model is not BALL else 2  # MuJoCo's post, fixed to the world, has mass too
    com, momentum = center_of_mass(mechanism, q), angular_momentum(mechanism, q, qd)
    for k in range(len(xs)):
        data.qpos[:], data.qvel[:] = q[k], qd[k]
        mujoco.mj_forward(own, data)
        mujoco.mj_subtreeVel(own, data)
        np.testing.assert_allclose(com[k], data.subtree_com[root], atol=1e-12)
        np.testing.assert_allclose(momentum[k], data.subtree_angmom[root], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(angular_momentum(mechanism, q[k], qd[k]), momentum[k], rtol=1e-12)


def test_momentum_refuses():
    mechanism = Mechanism.from_mjcf(model_path("high_dive") / "high_dive.xml")
    with pytest.raises(planner.PlannerError, match="mechanism is 3"):
        center_of_mass(3, [0.0])  # type: ignore[arg-type]
    with pytest.raises(planner.PlannerError, match=r"qd has shape \(3,\)"):
        angular_momentum(mechanism, mechanism.home[:21], np.zeros(3))


def test_momentum_is_kept_to_the_order_of_the_integrator(plan):
    """Halving the step divides its change by 2^4; the plan's torques act at the same times."""
    mechanism, drifts = plan.problem.dynamics.mechanism, []
    half = plan.N // 2  # open loop, errors grow e-fold in 0.2 s
    for parts in (1, 2, 4):
        dynamics = planner.RigidBodyDynamics(mechanism, plan.problem.dynamics.dt / parts)
        xs = [plan.xs[0]]
        for u in np.repeat(plan.us[:half], parts, axis=0):
            xs.append(dynamics.step(xs[-1][None], u[None])[0])
        drifts.append(momentum_drift(mechanism, np.array(xs)))
    orders = np.log2(np.array(drifts[:-1]) / drifts[1:])
    assert np.all(np.abs(orders - 4.0) < 0.5), (drifts, orders)
    assert drifts[0] < 1e-5


def test_segments_are_winters(diver):
    """Table 4.1: the parts add up to the person, and a straight one has the moments that are measured."""
    bodies = anthropometry.segments(70.0, 1.75)
    twice = {name: 1 if name in ("pelvis", "chest") else 2 for name in bodies}
    assert sum(twice[name] * body.mass for name, body in bodies.items()) == pytest.approx(70.0)
    assert bodies["thigh"].mass == 7.0  # 0.100 M
    assert bodies["thigh"].com[2] == pytest.approx(-0.433 * 0.245 * 1.75)
    assert bodies["forearm"].inertia[0] == pytest.approx(0.022 * 70.0 * (0.468 * 0.146 * 1.75) ** 2)
    for body in bodies.values():  # what MuJoCo asks of a body
        largest = max(body.inertia)
        assert sum(body.inertia) - largest >= largest
    x = diver.mechanism.keyframe("start")
    turning = np.zeros(20)
    turning[4] = 1.0
    # 12 to 16 kg m^2 is what divers of this size have about the lateral axis, arms overhead.
    assert 12.0 < angular_momentum(diver.mechanism, x[:21], turning)[1] < 16.0


def test_the_file_is_the_default_diver(diver):
    file = Mechanism.from_mjcf(model_path("high_dive") / "high_dive.xml")
    for name in ("mass", "com", "inertia", "T_home", "S"):
        np.testing.assert_allclose(getattr(file, name), getattr(diver.mechanism, name), atol=1e-9, err_msg=name)
    for key in ("start", "goal"):
        np.testing.assert_allclose(file.keyframe(key)[3:], diver.mechanism.keyframe(key)[3:])


def test_a_diver_scales_with_mass_and_height():
    """Masses go with M, lengths with H."""
    one, other = Diver(70.0, 1.75, 10.0, 9.81).mechanism, Diver(35.0, 3.5, 10.0, 9.81).mechanism
    np.testing.assert_allclose(other.mass, 0.5 * one.mass)
    np.testing.assert_allclose(other.com, 2.0 * one.com)
    np.testing.assert_allclose(other.T_home[:, :3, 3], 2.0 * one.T_home[:, :3, 3])


def test_the_flight_ends_with_the_hands_at_the_water(plan):
    hands = [planner.dynamics.frame_pose(plan.problem.dynamics.mechanism, plan.xs[-1, :21], f"{side}_hand")[2, 3]
             for side in ("left", "right")]  # fmt: skip
    assert np.abs(hands).max() < 0.02  # m
    mechanism = plan.problem.dynamics.mechanism
    fall = center_of_mass(mechanism, plan.xs[:, :21])
    free = fall[0] + plan.t[:, None] * np.array([1.5, 0.0, 3.0]) - 0.5 * 9.81 * plan.t[:, None] ** 2 * [0.0, 0.0, 1.0]
    np.testing.assert_allclose(fall, free, atol=1e-5)


def test_the_diver_turns_as_often_as_was_asked(plan):
    """The long axis by its angle along the way; whole twists by the sign of the quaternion, which a full turn flips."""
    assert plan.success
    long = rotated_up(plan.xs[:, 3:7])
    angle = np.unwrap(np.arctan2(long[:, 0], long[:, 2]))
    assert angle[-1] - angle[0] == pytest.approx(3.0 * np.pi, abs=0.02)
    signs = np.sign(np.sum(plan.xs[1:, 3:7] * plan.xs[:-1, 3:7], axis=1))
    lifted = plan.xs[-1, 3:7] * np.prod(signs)
    assert lifted @ flight.orientation(3.0 * np.pi, 2.0 * np.pi) > 0.999
    assert lifted @ flight.orientation(3.0 * np.pi, 0.0) < -0.999


def test_joints_stay_in_their_ranges(plan, diver):
    ranges = diver.ranges()
    low, high = plan.xs[:, 7:21].min(axis=0), plan.xs[:, 7:21].max(axis=0)
    slack = 0.02  # rad: the ranges are a weight, not a bound
    assert np.all(low > ranges[:, 0] - slack)
    assert np.all(high < ranges[:, 1] + slack)


@pytest.mark.slow
def test_the_dive_passes_its_proof(plan):
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.table()
    assert {figure.name for figure in proof.goal.measured} >= {"replayed_turn_miss", "replayed_momentum_drift"}


def test_misses_and_success(plan):
    entry = plan.problem.cost.x_ref[-1]
    ends = np.tile(entry, (4, 1))
    ends[1, 3:7] = flight.orientation(3.0 * np.pi + 0.3, 0.0)  # 17 degrees over
    ends[2, 3:7] = flight.orientation(3.0 * np.pi, 1.0)  # straight down, another heading
    ends[3, 12] += 0.3
    np.testing.assert_array_equal(enters(ends, entry), [True, False, True, False])
    turn, angle, rate = misses(ends, entry)
    np.testing.assert_allclose(turn, [0.0, 0.3, 1.0, 0.0], atol=1e-7)
    np.testing.assert_allclose(angle, [0.0, 0.0, 0.0, 0.3], atol=1e-12)
    np.testing.assert_allclose(rate, 0.0)


def test_built_twice_it_is_the_same():
    problems = []
    for _ in range(2):
        flight.turning_plan.cache_clear()
        problems.append(planner.cases.high_dive(horizon=30, twists=0.0))
    np.testing.assert_array_equal(problems[0].us, problems[1].us)
    again = planner.cases.build("high-dive", **problems[0].parameters)
    np.testing.assert_array_equal(again.x0, problems[0].x0)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"somersaults": 1.0}, "somersaults is 1, expected a half more than a whole number"),
        ({"twists": 0.3}, "twists is 0.3, expected a multiple of a half"),
        ({"twists": 9.0}, "twists is 9"), ({"mass": 0.0}, "mass is 0"), ({"tower": -1.0}, "tower is -1"),
        ({"effort_weight": 0.0}, "effort_weight is 0"), ({"integrator": "leapfrog"}, "leapfrog"),
        ({"horizon": 0}, "horizon is 0"), ({"height": float("nan")}, "height is nan"),
    ],
)  # fmt: skip
def test_bad_input_is_refused(given, said):
    with pytest.raises(planner.PlannerError, match=said):
        planner.cases.high_dive(**given)


def test_the_camera_goes_with_the_diver(plan):
    """All three coordinates of the hips move the camera's point."""
    run = planner.replay(plan, substeps=1)
    film = Film.of(run, run.t)
    np.testing.assert_allclose(film.shift, run.xs[:, :3])
