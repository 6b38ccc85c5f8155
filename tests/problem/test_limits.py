"""Limits: the minimum over a box, bounded solves, ranges and exact goals by augmented Lagrangian, refusals."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from carts import refuse, write
from engines import assert_same_iterations, both_engines
from scipy.optimize import Bounds, NonlinearConstraint, minimize
from solves import pendulum, reduced_hessian, rollout

import planner
from planner import FunctionDynamics, Limits, PlannerError, Problem, Status, TrackingCost, cases
from planner.cases.problem_file import load
from planner.proof.consistency import consistency, recomputed
from planner.solvers import lq
from planner.solvers.engine import NumpyEngine
from planner.solvers.options import SolverOptions

TOLERANCE = 1e-14  # of the cost, that the last model promises


def two_link(limits=None, horizon=100, **parameters):
    return replace(cases.two_link(horizon=horizon, **parameters), limits=limits)


def bounded():
    """A two-link whose both motors are at a bound for a part of the motion: seven tenths of what it would ask for."""
    most = 0.7 * np.abs(planner.solve(two_link()).us).max(axis=0)
    return two_link(Limits(control=(-most, most)))


@pytest.fixture(scope="module")
def plan():
    return planner.solve(bounded(), states="line", expected_reduction_tolerance=TOLERANCE)


def by_active_sets(H, h, lower, upper):
    """The minimum over the box by trying every set of controls at lower and upper bounds."""
    best = np.inf, None
    for sides in product((-1, 0, 1), repeat=len(h)):
        k, sides = np.where(np.array(sides) < 0, lower, upper), np.array(sides)
        free = sides == 0
        k[free] = -np.linalg.solve(H[np.ix_(free, free)], h[free] + H[np.ix_(free, ~free)] @ k[~free])
        if np.all((k >= lower - 1e-12) & (k <= upper + 1e-12)):
            best = min(best, (0.5 * k @ H @ k + h @ k, tuple(k)))
    return np.array(best[1])


@pytest.mark.parametrize("seed", range(40))
def test_the_minimum_over_a_box_is_that_of_all_active_sets(seed):
    rng = np.random.default_rng(seed)
    nu = rng.integers(1, 6)
    A = rng.normal(size=(nu, nu))
    H, h = A @ A.T + 10.0 ** rng.uniform(-3, 0) * np.eye(nu), 3.0 * rng.normal(size=nu)
    lower, upper = -rng.uniform(0.0, 1.0, nu), rng.uniform(0.0, 1.0, nu)
    lower[rng.random(nu) < 0.2] = 0.0  # a control that is at its bound already
    k, clamped = lq.solve_box_qp(H, h, lower, upper)
    np.testing.assert_allclose(k, by_active_sets(H, h, lower, upper), atol=1e-8)
    assert np.all((k[clamped] == lower[clamped]) | (k[clamped] == upper[clamped]))
    scipy = minimize(lambda k: 0.5 * k @ H @ k + h @ k, np.zeros(nu), jac=lambda k: H @ k + h, method="L-BFGS-B",
                     bounds=Bounds(lower, upper), options={"ftol": 1e-15, "gtol": 1e-10})  # fmt: skip
    assert 0.5 * k @ H @ k + h @ k <= scipy.fun + 1e-10


def test_an_indefinite_quadratic_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        lq.solve_box_qp(np.array([[1.0, 2.0], [2.0, 1.0]]), np.zeros(2), -np.ones(2), np.ones(2))


def test_bounds_hold_exactly_and_the_end_is_stationary(plan):
    """Karush, Kuhn and Tucker: the gradient (Eq. 19) vanishes where controls are free, and pushes out elsewhere.

    As far as it is told by what is left to gain, 1/2 g' H^-1 g, of which a solve leaves its tolerance: eigenvalues of H
    are many powers of ten apart, so that gradients themselves may be left of very different sizes.
    """
    problem = plan.problem
    lower, upper = problem.bounds.lower, problem.bounds.upper
    assert plan.success
    assert np.all((plan.us >= lower) & (plan.us <= upper))
    low, high = plan.us == lower, plan.us == upper
    assert low.any() or high.any()
    A, B = problem.dynamics.linearize(plan.xs, plan.us)
    model = problem.cost.quadratize(plan.xs, plan.us)
    gradient = lq.gradient(A, B, model)
    free, H = (~low & ~high).ravel(), reduced_hessian(A, B, model)
    left = 0.5 * gradient.ravel()[free] @ np.linalg.solve(H[np.ix_(free, free)], gradient.ravel()[free])
    assert left < TOLERANCE * plan.cost
    most = np.sqrt(2.0 * TOLERANCE * plan.cost * np.linalg.eigvalsh(H)[-1])  # of a gradient that promises so little
    assert gradient[low].min(initial=np.inf) > -most
    assert gradient[high].max(initial=-np.inf) < most
    assert np.abs(gradient[low | high]).max() > 10.0 * most  # so that the signs above tell something
    assert np.all(plan.K[low | high] == 0.0) or np.abs(gradient[low | high]).min() < most


@pytest.mark.parametrize("share", [0.6, 0.7, 0.75, 0.8, 0.9])
def test_less_torque_than_a_free_plan_has_is_planned_with(share):
    """Without states held at short steps three of these crept along their bounds to the limit of 1000 iterations."""
    free = planner.solve(two_link())
    most = share * np.abs(free.us).max(axis=0)
    plan = planner.solve(two_link(Limits(control=(-most, most))))
    assert plan.converged  # some of these minima miss the goal a little
    assert plan.nit < 300


def test_bounds_far_away_change_nothing():
    free, far = planner.solve(two_link()), planner.solve(two_link(Limits(control=1e6)))
    assert far.nit == free.nit
    np.testing.assert_allclose(far.us, free.us, atol=1e-12 * np.abs(free.us).max())
    np.testing.assert_allclose(far.K, free.K, atol=1e-10 * np.abs(free.K).max())


@pytest.mark.parametrize("integrator", ["semi-implicit-euler", "rk4"])
@pytest.mark.parametrize("feedback", [True, False])
def test_compiled_and_numpy_engines_take_the_same_steps(integrator, feedback):
    problem = two_link(Limits(control=(-5.0, 4.0), velocity=3.0, final="exact"), 50, integrator=integrator)
    rng = np.random.default_rng(1)
    hinges = problem.trajectory_constraints.zero_penalties()  # of ranges alone
    hinges = hinges._replace(weight=rng.uniform(1.0, 100.0, hinges.weight.shape))
    us = rng.normal(size=(problem.N, 2)) * 4.0
    assert_same_iterations(
        both_engines(problem), problem, [feedback] * 4, us=us, penalties=hinges, mus=[1e-3] * 4, within=1e-7
    )


def test_the_slope_is_that_of_the_clipped_rollout():
    """Eq. 42's place with bounds: the cost of a short step falls as the slope says, from either side of a kink."""
    problem = bounded()
    engine = NumpyEngine(problem)
    cost = engine.start_from_controls(problem.x0, 3.0 * np.sin(np.arange(2 * problem.N)).reshape(-1, 2) * 4.0)
    xs, us = engine.trajectory()
    done, step = engine.iterate(True, 0, 1.0, True, cost, 0.0, -1.0), 1e-7
    sweep = engine._sweep
    _, J = engine._rollout(problem.x0, (us + step * sweep.k)[:, None], sweep.K, xs)
    assert (J[0] - cost) / step == pytest.approx(done.slope, rel=1e-4)


def test_the_hinge_and_its_derivatives():
    problem = two_link(Limits(velocity=1.0, position={"elbow": (-0.3, 0.2)}, final="exact"), 20)
    ranges, rng = problem.ranges, np.random.default_rng(3)
    xs = rng.normal(size=(21, 4))
    hinges = problem.trajectory_constraints.zero_penalties()  # of ranges alone
    hinges = hinges._replace(weight=rng.uniform(1.0, 5.0, hinges.weight.shape))
    zero = problem.cost.quadratize(xs, np.zeros((20, 2)))
    model = ranges.with_penalties(hinges, zero._replace(Q=0.0 * zero.Q, q=0.0 * zero.q), xs)
    step = 1e-6
    for n, i in product((3, 20), range(4)):
        ends = []
        for sign in (1.0, -1.0):
            moved = xs.copy()
            moved[n, i] += sign * step
            ends.append((ranges.value(hinges, moved), ranges.with_penalties(hinges, zero, moved).q[n] - zero.q[n]))
        slopes = (ends[0][0] - ends[1][0]) / (2 * step)
        assert model.q[n, i] == pytest.approx(slopes, rel=1e-5, abs=1e-6)
        curvature = (ends[0][1] - ends[1][1]) / (2 * step)
        np.testing.assert_allclose(model.Q[n, i], curvature, atol=1e-4)


def lifted_pendulum(limits, N=20):
    """A torque-driven pendulum from hanging to 1 rad, small enough for SciPy."""
    dynamics = FunctionDynamics(pendulum, 2, 1, 0.05, "rk4")
    cost = TrackingCost.reach([1.0, 0.0], N, final=[10.0, 10.0], effort=1.0, dt=0.05)
    return Problem(dynamics, cost, np.zeros(2), us=np.full((N, 1), 2.0), limits=limits)


@pytest.mark.slow
def test_an_augmented_lagrangian_against_slsqp():
    limits = Limits(control=4.9, state={1: (-0.1, 1.4)}, final="exact", tolerance=1e-6)
    problem = lifted_pendulum(limits)
    plan = planner.solve(problem, SolverOptions(max_tightenings=0))  # SLSQP knows the knots alone
    assert plan.success
    assert np.abs(plan.xs[-1] - [1.0, 0.0]).max() <= 1e-6
    assert plan.xs[:, 1].max() == pytest.approx(1.4, abs=1e-6)
    assert (plan.us == 4.9).any()

    def xs(us):
        return rollout(problem, us.reshape(-1, 1))[0]

    scipy = minimize(
        lambda us: problem.cost.value(xs(us), us.reshape(-1, 1)), plan.us.ravel() * 0.9, method="SLSQP",
        bounds=Bounds(-4.9, 4.9), options={"maxiter": 300, "ftol": 1e-10},
        constraints=[
            NonlinearConstraint(lambda us: xs(us)[-1], [1.0, 0.0], [1.0, 0.0]),
            NonlinearConstraint(lambda us: xs(us)[1:, 1], -0.1, 1.4),
        ],
    )  # fmt: skip
    assert scipy.success
    assert plan.cost == pytest.approx(scipy.fun, rel=1e-4)
    np.testing.assert_allclose(plan.us.ravel(), scipy.x, atol=0.02 * np.abs(plan.us).max())


def test_ranges_and_goal_of_a_mechanism():
    problem = two_link(Limits(velocity=3.0, final="exact", control=15.0))
    plan = planner.solve(problem)
    assert plan.success
    assert plan.problem.ranges.violation(plan.xs).max() <= 1e-4
    assert plan.history[-1].iteration == plan.nit
    assert plan.cost == problem.cost.value(plan.xs, plan.us)
    section = consistency(plan, problem, recomputed(plan, problem, plan.xs, plan.us))
    assert all(figure.passed for figure in section.measured), [str(f) for f in section.measured]
    names = [figure.name for figure in section.measured]
    assert {"control_violation", "velocity_range_violation", "exact_goal_violation"} <= set(names)


def test_limits_that_cannot_be_met_end_in_a_status_with_advice():
    """Nothing moves without torque: the goal stays a radian away."""
    plan = planner.solve(lifted_pendulum(Limits(control=0.01, final="exact")), max_iterations=400)
    assert plan.status in (Status.OUTSIDE_LIMITS, Status.MAX_ITERATIONS)
    assert np.abs(plan.us).max() <= 0.01
    assert "more time" in Status.OUTSIDE_LIMITS.value


def test_a_first_guess_outside_is_clipped():
    problem = replace(lifted_pendulum(Limits(control=1.0)), us=np.full((20, 1), 50.0))
    assert np.abs(planner.solve(problem, max_iterations=1).us).max() <= 1.0


def test_feedback_asks_for_no_more_than_the_bounds(plan):
    pushed = replace(plan, K=50.0 * np.ones_like(plan.K))
    run = planner.replay(pushed, feedback=True)
    lower, upper = (
        np.repeat(side, run.substeps, axis=0) for side in (plan.problem.bounds.lower, plan.problem.bounds.upper)
    )
    assert np.all((run.ctrl >= lower) & (run.ctrl <= upper))
    assert (run.ctrl == upper).any()


def test_a_file_keeps_limits_and_hinges(tmp_path):
    plan = planner.solve(two_link(Limits(velocity={"elbow": (-3.0, None)}, final=["shoulder"], control=12.0)))
    again = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert again.changed == ()
    assert again.problem.limits.to_dict() == plan.problem.limits.to_dict()
    for ours, theirs in zip(again.bound_penalties, plan.bound_penalties, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(planner.solve(again.problem).us, plan.us)


def test_limits_of_the_hopper():
    """Its states' ranges go through NumPy; the flow's bounds through its own kernel."""
    hopper = cases.hopper(height=10.0, duration=0.5, horizon=50)
    free = planner.solve(hopper)
    problem = replace(hopper, limits=Limits(control=0.5 * np.abs(free.us).max(), final=[0]))
    plan = planner.solve(problem, max_iterations=200)
    assert np.abs(plan.us).max() <= problem.limits.control
    assert plan.success
    assert problem.ranges.violation(plan.xs).max() <= 1e-4


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ({"control": (1.0, -1.0)}, r"lower bound below the upper: \(lower, upper\), each a number or a row"),
        ({"control": (np.nan, 1.0)}, "not a number"),
        ({"control": {"wrist": 1.0}}, "Did you mean|expected one of"),
        ({"control": "modle"}, "Did you mean 'model'"),
        ({"control": -1.0}, "greater than 0"),
        ({"control": (np.zeros(3), np.ones(3))}, "expected \\(2,\\)"),
        ({"position": {"wrist": (0.0, 1.0)}}, "expected one of"),
        ({"position": {"elbow": (1.0, 0.5)}}, "lower bound below the upper"),
        ({"position": {"elbow": (0.5, 1.0)}}, "the start has elbow at 0 rad, expected 0.5 ... 1 rad: write 0.5"),
        ({"position": {"elbow": 1.0}, "final": "all"}, "expected one of: exact"),
        ({"velocity": 0.0}, "greater than 0"),
        ({"state": {9: (0.0, 1.0)}}, "expected an index of 0 to 3"),
        ({"final": ["wrist"]}, "expected one of"),
        ({"tolerance": 0.0}, "tolerance"),
    ],
)
def test_limits_that_are_refused(limits, words):
    with pytest.raises(PlannerError, match=words):
        two_link(Limits(**limits))


LIMITS = """
[limits]
control = { push = 6.0 }
velocity = { slider = [-1.0, 3.0] }
position = { pole = [-0.5, 0.5] }
final = "exact"
"""


def test_limits_of_a_problem_file(tmp_path):
    plan = planner.solve(load(write(tmp_path, LIMITS, duration="2.0")).problem)
    assert plan.success
    assert np.abs(plan.us).max() <= 6.0
    assert np.abs(plan.xs[:, 1]).max() <= 0.5 + 1e-4
    assert np.abs(plan.xs[-1] - [1.0, 0.0, 0.0, 0.0]).max() <= 1e-4
    again = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert again.problem.limits.to_dict() == plan.problem.limits.to_dict()
    refuse(write(tmp_path, "[limits]\nspeed = 1.0"), "[limits]", "'speed'", "velocity")
    refuse(write(tmp_path, "[limits]\ncontrol = {pull = 1.0}"), "'pull'", "push")
    refuse(write(tmp_path, "[limits]\nvelocity = 'fast'"), "velocity", "'fast'")


def test_the_figure_shows_bounds(tmp_path, plan):
    """Dotted bounds of each control, but those that it stays far from, and a shade for each time that it is at one."""
    from planner.view.plots.plan import draw_plan

    figure = draw_plan(plan, None)
    dotted = [line for axes in figure.axes for line in axes.lines if line.get_linestyle() == ":"]
    assert len({line.get_color() for line in dotted}) == 2
    shades = sum(len(axes.patches) for axes in figure.axes)
    assert shades > 0
