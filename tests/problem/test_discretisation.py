"""The same problem at a finer step, and a first guess for it from the plan there was."""

from dataclasses import replace

import numpy as np
import pytest
from carts import write
from driven import moved_cart
from machines import HAND_MACHINE, random_states
from swings import PENDULUM, discrete, strange, swing

import planner
from planner.cases.problem_file import load
from planner.problem.costs.motors import DriveCost
from planner.problem.rediscretize import finer
from planner.solvers.gains import feedback_rollout, warm_start


@pytest.mark.parametrize("case", ["two-link", "acrobot", "hopper"])
@pytest.mark.parametrize("integrator", ["euler", "rk4"])
def test_a_case_is_made_anew(case, integrator):
    problem = planner.cases.build(case, horizon=20, integrator=integrator)
    fine = finer(problem)
    N = 20 if integrator == "euler" else 40
    assert fine.parameters == planner.cases.build(case, horizon=N, integrator="rk4").parameters
    assert fine.duration == pytest.approx(problem.duration)


def test_a_case_with_other_parts_is_taken_apart():
    """Its name would bring back a problem that nobody asked for."""
    problem = planner.cases.two_link(horizon=20)
    changed = replace(problem, cost=planner.TrackingCost(2.0 * problem.cost.Q, problem.cost.R, problem.cost.x_ref))
    for other in (changed, replace(problem, x0=[0.1, 0.0, 0.0, 0.0])):
        fine = finer(other)
        assert fine.case is None
        assert fine.N == 40
        np.testing.assert_array_equal(fine.x0, other.x0)
        np.testing.assert_array_equal(fine.cost.Q[-1], other.cost.Q[-1])
        np.testing.assert_array_equal(fine.first_guess, np.repeat(other.first_guess, 2, axis=0))
    assert finer(problem).case == "two-link"


def test_a_problem_file_is_made_anew(tmp_path):
    problem = load(write(tmp_path, integrator='"euler"')).problem
    fine, finest = finer(problem), finer(finer(problem))
    assert (fine.N, fine.dynamics.dt, fine.dynamics.integrator) == (20, 0.05, "rk4")
    assert (finest.N, finest.dynamics.dt, finest.dynamics.integrator) == (40, 0.025, "rk4")
    assert finest.case == problem.case
    assert finest.parameters == problem.parameters | {"dt": 0.025, "integrator": "rk4"}


def test_half_the_stage_is_the_same_integral():
    rng = np.random.default_rng(0)
    problem = swing("rk4", position=3.0, velocity=[0.2], control=[0.3], reference=rng.normal(size=(21, 2)))
    cost = problem.cost + problem.cost
    xs, us = rng.normal(size=(21, 2)), rng.normal(size=(20, 1))
    for whole in (problem.cost, cost):
        assert whole.resampled(2, 0.5).value(*halved(xs, us)) == pytest.approx(whole.value(xs, us), rel=1e-12)


def halved(xs, us):
    """A trajectory whose stages are divided in two, at the same states and controls."""
    return np.concatenate([np.repeat(xs[:-1], 2, axis=0), xs[-1:]]), np.repeat(us, 2, axis=0)


@pytest.mark.parametrize(
    "parts",
    [
        {"position": [0.3, 0.2, 0.4], "position_weight": 2.0, "final_position_weight": 3.0},
        {"position": np.arange(18.0).reshape(6, 3) / 18.0, "position_weight": np.arange(18.0).reshape(6, 3),
         "orientation": [1.0, 0.2, 0.1, -0.3], "final_orientation_weight": 2.0},
    ],
    ids=["one for all stages", "per stage"],
)  # fmt: skip
def test_half_the_stage_is_the_same_integral_of_a_frame(parts):
    machine, rng = planner.Mechanism.from_mjcf(HAND_MACHINE), np.random.default_rng(0)
    cost = planner.FrameCost(machine, "hand", dt=0.1, **parts)
    xs, us = random_states(machine, rng, 6), rng.normal(size=(5, machine.nu))
    half = cost.resampled(2, 0.5)
    assert half.N in (None, 10)
    assert (half.N is None) == (cost.N is None)
    assert half.value(*halved(xs, us)) == pytest.approx(cost.value(xs, us), rel=1e-12)


def test_half_the_stage_is_the_same_integral_of_a_drive():
    rng, dynamics = np.random.default_rng(1), moved_cart().dynamics
    cost = DriveCost(dynamics, 5, 1e-2, reference=3.0)
    xs, us = rng.normal(size=(6, 6)), rng.normal(size=(5, 3))
    half = cost.resampled(2, 0.5)
    assert half.N == 10
    assert half.value(*halved(xs, us)) == pytest.approx(cost.value(xs, us), rel=1e-12)


def test_quaternions_and_prescribed_joints_are_kept():
    text = PENDULUM.replace('name="pivot" axis="0 -1 0" ARGUMENTS', 'name="pivot" type="ball"').replace(
        '<motor joint="pivot"/>', '<motor joint="pivot" gear="0 1 0"/>'
    )
    machine = planner.Mechanism.from_mjcf(text)
    dynamics = planner.RigidBodyDynamics(machine, 0.1, prescribed=("pivot",))
    cost = planner.TrackingCost.joints(dynamics, machine.home, 10, effort=1.0, final_position=1.0)
    problem = planner.Problem(dynamics, cost, x0=machine.home)
    fine = finer(problem)
    assert fine.dynamics.prescribed == ("pivot",)
    assert fine.cost.space == machine.space
    assert fine.twin.mjcf == problem.twin.mjcf != machine.mjcf  # the joint is driven


class Own:
    """A user's own cost."""

    def value(self, xs, us):
        return 0.0

    def quadratize(self, xs, us):
        raise AssertionError("no step of it is asked for")


@pytest.mark.parametrize(
    ("problem", "fragment"),
    [
        (discrete(), "the dynamics are a discrete map"),
        (replace(swing("rk4"), cost=Own()), "the cost is of the type Own"),
        (replace(swing("rk4"), cost=swing().cost + Own()), "the cost is of the type Own"),
        (swing("rk4", 60_000), "half the stage makes 120000 stages, expected at most 100000"),
        (strange(swing("rk4")), "of the type SimpleNamespace"),
    ],
    ids=["discrete map", "own cost", "own term", "too many", "own dynamics"],
)  # fmt: skip
def test_a_problem_that_cannot_be_made_finer_says_why(problem, fragment):
    with pytest.raises(planner.PlannerError, match=fragment) as caught:
        finer(problem)
    assert "\n" not in str(caught.value)


def test_another_integrator_needs_no_other_cost():
    problem = replace(swing(), cost=Own())
    assert finer(problem).cost is problem.cost


# The warm start


def test_the_way_that_costs_least_is_taken():
    plan = planner.solve(planner.cases.two_link(horizon=50, integrator="semi-implicit-euler"))
    fine = finer(plan.problem)
    chosen = feedback_rollout(fine, warm_start(plan, fine))[0]
    others = [(fine.first_guess,), (plan.us,), (plan.us, plan.K, plan.xs)]
    # none of these stays near the old motion; gains of the new dynamics do
    assert chosen < 0.1 * min(feedback_rollout(fine, *other)[0] for other in others)
    for K in (0.0 * plan.K, np.full_like(plan.K, np.nan)):  # whatever the plan's gains are
        assert feedback_rollout(fine, warm_start(replace(plan, K=K), fine))[0] == chosen


def test_every_way_may_be_the_best():
    plan = planner.solve(swing("rk4", 40))
    fine = finer(plan.problem)
    np.testing.assert_allclose(warm_start(plan, fine), np.repeat(plan.us, 2, axis=0), atol=0.05)
    better = replace(fine, us=planner.solve(fine).us)
    np.testing.assert_array_equal(warm_start(plan, better), better.us)


def test_a_runaway_costs_infinitely_much():
    problem = planner.cases.hopper(horizon=20)
    with np.errstate(all="ignore"):
        cost, _ = feedback_rollout(problem, np.full((20, 1), 1e308), np.full((20, 1, 3), 1e308), np.zeros((21, 3)))
    assert cost == np.inf
