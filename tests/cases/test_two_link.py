"""Case 1: the arm is the textbook's, the first guess the paper's, the default plan converges and is proved."""

from dataclasses import replace

import numpy as np
import pytest
from solves import first_rollout

import planner
from planner.base.gl import load_mujoco
from planner.cases.planar_arm import UPRIGHT, Links, arm_text
from planner.model.mjcf.text import model_path
from planner.problem.initial_guess import quintic

mujoco = load_mujoco()

LINKS = {"mass1": 0.7, "mass2": 0.4, "length1": 0.8, "length2": 1.3, "gravity": 3.7}


def textbook(x, u, mass1=0.5, mass2=0.5, length1=1.0, length2=1.0, gravity=9.81):
    """Accelerations (K, 2) of two uniform rods by Lagrange's equations, q1 from the horizontal."""
    q1, q2, v1, v2 = x.T
    I1, I2, half1, half2 = mass1 * length1**2 / 12, mass2 * length2**2 / 12, length1 / 2, length2 / 2
    a = I1 + I2 + mass1 * half1**2 + mass2 * (length1**2 + half2**2)
    b, d = mass2 * length1 * half2, I2 + mass2 * half2**2
    M = np.array([[a + 2 * b * np.cos(q2), d + b * np.cos(q2)], [d + b * np.cos(q2), d + 0 * q2]]).transpose(2, 0, 1)
    outer = gravity * mass2 * half2 * np.cos(q1 + q2)
    coriolis = b * np.sin(q2)
    h1 = -coriolis * (2 * v1 * v2 + v2**2) + gravity * (mass1 * half1 + mass2 * length1) * np.cos(q1) + outer
    h2 = coriolis * v1**2 + outer
    return np.linalg.solve(M, (u - np.stack([h1, h2], axis=1))[..., None])[..., 0]


@pytest.fixture(scope="module")
def plan():
    return planner.solve(planner.cases.two_link())


def effort(problem, us):
    return 0.5 * problem.dynamics.dt * float(np.sum(us**2))


@pytest.mark.parametrize("links", [{}, LINKS], ids=["default", "other"])
def test_the_arm_is_the_textbooks(links):
    rng = np.random.default_rng(1)
    x, u = rng.normal(scale=2.0, size=(50, 4)), rng.normal(size=(50, 2))
    rates = planner.cases.two_link(**links).dynamics.rates(x, u)
    np.testing.assert_array_equal(rates[:, :2], x[:, 2:])
    np.testing.assert_allclose(rates[:, 2:], textbook(x, u, **links), rtol=1e-10, atol=1e-10)


@pytest.mark.paper
def test_the_first_guess_needs_the_papers_effort():
    """The paper states 73.6; no masses are given, and rods of 0.5 kg and 1 m come this near."""
    for horizon in (100, 200, 400):
        problem = planner.cases.two_link(horizon=horizon)
        assert effort(problem, problem.first_guess) == pytest.approx(73.6, rel=0.015)


def test_the_first_guess_swings_a_straight_arm_up():
    """Held over stages the torques of the motion are of second order: half the stage, a quarter of the error."""
    errors = []
    for horizon in (200, 400):
        problem = planner.cases.two_link(horizon=horizon)
        errors.append(np.abs(first_rollout(problem)[-1] - [*UPRIGHT, 0, 0]).max())
    assert errors[1] < 0.1
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_the_quintic_starts_and_ends_at_rest():
    N, T = 1000, 2.0
    q, v, a = quintic(np.zeros(2), UPRIGHT, T, N)
    np.testing.assert_allclose(np.sum(v, axis=0) * T / N, UPRIGHT, atol=1e-5)  # the integral of the velocity
    np.testing.assert_allclose(np.sum(a, axis=0) * T / N, 0.0, atol=1e-5)
    for end in (0, -1):
        assert np.abs(v[end]).max() < 1e-4
    assert np.abs(q[0]).max() < 1e-4
    assert np.all(np.diff(q[:, 0]) > 0.0)


def test_the_default_plan_converges_and_passes(plan):
    assert plan.success, plan.message
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    assert proof.mode == "open-loop"
    assert np.abs(proof.replay.xs[-1] - [*UPRIGHT, 0, 0]).max() < 0.05


@pytest.mark.paper
def test_the_forearm_folds_and_saves_effort(plan):
    """Fig. 3: folded, the arm is easier to lift. The paper's 73.6 come down to 9.9, in a minimum of its own."""
    assert np.abs(plan.xs[:, 1]).max() > 1.0
    assert effort(plan.problem, plan.us) < 0.3 * effort(plan.problem, plan.problem.first_guess)


@pytest.mark.paper
def test_several_starts_find_less_effort(plan):
    """The paper calls its 9.9 locally optimal: below that there are others."""
    best = planner.solve(planner.cases.two_link(), starts=8)
    assert best.converged
    assert best.cost < min(9.9, 0.6 * plan.cost)
    assert {start.status for start in best.starts} == {planner.Status.CONVERGED}  # by the line of states


def test_the_miss_is_the_price_of_a_radian_over_the_weight():
    """What the tolerance of the goal is derived from: with heavy weights, twice the weight is half the miss."""
    missed = []
    for weight in (2000.0, 4000.0):
        plan = planner.solve(planner.cases.two_link(position_weight=weight, velocity_weight=weight))
        assert plan.success
        missed.append(np.abs(plan.xs[-1] - [*UPRIGHT, 0, 0])[:2])
    np.testing.assert_allclose(missed[0] / missed[1], 2.0, rtol=0.05)


def test_a_heavier_arm_moves_alike():
    """Three times the mass is three times the torque: with a ninth of the weight on effort, the same motion."""
    light = planner.cases.two_link(horizon=50)
    heavy = planner.cases.two_link(horizon=50, mass1=1.5, mass2=1.5, effort_weight=1.0 / 9.0)
    np.testing.assert_allclose(heavy.first_guess, 3.0 * light.first_guess, rtol=1e-12, atol=1e-12)
    plans = planner.solve(light), planner.solve(heavy)
    np.testing.assert_allclose(plans[1].xs, plans[0].xs, atol=1e-4)
    np.testing.assert_allclose(plans[1].us, 3.0 * plans[0].us, atol=1e-3)


@pytest.mark.parametrize("model", ["two_link", "acrobot"])
def test_the_case_simulates_the_file(model):
    """With the file's own numbers the edited text is the file, down to what is only seen."""
    ours = mujoco.MjModel.from_xml_string(arm_text(model, Links(0.5, 0.5, 1.0, 1.0, 9.81)))
    file = mujoco.MjModel.from_xml_path(str(model_path(model) / "scene.xml"))
    for name in ("body_mass", "body_inertia", "body_ipos", "body_pos", "geom_pos", "geom_size", "geom_quat", "site_pos",
                 "site_size", "light_pos"):  # fmt: skip
        np.testing.assert_allclose(getattr(ours, name), getattr(file, name), rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(ours.opt.gravity, file.opt.gravity)
    np.testing.assert_allclose([*ours.stat.center, ours.stat.extent], [*file.stat.center, file.stat.extent])


def test_the_twin_has_the_parameters_of_the_case():
    problem = planner.cases.two_link(**LINKS)
    assert problem.twin is not None
    model = mujoco.MjModel.from_xml_string(problem.twin.mjcf)
    np.testing.assert_array_equal(model.body_mass[1:3], [0.7, 0.4])
    np.testing.assert_array_equal(model.opt.gravity, [0, 0, -3.7])
    data = mujoco.MjData(model)
    data.qpos[:] = [0.4, -0.9]
    mujoco.mj_kinematics(model, data)
    tip = [0.8 * np.cos(0.4) + 1.3 * np.cos(-0.5), 0.0, 0.8 * np.sin(0.4) + 1.3 * np.sin(-0.5)]
    np.testing.assert_allclose(data.site("tip").xpos, tip, atol=1e-12)
    hand = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "hand")
    np.testing.assert_allclose(data.geom_xpos[hand], tip, atol=1e-12)
    np.testing.assert_allclose(model.site("target").pos, [0, 0, 2.1])
    assert planner.parity(problem).passed


def test_parameters_rebuild_the_problem(plan, tmp_path):
    plan.save(tmp_path / "p.npz")
    stored = planner.load_plan(tmp_path / "p.npz")
    assert stored.problem is not None
    assert stored.problem.parameters == plan.problem.parameters
    assert stored.problem.cost.value(stored.xs, stored.us) == pytest.approx(plan.cost, rel=1e-13)


@pytest.mark.parametrize(
    ("parameters", "fragment"),
    [
        ({"mass1": 0.0}, "mass1 is 0.0"),
        ({"length2": float("nan")}, "length2 is nan"),
        ({"gravity": -9.81}, "gravity is -9.81"),
        ({"duration": 0.0}, "duration is 0.0"),
        ({"horizon": 0}, "horizon is 0"),
        ({"guess": "best"}, "expected one of: paper, zero"),
        ({"integrator": "rk5"}, "semi-implicit-euler"),
        ({"effort_weight": 0.0}, "effort_weight is 0.0"),
        ({"position_weight": -1.0}, "position_weight is -1.0"),
    ],
    ids=str,
)
def test_bad_parameters_are_named(parameters, fragment):
    with pytest.raises(planner.PlannerError, match=fragment):
        planner.cases.two_link(**parameters)


@pytest.mark.render
def test_the_film_shows_arm_ghost_goal_and_trail(plan):
    """Each changes the picture; the trail is the path of the tip, and longer later."""
    replay = planner.replay(plan)
    stage = plan.problem.appearance

    def picture(**changes):
        shown = replace(plan, problem=replace(plan.problem, appearance=replace(stage, **changes)))
        return planner.render_frame(replace(replay, plan=shown), 1.5, width=240, height=136).astype(int)

    full = picture()
    for changes in ({"trail": ""}, {"goal_line": None}, {"ghost_offset": (0.0, 0.0, 0.0)}, {"readouts": ()}):
        assert np.count_nonzero(np.abs(full - picture(**changes)).max(axis=2) > 40) > 25, changes
