"""Case 2: the arm of case 1 without its shoulder motor; both starts converge and are proved."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from solves import first_rollout

import planner
from planner.base.gl import load_mujoco

mujoco = load_mujoco()


@pytest.fixture(scope="module", params=["paper", "hanging"])
def plan(request):
    return planner.solve(planner.cases.acrobot(start=request.param))


def test_it_is_the_arm_of_case_1_without_the_shoulder_motor():
    arm, acrobot = planner.cases.two_link().dynamics, planner.cases.acrobot().dynamics
    rng = np.random.default_rng(2)
    x, u = rng.normal(scale=2.0, size=(30, 4)), rng.normal(size=(30, 1))
    assert acrobot.nu == 1
    np.testing.assert_allclose(acrobot.rates(x, u), arm.rates(x, np.hstack([0 * u, u])), rtol=1e-13, atol=1e-13)


@pytest.mark.paper
def test_starts_are_the_papers():
    np.testing.assert_array_equal(planner.cases.acrobot().x0, [-1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(planner.cases.acrobot(start="hanging").x0, [-np.pi / 2, 0.0, 0.0, 0.0])


@pytest.mark.paper
def test_the_first_guess_falls_like_a_rigid_pendulum():
    """The paper held the elbow: the arm is then a rod of 1 kg and 2 m about its end."""
    problem = planner.cases.acrobot(horizon=1200)
    xs = first_rollout(problem)
    t = problem.dynamics.dt * np.arange(problem.N + 1)
    length, g = 2.0, 9.81

    def pendulum(_, y):
        return [y[1], -1.5 * g / length * np.cos(y[0])]

    exact = solve_ivp(pendulum, (0.0, t[-1]), [-1.0, 0.0], t_eval=t, rtol=1e-10, atol=1e-12).y
    half = len(t) // 2  # later the elbow, which nothing holds but the torque, begins to give
    np.testing.assert_allclose(xs[:half, 0], exact[0, :half], atol=2e-3)
    assert np.abs(xs[:half, 1]).max() < 5e-3
    free = np.abs(first_rollout(planner.cases.acrobot(horizon=1200, guess="zero"))[:half, 1]).max()
    assert free > 0.1


def test_hanging_stays_where_it_is_without_a_push():
    """Why the first guess from there is a sine: with u = 0, or the elbow held, nothing moves."""
    for guess in ("zero", "paper"):
        xs = first_rollout(planner.cases.acrobot(start="hanging", guess=guess))
        np.testing.assert_allclose(xs, np.tile(xs[0], (len(xs), 1)), atol=1e-12)
    assert np.ptp(first_rollout(planner.cases.acrobot(start="hanging"))[:, 0]) > 1e-3


def test_both_starts_converge_and_pass(plan):
    assert plan.success, plan.message
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    assert np.abs(proof.replay.xs[-1] - [np.pi / 2, 0, 0, 0]).max() < 0.1


@pytest.mark.paper
def test_the_elbow_pumps_the_energy(plan):
    """Fig. 4: the lower link pumps. All energy that is gained is the elbow's work, u times the angle it turned."""
    model = mujoco.MjModel.from_xml_string(plan.twin.mjcf)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    energies = []
    for x in (plan.xs[0], plan.xs[-1]):
        data.qpos[:], data.qvel[:] = x[:2], x[2:]
        mujoco.mj_forward(model, data)
        energies.append(np.sum(data.energy))
    work = np.sum(plan.us[:, 0] * np.diff(plan.xs[:, 1]))
    assert energies[1] - energies[0] == pytest.approx(work, rel=1e-4)
    assert work > 5.0
    assert np.count_nonzero(np.diff(np.sign(plan.xs[:, 3]))) >= 3  # to and fro


def test_parameters_rebuild_the_problem(tmp_path):
    problem = planner.cases.acrobot(start="hanging", duration=1.0, horizon=20, mass2=0.6)
    plan = planner.solve(problem, max_iterations=3)
    plan.save(tmp_path / "p.npz")
    stored = planner.load_plan(tmp_path / "p.npz").problem
    assert stored is not None
    assert stored.parameters == problem.parameters
    np.testing.assert_array_equal(stored.first_guess, problem.first_guess)


@pytest.mark.parametrize(
    ("parameters", "fragment"),
    [
        ({"start": "up"}, "expected one of: paper, hanging"),
        ({"guess": "good"}, "expected one of: paper, zero, sine"),
        ({"duration": float("inf")}, "duration is inf"),
        ({"mass2": -1.0}, "mass2 is -1.0"),
    ],
    ids=str,
)
def test_bad_parameters_are_named(parameters, fragment):
    with pytest.raises(planner.PlannerError, match=fragment):
        planner.cases.acrobot(**parameters)
