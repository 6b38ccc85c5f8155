"""Which plan of other first guesses takes the direct one's place: by its cost, unless it is outside of its limits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import swings

import planner
from planner import Limits, Problem, RigidBodyDynamics, SolverOptions, Status, TrackingCost
from planner.solvers import relaxation
from planner.solvers.relaxation import relax
from planner.solvers.trapped import FIRST_ITERATIONS, is_better

DIRECT = SolverOptions(homotopy=False)
FASTEST = 4.0  # rad/s


def half_way(status, cost, velocity=0.0):
    """A plan of a pendulum that ends half of the way to its goal, with a velocity, rad/s, in the middle."""
    machine = swings.mechanism()
    target = TrackingCost.joints(machine, [np.pi, 0.0], 20, dt=0.05, final_position=1e3, effort=1.0)
    dynamics, limits = RigidBodyDynamics(machine, 0.05, "rk4"), Limits(velocity=FASTEST)
    plan = planner.solve(Problem(dynamics, target, x0=[0.0, 0.0], limits=limits), DIRECT, max_iterations=1)
    xs = np.zeros_like(plan.xs)
    xs[-1, 0], xs[10, 1] = 0.5 * np.pi, velocity
    return replace(plan, xs=xs, status=status, cost=cost)


def of_guesses(monkeypatch, direct, *guesses):
    """The plan of relax() where solves from other guesses, and those that go on, end with these."""
    names = [(f"guess {k}", None, np.zeros_like(direct.us)) for k in range(len(guesses) - 1)]
    monkeypatch.setattr(relaxation, "other_guesses", lambda problem: iter(names))
    left = iter(guesses)

    def solve_one(problem, *_):
        return replace(next(left), problem=problem) if problem is direct.problem else replace(direct, problem=problem)

    return relax(direct.problem, direct, solve_one, DIRECT.for_problem(direct.problem), None)


@pytest.mark.parametrize(
    ("direct", "further", "velocity", "kept"),
    [
        (Status.CONVERGED, Status.OUTSIDE_LIMITS, 0.0, False),
        (Status.CONVERGED, Status.MAX_ITERATIONS, 0.0, False),
        (Status.CONVERGED, Status.CONVERGED, 0.0, True),
        (Status.OUTSIDE_LIMITS, Status.MAX_ITERATIONS, 2.0 * FASTEST, False),
        (Status.OUTSIDE_LIMITS, Status.MAX_ITERATIONS, 0.5 * FASTEST, True),
        (Status.OUTSIDE_LIMITS, Status.OUTSIDE_LIMITS, 0.0, False),
    ],
)
def test_a_way_through_the_limits_is_no_better_for_its_cost(monkeypatch, direct, further, velocity, kept):
    """Its cost is without penalties: a path through an obstacle always costs less."""
    cut = half_way(Status.MAX_ITERATIONS, 20.0)
    ends = half_way(further, 19.0, velocity)
    plan, record = of_guesses(monkeypatch, replace(cut, status=direct, cost=100.0), cut, ends)
    assert [step[0] for step in record["steps"][1:3]] == ["guess 0", "guess 0"]
    assert plan.cost == (19.0 if kept else 100.0)


def test_the_cheapest_that_converged_is_kept_also_where_it_was_cut_first(monkeypatch):
    """The one that went on misses its goals as the other does."""
    cut, ended = half_way(Status.MAX_ITERATIONS, 20.0), half_way(Status.CONVERGED, 40.0)
    direct = replace(ended, cost=100.0)
    assert of_guesses(monkeypatch, direct, cut, ended, replace(ended, cost=19.0))[0].cost == 19.0
    assert of_guesses(monkeypatch, direct, cut, ended, replace(cut, cost=19.0))[0].cost == 40.0


def test_a_plan_that_misses_its_goals_replaces_no_success(monkeypatch):
    missing, there = half_way(Status.CONVERGED, 1.0), half_way(Status.CONVERGED, 2.0)
    there = replace(there, xs=there.xs + np.array([0.5 * np.pi, 0.0]))
    assert not there.missed_goals
    assert not is_better(missing, there)
    assert is_better(replace(there, status=Status.MAX_ITERATIONS), missing)  # it is there, whatever it costs


def test_a_guess_that_goes_on_takes_no_iterations_of_the_direct_solve(monkeypatch):
    """The direct one waits after 300 iterations, and has 700 left when the others lead nowhere."""
    path = Path(__file__).parents[2] / "examples" / "tasks" / "around_a_post.toml"
    problem, asked = planner.load_problem(path), []
    cut = planner.solve(problem, DIRECT, max_iterations=1)
    cut = replace(cut, status=Status.MAX_ITERATIONS, history=cut.history[:1] * (FIRST_ITERATIONS + 1))
    direct = replace(cut, cost=100.0)
    names = [("guess", None, np.zeros_like(direct.us))]
    monkeypatch.setattr(relaxation, "other_guesses", lambda problem: iter(names))

    def solve_one(problem, _options, _states, _penalties, _us, iterations, _callback):
        asked.append(iterations)
        return replace(cut, problem=problem, cost=1.0, status=Status.OUTSIDE_LIMITS if len(asked) > 1 else cut.status)

    _, record = relax(problem, direct, solve_one, SolverOptions(), None)
    rows = [(step[0], iterations) for step, iterations in zip(record["steps"][1:], asked, strict=True)]
    limit = SolverOptions().max_iterations
    assert rows[1:3] == [("guess", limit - FIRST_ITERATIONS), ("resumed", limit - FIRST_ITERATIONS)]
