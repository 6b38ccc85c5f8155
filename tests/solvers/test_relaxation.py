"""Limits that trap a solve are widened and tightened again; else a duration in which they hold is named."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import swings

import planner
from planner import Limits, PlannerError, Problem, RigidBodyDynamics, SolverOptions, Status, TrackingCost
from planner.proof.diagnostics import suggested_fixes
from planner.solvers import relaxation, slq
from planner.solvers.continuation import (
    FALL_ITERATIONS,
    Continuation,
    RelaxationStep,
    WiderLimits,
    at_limits,
    free_problem,
    share_at_limits,
)
from planner.solvers.multistart import smooth
from planner.solvers.other_guesses import other_guesses, stabilizing_guess
from planner.solvers.relaxation import relax
from planner.solvers.trapped import FEW, lacks_weight
from planner.solvers.work import WorkBudget, work_of_stage

EXAMPLES = Path(__file__).parents[2] / "examples"
POLES = """<mujoco><option><flag contact="disable"/></option><worldbody><body name="cart">
<joint name="cart" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/>
<body name="pole0"><joint name="pole0" axis="0 1 0"/>
<geom type="capsule" size="0.02" mass="0.2" fromto="0 0 0 0 0 -0.5"/>
<body name="pole1" pos="0 0 -0.5"><joint name="pole1" axis="0 1 0"/>
<geom type="capsule" size="0.02" mass="0.2" fromto="0 0 0 0 0 -0.5"/></body></body></body></worldbody>
<actuator><motor joint="cart"/></actuator></mujoco>"""
DT = 0.05
DIRECT = SolverOptions(homotopy=False)


def swing_up(duration, torque=None, **more):
    """A pendulum of 1 kg and 1 m from hanging to upright; 9.81 N m would lift it at once."""
    machine, N = swings.mechanism(), round(duration / DT)
    dynamics = RigidBodyDynamics(machine, DT, "rk4")
    weights = {"final_position": 1e4, "final_velocity": 1e3, "effort": 1.0}
    cost = TrackingCost.joints(machine, [np.pi, 0.0], N, dt=DT, **weights)
    limits = Limits(control=torque, **more) if torque or more else None
    return Problem(dynamics, cost, x0=[0.0, 0.0], twin=planner.Twin.of(machine), limits=limits)


def relaxation_of(problem, direct=None):
    """The plan and the record of a relaxation, whatever the direct solve leads to; by default one that was cut."""
    options = DIRECT.for_problem(problem)
    direct = planner.solve(problem, DIRECT, max_iterations=2) if direct is None else direct
    return relax(problem, direct, slq._solve_from_guess, options, None)


@pytest.fixture(scope="module")
def weak():
    return planner.solve(swing_up(2.0, 5.0))


def test_a_solve_that_meets_its_goal_stays_as_it_is_bit_for_bit():
    problem = swing_up(4.0, 3.0)
    plan, direct = planner.solve(problem), planner.solve(problem, DIRECT)
    assert plan.success
    assert "relaxation" not in plan.options
    assert np.array_equal(plan.us, direct.us)
    assert np.array_equal(plan.K, direct.K)


@pytest.fixture
def no_other_guesses(monkeypatch):
    """Of solves that another first guess would end before their limits are widened."""
    monkeypatch.setattr(relaxation, "other_guesses", lambda problem: iter(()))


@pytest.mark.usefixtures("no_other_guesses")
@pytest.mark.parametrize("more", [{}, {"position": {"pivot": (-1.5, 3.3)}}])
def test_a_relaxation_ends_at_a_plan_within_the_limits(more):
    problem = swing_up(4.0, 3.0, **more)
    plan, record = relaxation_of(problem)
    assert plan.status is Status.CONVERGED
    assert plan.problem is problem
    assert not plan.missed_goals
    assert np.abs(plan.us).max() <= 3.0
    if more:
        assert problem.ranges.violation(plan.xs).max() <= problem.limits.tolerance
    stages = [step[0] for step in record["steps"]]
    assert stages[:3] == ["direct", "free", "limits"]
    assert record["steps"][-1][1] == 1.0
    # The direct solve of this problem ends at 14.77 without a range; another branch may cost less.
    assert plan.cost < 1.1 * planner.solve(problem, DIRECT).cost


def test_a_relaxation_is_the_same_bit_for_bit_each_time():
    first, second = (relaxation_of(swing_up(4.0, 3.0)) for _ in range(2))
    assert np.array_equal(first[0].us, second[0].us)
    assert first[1] == second[1]


def test_too_short_a_duration_says_which_one_passes(weak):
    found = weak.options["relaxation"]
    assert weak.status is Status.INFEASIBLE
    assert not weak.converged
    assert 1.0 < found["factor"] < 2.0
    assert f"it passes in {found['duration']:g} s" in weak.message
    assert planner.solve(swing_up(found["duration"], 5.0)).success
    fix = suggested_fixes(weak)[0]
    assert (fix.key, fix.value, fix.code) == ("duration", found["duration"], "infeasible")


def test_shaken_controls_that_lead_nearer_are_kept_before_they_converge():
    """A swimmer's straight body is a saddle, and its way from there may take more iterations than allowed."""
    problem = swing_up(4.0)
    stays = replace(problem, us=np.zeros((problem.N, 1)))  # hangs: no small torque lowers the cost of the end alone
    direct = replace(planner.solve(stays, DIRECT, max_iterations=1), us=stays.us, xs=np.zeros((problem.N + 1, 2)))
    direct = replace(direct, status=Status.CONVERGED, cost=1e9)
    nearer = planner.solve(problem, DIRECT, max_iterations=2)
    assert nearer.status is Status.MAX_ITERATIONS
    plan, _ = relax(stays, direct, lambda *_: nearer, DIRECT.for_problem(stays), None)
    assert np.array_equal(plan.us, nearer.us)


def parking(**limits):
    """A car with its axle 1 m behind, from rest to 2 m aside: its first guess, at rest, is a saddle."""

    def rate(x, u):
        heading, speed = x[..., 2], x[..., 3]
        return np.stack([speed * np.cos(heading), speed * np.sin(heading), speed * np.tan(u[..., 0]), u[..., 1]], -1)

    names = [("x", "m"), ("y", "m"), ("heading", "rad"), ("speed", "m/s")]
    car = planner.FunctionDynamics(rate, nx=4, nu=2, dt=0.1, coordinates=names)
    goal = TrackingCost.reach(goal=[0.0, 2.0, 0.0, 0.0], horizon=50, final=100.0, effort=[1.0, 1.0], dt=0.1)
    return Problem(car, goal, x0=[0.0, 0.0, 0.0, 0.0], limits=Limits(**limits))


@pytest.mark.slow
def test_the_cheapest_plan_of_other_guesses_is_kept_though_it_lacks_weight():
    plan = planner.solve(parking(control=1.0))
    steps = plan.options["relaxation"]["steps"]
    assert [step[6] for step in steps] == [False] * len(steps)  # each misses a goal
    cheapest = min(step[3] for step in steps)
    assert plan.cost == cheapest
    assert cheapest < 0.1 * steps[0][3]


def test_a_guess_that_was_cut_goes_on_if_none_converges_at_less():
    problem = swing_up(4.0)
    cut, solved = planner.solve(problem, DIRECT, max_iterations=2), planner.solve(problem, DIRECT)
    outside = replace(cut, status=Status.OUTSIDE_LIMITS, us=np.zeros_like(cut.us))

    def solve_one(_problem, _options, _states, _penalties, us, *_):
        return solved if us is cut.us else cut

    plan, record = relax(problem, outside, solve_one, DIRECT.for_problem(problem), None)
    assert np.array_equal(plan.us, solved.us)
    assert record["steps"][-1][0] == record["steps"][1][0]  # of the first guess; the direct solve did not go on


def test_the_factor_that_was_reached_passes_too(weak):
    assert planner.solve(swing_up(2.0, 5.0 * weak.options["relaxation"]["factor"] * 1.01)).success


def test_the_plan_of_the_direct_solve_is_kept_where_none_is_found(weak):
    direct = planner.solve(swing_up(2.0, 5.0), DIRECT)
    assert direct.status is Status.CONVERGED
    assert np.array_equal(weak.us, direct.us)
    assert weak.nit == direct.nit
    assert weak.total_iterations > 50


def test_a_stored_plan_has_the_relaxation(weak, tmp_path):
    stored = planner.load_plan(weak.save(tmp_path / "plan.npz"), problem=weak.problem)
    assert stored.options["relaxation"] == weak.options["relaxation"]
    assert stored.message == weak.message


def test_nothing_is_relaxed_where_little_work_was_asked_for(weak):
    assert "relaxation" not in planner.solve(swing_up(2.0, 5.0), max_iterations=100).options
    assert "relaxation" not in planner.solve(swing_up(2.0, 5.0), warm_start=weak).options


def test_a_goal_that_weights_miss_ends_once_two_guesses_lead_to_the_same_plan():
    soft = swing_up(2.0, 5.0)
    soft = replace(soft, cost=replace_final(soft.cost, 1e-3), limits=Limits(control=500.0))
    plan = planner.solve(soft)
    assert plan.missed_goals
    stages = [step[0] for step in plan.options["relaxation"]["steps"]]
    assert stages == ["direct", "tracked"]


def test_a_plan_that_lacks_only_weight_is_not_infeasible_where_a_limit_acts_for_a_while():
    """The torque is at its bound in 4 of 60 stages; with a hundredth of the weights the plan ends 0.1 rad off."""
    soft = swing_up(3.0, 5.4)
    soft = replace(soft, cost=replace_final(soft.cost, 1e-2))
    plan = planner.solve(soft)
    assert 0.0 < share_at_limits(soft, plan) < FEW
    assert plan.missed_goals
    assert plan.status is Status.CONVERGED
    assert "relaxation" not in plan.options  # no work is spent on it
    assert planner.solve(swing_up(3.0, 5.4)).success  # with the weights that it lacks


def test_a_plan_that_limits_keep_off_its_goal_is_infeasible_however_little_it_lacks():
    """At 2 rad/s nearly all the way the pendulum ends 0.24 rad before the goal, with a hundred times the weight too."""
    fast = swing_up(1.5, velocity=2.0)
    plan = planner.solve(fast)
    assert lacks_weight(fast, plan)
    assert share_at_limits(fast, plan) > FEW
    assert plan.status is Status.INFEASIBLE


def replace_final(cost, share):
    """A cost with a share of its final weights, with which a plan misses its goal."""
    Q = cost.Q.copy()
    Q[-1] *= share
    return TrackingCost(Q, cost.R, cost.x_ref)


def test_a_relaxation_that_its_budget_cuts_says_how_much_work_it_had():
    problem = swing_up(2.0, 5.0)
    direct = planner.solve(problem, DIRECT)
    # The free problem, which comes next, takes more than 20 iterations.
    budget = WorkBudget((direct.total_iterations + 20) * problem.N * work_of_stage(problem))
    plan = planner.solve(problem, budget=budget)
    assert plan.status is Status.WORK_LIMIT
    assert plan.options["cut"] == "WORK_LIMIT"
    assert plan.options["work"] == budget.limit
    assert suggested_fixes(plan)


def test_a_relaxation_in_a_budget_knows_the_iterations_that_were_asked_for(monkeypatch):
    """Fewer would say that little work was asked for, and end it after its first solve."""
    seen = []
    monkeypatch.setattr(
        slq, "relax", lambda problem, direct, solve, options, *_: (seen.append(options), (direct, {}))[1]
    )
    problem = swing_up(2.0, 5.0)
    planner.solve(problem, budget=WorkBudget(900 * problem.N * work_of_stage(problem)))  # 1000 are asked for
    assert [one.max_iterations for one in seen] == [SolverOptions().max_iterations]


@pytest.mark.usefixtures("no_other_guesses")
def test_each_solve_is_reported_and_may_be_the_last():
    lines = []

    def callback(line):
        lines.append(line)
        if isinstance(line, RelaxationStep) and line.stage == "limits":
            raise StopIteration

    plan = planner.solve(swing_up(2.0, 5.0), callback=callback)
    assert plan.status is Status.INTERRUPTED
    steps = [line for line in lines if isinstance(line, RelaxationStep)]
    assert [step.stage for step in steps] == ["direct", "free", "limits"]
    assert str(steps[0]).splitlines()[0] == RelaxationStep.header()
    assert [len(str(step).splitlines()) for step in steps] == [2, 1, 1]


def test_homotopy_is_true_or_false():
    with pytest.raises(PlannerError, match="homotopy is 1, expected True or False"):
        SolverOptions(homotopy=1)


def test_limits_widen_until_the_free_plan_is_within():
    problem = swing_up(2.0, 5.0, position={"pivot": (-0.5, 3.5)})
    free = planner.solve(free_problem(problem))
    family = WiderLimits.around(problem, free)
    assert family.at(1.0) is problem
    admits = family.at(family.factor)
    assert np.all(np.abs(free.us) <= admits.bounds.upper * (1.0 + 1e-12))
    assert admits.ranges.violation(free.xs).max() <= 1e-12
    assert family.at(2.0).bounds.upper[0, 0] == 10.0
    # -0.5 to 3.5 rad about 1.5: twice as wide is -2.5 to 5.5, as deviations from the goal at pi
    assert family.at(2.0).ranges.lower[1, 0] == pytest.approx(-2.5 - np.pi)
    assert at_limits(problem, planner.solve(problem, DIRECT))
    assert free_problem(problem).bounds is free_problem(problem).ranges is None


def test_a_bound_without_an_opposite_one_has_room_for_the_free_plan():
    problem = swing_up(2.0, (-2.0, np.inf))
    free = planner.solve(free_problem(problem))
    assert free.us.min() < -2.0
    family = WiderLimits.around(problem, free)
    assert family.at(family.factor).bounds.lower[0, 0] == pytest.approx(free.us.min())
    assert np.isinf(family.at(family.factor).bounds.upper).all()


def test_exact_goals_stay_exact_in_a_free_problem():
    problem = swing_up(2.0, 5.0, final="exact", position={"pivot": (-1.0, 4.0)})
    plan = planner.solve(free_problem(problem))
    assert np.abs(plan.xs[-1] - [np.pi, 0.0]).max() <= problem.limits.tolerance


def test_a_continuation_steps_back_where_a_plan_falls_off_and_ends_at_the_problem():
    """By the plans of wider torques: a plan from further away than 0.3 of the logarithm is said to be lost."""
    problem = swing_up(4.0, 3.0)
    start = planner.solve(swing_up(4.0, 3.0 * np.e))
    seen = []

    def solve(asked, motion, limit):
        return planner.solve(asked, DIRECT, warm_start=motion)

    def reaches(plan):
        s = np.log(plan.problem.bounds.upper[0, 0] / 3.0)
        last = min((s for s, kept in seen if kept), default=1.0)
        return last - s < 0.3

    def report(s, plan, kept):
        seen.append((s, kept))

    s, plan = Continuation(
        lambda s: swing_up(4.0, 3.0 * np.exp(s)) if s else problem, solve, reaches, report
    ).run(1.0, start)  # fmt: skip
    assert s == 0.0
    assert plan.success
    assert not seen[0][1]
    assert all(a > b for (a, kept), (b, _) in pairwise(seen) if kept)


def test_a_continuation_goes_on_while_the_cost_falls_or_on_a_better_branch():
    """Looks of a few iterations: what falls, or costs less than the plan before, is solved to its end at once."""
    problem = swing_up(4.0, 3.0)
    start = planner.solve(swing_up(4.0, 3.0 * np.e))

    def solve(asked, motion, limit):
        return planner.solve(asked, replace(DIRECT, max_iterations=limit), warm_start=motion)

    def run(plan, look):
        seen = []
        Continuation(
            lambda s: swing_up(4.0, 3.0 * np.exp(s)) if s else problem, solve, lambda plan: plan.converged,
            lambda s, plan, kept: seen.append((s, plan.status, kept)), max_solves=1, look_iterations=look,
        ).run(0.5, plan)  # fmt: skip
        return seen

    falls = run(start, FALL_ITERATIONS + 1)
    assert len({s for s, *_ in falls}) == 1
    assert falls[-1][1:] == (Status.CONVERGED, True)
    dear = replace(start, cost=1e3 * start.cost)
    assert [kept for *_, kept in run(start, 1)] == [False]
    assert run(dear, 1)[-1][1:] == (Status.CONVERGED, True)


def from_random_controls(problem, seed, share=1.0):
    """The same problem whose first controls are random, of a share of their limits."""
    bounds = problem.bounds
    size = share * 0.5 * (bounds.upper - bounds.lower)
    return replace(problem, us=size * smooth(np.random.default_rng(seed), problem.first_guess.shape))


def test_a_bad_first_guess_is_left_for_controls_that_hold_the_machine():
    """Two poles on a cart with 30 N in 2 s: the direct solve from seed [0, 3] ends at a cost 7,000 times as large."""
    machine = planner.Mechanism.from_mjcf(POLES)
    cost = TrackingCost.joints(
        machine, [0.0, np.pi, *[0.0] * 4], 100, dt=0.02, final_position=1e4, final_velocity=1e3, effort=1.0 / 900.0
    )
    dynamics = RigidBodyDynamics(machine, 0.02, "semi-implicit-euler")
    problem = from_random_controls(Problem(dynamics, cost, np.zeros(6), limits=Limits(control=30.0)), [0, 3])
    plan, direct = planner.solve(problem), planner.solve(problem, DIRECT)
    assert direct.missed_goals
    assert not plan.missed_goals
    assert plan.cost < 0.1 * direct.cost
    assert [step[0] for step in plan.options["relaxation"]["steps"]] == ["direct", "held"]


@pytest.mark.slow  # 300 iterations past the obstacle; what is tried next is tested quickly below
def test_a_guess_through_an_obstacle_is_left_for_a_way_around_it():
    problem = planner.load_problem(EXAMPLES / "tasks" / "around_a_post.toml")
    plan = planner.solve(from_random_controls(problem, [0, 2], 0.1))
    assert plan.success
    steps = plan.options["relaxation"]["steps"]
    assert (steps[0][-1], steps[-1][0]) == (False, "collision-free")


def test_the_first_other_guess_past_an_obstacle_leads_to_a_plan():
    problem = planner.load_problem(EXAMPLES / "tasks" / "around_a_post.toml")
    name, _, us = next(iter(other_guesses(from_random_controls(problem, [0, 2], 0.1))))
    assert name == "collision-free"
    assert planner.solve(replace(problem, us=us), DIRECT).success


def test_a_guess_that_is_the_problems_own_is_not_tried_again():
    problem = swing_up(2.0, 5.0)
    held = stabilizing_guess(problem)
    assert "held" not in [name for name, _, _ in other_guesses(replace(problem, us=held))]
    assert "held" in [name for name, _, _ in other_guesses(replace(problem, us=held + 1.0))]
