"""What plans keep: against SciPy, by the conditions of Karush, Kuhn and Tucker; what cannot be kept, or asked."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import minimize
from solves import rollout

import planner
from planner import Constraint, FunctionDynamics, Limits, PlannerError, Problem, Status, TrackingCost, prove, solve
from planner.cases import build
from planner.constraints import FrameAxisAngle, FramePosition, Power
from planner.costs import Height, Point, with_objective
from planner.problem.objective import solver_problem
from planner.problem.rediscretize import finer

DT, N = 0.1, 15


def point(constraints=(), limits=None, duration=N * DT, **more):
    """A point mass in the plane from rest at (0, 0) to rest at (1, 1), nearly."""
    dynamics = FunctionDynamics(lambda x, u: np.concatenate([x[..., 2:], u], axis=-1), 4, 2, duration / N, "rk4")
    goal = [1.0, 1.0, 0.0, 0.0]
    cost = TrackingCost.reach(goal, N, final=[50.0, 50.0, 5.0, 5.0], effort=[0.1, 0.1], dt=duration / N)
    return Problem(dynamics, cost, np.zeros(4), constraints=constraints, limits=limits, **more)


def post(xs):
    return np.hypot(xs[:, 0] - 0.5, xs[:, 1] - 0.4)


def given_power(xs, us):
    return np.sum(us * xs[:, 2:], axis=1)


POST = Constraint(post, lower=0.3, name="post", unit="m")
MOST = 1.0  # W, with which the mass comes 1.7 m far in that time: enough, and less than it would take if it could
POWER = Constraint(given_power, upper=MOST, name="power", unit="W")
THERE = Constraint(lambda xs: xs[:, :2], equal=[1.0, 1.0], when="end", name="there")
TASKS = {"post": [POST], "power": [POWER], "there": [THERE], "all": [POST, POWER, THERE]}


def worst(problem, plan):
    """(value, allowed) of each constraint."""
    found = problem.trajectory_constraints.rows.violations(plan.xs, plan.us)
    return {one.constraint.name: (one.value, one.constraint.allowed()) for one in found}


@pytest.mark.parametrize("task", TASKS)
def test_scipy_finds_no_better_plan_that_keeps_the_constraints(task):
    problem = point(TASKS[task])
    plan = solve(problem)
    assert plan.status is Status.CONVERGED, plan.message
    assert all(value <= allowed for value, allowed in worst(problem, plan).values())

    def flat(z):
        us = z.reshape(N, 2)
        return rollout(problem, us)

    def at_least_zero(z):
        xs, us = flat(z)
        found = []
        if POST in problem.constraints:
            found.append(post(xs)[1:] - 0.3)
        if POWER in problem.constraints:
            found += [MOST - given_power(xs[:-1], us), MOST - given_power(xs[1:], us)]
        return np.concatenate([np.empty(0), *found])

    kinds = [{"type": "ineq", "fun": at_least_zero}] if task != "there" else []
    if THERE in problem.constraints:
        kinds.append({"type": "eq", "fun": lambda z: flat(z)[0][-1, :2] - 1.0})
    theirs = minimize(
        lambda z: problem.cost.value(*flat(z)), plan.us.ravel(), method="SLSQP", constraints=kinds,
        options={"maxiter": 300, "ftol": 1e-10},
    )  # fmt: skip
    assert theirs.success
    # each violation of ours, at most 1e-4 of a unit, is worth its multiplier, which is below 50 here
    assert plan.cost == pytest.approx(theirs.fun, abs=50 * 1e-4)


@pytest.mark.parametrize("task", TASKS)
def test_conditions_of_karush_kuhn_and_tucker(task):
    problem = point(TASKS[task])
    plan = solve(problem)
    rows, multipliers = (
        problem.trajectory_constraints.rows,
        problem.trajectory_constraints.multipliers(plan.bound_penalties, plan.xs, plan.us),
    )
    together = np.concatenate(multipliers, axis=1) / rows.scale  # J per scaled row, in the order of the columns
    h = 1e-6

    def lagrangian(us):
        xs, _ = rollout(problem, us)
        return problem.cost.value(xs, us) + np.sum(together * rows.values(xs, us))

    gradient = np.zeros_like(plan.us)
    for i in np.ndindex(*plan.us.shape):
        d = np.zeros_like(plan.us)
        d[i] = h
        gradient[i] = (lagrangian(plan.us + d) - lagrangian(plan.us - d)) / (2.0 * h)
    # what a solve goes on for: 1e-10 of a decrease, with curvatures of up to 1e4 where hinges are steep
    assert np.linalg.norm(gradient) < 1e-2 * np.linalg.norm(problem.cost.quadratize(plan.xs, plan.us).r)
    assert np.abs(together).max() > 0.0  # a constraint that holds nothing would test nothing
    e = rows.values(plan.xs, plan.us)
    above, below = together > 0.0, together < 0.0
    assert np.isfinite(rows.upper[above]).all()
    assert np.isfinite(rows.lower[below]).all()
    # a bound that pulls is one that the motion is at
    assert np.all(np.abs(e - rows.upper)[above] <= 1.5 * problem.trajectory_constraints.tolerance)
    assert np.all(np.abs(e - rows.lower)[below] <= 1.5 * problem.trajectory_constraints.tolerance)


def test_a_multiplier_is_what_a_looser_bound_saves():
    tight, loose = (point([Constraint(post, lower=radius, name="post")]) for radius in (0.3, 0.299))
    plan, other = solve(tight), solve(loose)
    price = -sum(
        float(one.sum()) for one in tight.trajectory_constraints.multipliers(plan.bound_penalties, plan.xs, plan.us)
    )
    # a step of 1e-3 is a hundred times the tolerance that the motion of the two may be off by, and curvature is small
    assert plan.cost - other.cost == pytest.approx(1e-3 * price, rel=0.15)
    assert price > 0.0


def test_constraints_ranges_and_bounds_hold_together():
    problem = point([POST], Limits(control=4.0, state={0: (-0.05, 0.9)}))
    plan = solve(problem)
    assert plan.success, plan.message
    assert np.abs(plan.us).max() <= 4.0
    assert plan.xs[:, 0].max() <= 0.9 + 1e-4
    assert worst(problem, plan)["post"][0] <= 1e-4


def test_free_where_it_is_not_asked_for():
    line = Constraint(lambda xs: xs[:, 1], upper=0.2, when=(0.0, 0.8))
    plan = solve(point([line]))
    n = np.arange(N + 1)
    assert plan.xs[n * DT <= 0.8 + 1e-9, 1].max() == pytest.approx(0.2, abs=2e-4)
    assert plan.xs[-1, 1] > 0.9
    bounds = np.where(n < 8, 0.2, np.nan)[:, None]
    same = solve(point([Constraint(lambda xs: xs[:, 1], upper=bounds)]))
    assert np.abs(same.xs[:8, 1]).max() <= 0.2 + 1e-4


def test_nothing_violated_costs_nothing():
    free, kept = solve(point()), solve(point([Constraint(post, lower=0.01)]))
    assert kept.bound_penalties is None
    assert np.array_equal(free.us, kept.us)


def test_given_derivatives_are_used():
    def by_x(xs):
        d = xs[:, :2] - [0.5, 0.4]
        return np.concatenate([d, 0.0 * d], axis=1)[:, None] / np.linalg.norm(d, axis=1)[:, None, None]

    plan, other = (solve(point([one])) for one in (POST, dataclasses.replace(POST, derivatives=by_x)))
    assert other.us == pytest.approx(plan.us, abs=1e-4)
    wrong = dataclasses.replace(POST, derivatives=lambda xs: np.zeros((len(xs), 2, 4)))
    with pytest.raises(PlannerError, match="derivatives have shape"):
        solve(point([wrong]))


def test_what_stays_broken_is_given_up_while_it_is_cheap():
    """Walls on both sides of the end: no price brings the violation below half of the distance between them."""
    left = Constraint(lambda xs: xs[:, 0], lower=0.9, name="left", unit="m")
    right = Constraint(lambda xs: xs[:, 0], upper=0.1, name="right", unit="m")
    late = [dataclasses.replace(one, when="end") for one in (left, right)]
    plan = solve(point(late))
    assert plan.status is Status.OUTSIDE_LIMITS
    assert plan.nit < 20  # 14 lines; 39 in all thirty rounds


def test_what_cannot_be_kept_ends_with_its_name_and_a_plan(tmp_path):
    wall = Constraint(lambda xs: xs[:, 0], upper=0.5, name="wall", unit="m")
    plan = solve(point([wall, THERE]), max_iterations=400)
    assert plan.status in (Status.OUTSIDE_LIMITS, Status.MAX_ITERATIONS, Status.NO_DESCENT)
    assert np.isfinite(plan.xs).all()
    plan = dataclasses.replace(plan, status=Status.OUTSIDE_LIMITS)
    assert "the constraint 'wall' is broken by" in plan.message
    assert "the constraint 'there' is broken by" in plan.message
    assert "at t = 1.5 s" in plan.message
    with pytest.warns(UserWarning, match="without its problem"):
        plan.save(tmp_path / "plan.npz")
    again = planner.load_plan(tmp_path / "plan.npz", problem=plan.problem)
    assert again.message == plan.message


def test_a_finer_step_keeps_them():
    bounds = np.full((N + 1, 1), 0.3)
    problem = finer(point([Constraint(post, lower=bounds), THERE]))
    assert problem.N == 2 * N
    plan = solve(problem)
    assert plan.success
    assert all(value <= allowed for value, allowed in worst(problem, plan).values())


def arm(constraints):
    base = build("two-link")
    return Problem(
        base.dynamics, base.cost, base.x0, us=base.us, constraints=constraints, twin=base.twin, tolerance=base.tolerance
    )


def test_power_of_a_motor_is_kept_and_proved():
    """At both ends of a stage, so between knots too: the proof looks at every step of the simulator."""
    problem = arm([Constraint(Power("shoulder"), upper=15.0), Constraint(Power("elbow"), upper=15.0)])
    plan = solve(problem)
    assert plan.success, plan.message
    proof = prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    for section in (proof.plan, proof.refined_open_loop, proof.your_file):
        judged = [one for one in section.measured if one.name.startswith("power_of")]
        assert [one.unit for one in judged] == ["W", "W"]
        # 1 % of the bound; kept at the starts of stages alone the file would be 7 W beyond
        assert all(one.bound is not None and one.value <= 0.15 for one in judged)
    free = solve(arm([]))
    assert worst(problem, free)["power of shoulder"][0] > 5.0


def test_an_objective_of_jerk_keeps_them():
    """Its states are longer by the last accelerations and their rates."""
    problem = with_objective(arm([Constraint(Power("elbow"), upper=1.0)]), {"effort": 1.0, "jerk": 1e-5})
    hinges = problem.trajectory_constraints.zero_penalties()
    longer = solver_problem(problem)
    assert longer.dynamics.nx == 8
    xs = np.concatenate([solve(arm([])).xs, np.zeros((problem.N + 1, 4))], axis=1)
    A, B = longer.dynamics.linearize(xs, problem.first_guess)
    weighed = hinges._replace(weight=np.isfinite(hinges.upper).astype(float))
    n, by_z, _, _ = longer.trajectory_constraints.penalty_derivatives(weighed, xs, problem.first_guess, A, B)
    assert len(n) > 0
    assert by_z.shape[2] == 10
    assert not by_z[:, 0, 4:8].any()  # the power at the start of a stage knows nothing of the last acceleration


def test_a_plan_that_breaks_a_constraint_fails():
    free = solve(arm([]))
    problem = arm([Constraint(Height(Point("forearm"), upper=0.5, tolerance=1e-3))])
    proof = prove(dataclasses.replace(free, problem=problem), rollouts=0, optimal=False)
    assert not proof.passed
    assert "height of forearm" in proof.reason


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Constraint(post), "has no bound"),
        (lambda: Constraint(post, equal=0.0, lower=0.0), "expected equal alone"),
        (lambda: Constraint(3.0, lower=0.0), "expected a term of planner.costs"),
        (lambda: Constraint(post, lower=np.inf), "expected finite numbers"),
        (lambda: Constraint(post, lower=0.1, when=(2.0, 1.0)), "which rise"),
        (lambda: Constraint(post, lower=0.1, when="later"), "has when = 'later'"),
        (lambda: Constraint(post, lower=0.1, tolerance=0.0), "tolerance"),
        (lambda: Constraint(Height(Point("a"), upper=1.0, tolerance=0.1), upper=2.0), "expected it in the term"),
        (lambda: point([Constraint(post, lower=1.0, upper=0.5)]), "lower = 1 above upper = 0.5"),
        (lambda: point([Constraint(post, lower=0.9, name="post")]), "the start breaks the constraint 'post'"),
        (lambda: point([Constraint(given_power, upper=1.0, when="end")]), "there are none"),
        (lambda: point([Constraint(lambda xs: xs[0], lower=0.0)]), "one number or one row for each"),
        (lambda: point([Constraint(lambda xs: xs[:, 9], lower=0.0)]), "fails on 2 states at once"),
        (lambda: point([Constraint(post, lower=[0.1, 0.2])]), "a bound of shape"),
        (lambda: point([Constraint(post, lower=0.1, when=(7.0, 8.0))]), "expected a time with a knot"),
        (lambda: point([Constraint(post, lower=0.2), Constraint(post, upper=0.1, when=(0.5, 1.0))]), "leave something"),
        (
            lambda: point([Constraint(post, lower=0.9), Constraint(post, upper=0.1)]),
            "leave something",
        ),  # no start would do
        (lambda: point([Constraint(Power("elbow"), upper=1.0)]), "expected dynamics with a mechanism"),
        (lambda: point([post]), "expected a list of planner.Constraint"),
        (lambda: arm([Constraint(Power("elbo"), upper=1.0)]), "Did you mean 'elbow'"),
        (
            lambda: arm([Constraint(FramePosition("hand"), equal=0.0)]),
            "a constraint's frame is 'hand', expected one of",
        ),
        (lambda: FrameAxisAngle("a", direction=[0.0, 0.0, 0.0]), "all zeros"),
    ],
)
def test_what_is_asked_wrongly_is_one_sentence(make, words):
    with pytest.raises(PlannerError, match=words) as raised:
        make()
    assert "\n" not in str(raised.value)
