"""Budgets of work: counted from sizes alone, shared by parts and starts; what they cut says so."""

import math

import numpy as np
import pytest

import planner
from planner import PlannerError, Status, cases
from planner.problem.problem import Problem
from planner.solvers.work import WorkBudget, work_of_proof, work_of_stage


def swing(horizon=60):
    return cases.acrobot(horizon=horizon)  # of more than a hundred iterations


def work_of(problem, iterations):
    return iterations * problem.N * work_of_stage(problem)


def test_a_cut_solve_is_one_of_fewer_iterations_bit_for_bit():
    problem = swing()
    budget = WorkBudget(work_of(problem, 12.5))
    plan, same = planner.solve(problem, budget=budget), planner.solve(problem, max_iterations=12)
    assert plan.status is Status.WORK_LIMIT
    assert not plan.success
    assert "--work" in plan.message
    assert plan.options["cut"] == "WORK_LIMIT"
    np.testing.assert_array_equal(plan.us, same.us)
    assert same.status is Status.MAX_ITERATIONS
    np.testing.assert_array_equal(planner.solve(problem, budget=work_of(problem, 12.5)).us, same.us)
    assert budget.used == pytest.approx(work_of(problem, 12))
    assert math.isclose(budget.left, work_of(problem, 0.5), rel_tol=1e-9)


def test_a_budget_that_suffices_changes_nothing():
    problem = cases.two_link(horizon=40)
    plan, free = planner.solve(problem, budget=WorkBudget(60.0, seconds=1e6)), planner.solve(problem)
    np.testing.assert_array_equal(plan.us, free.us)
    assert plan.success
    assert plan.options == free.options


def test_starts_share_a_budget():
    problem = swing()
    plan = planner.solve(problem, starts=3, budget=WorkBudget(work_of(problem, 30)))
    assert plan.status is Status.WORK_LIMIT
    assert [start.iterations for start in plan.starts] == [10, 10, 10]


def test_parts_count_in_the_whole():
    problem, whole = swing(), WorkBudget(10.0)
    part = whole.part("first solve", 0.5)
    inner = part.part("fixes")
    assert (part.limit, inner.limit) == (5.0, 5.0)
    inner.charge(problem, 7)
    whole.charge_proof(problem)
    assert part.used == inner.used == work_of(problem, 7)
    assert set(whole.spent) == {"fixes", "proofs"}
    assert whole.used == pytest.approx(part.used + whole.spent["proofs"])
    assert inner.whole is whole
    assert str(whole).startswith(f"{whole.used:.2g} of 10: fixes ")


def test_a_solve_before_a_proof_leaves_room_for_it():
    problem, whole = swing(), WorkBudget(100.0)
    part = whole.part("finer steps").before_proof(problem)
    assert part.limit == pytest.approx(100.0 - work_of_proof(problem))
    part.charge(problem, 3)
    whole.charge_proof(problem)
    assert whole.spent == pytest.approx({"finer steps": work_of(problem, 3), "proofs": work_of_proof(problem)})
    assert WorkBudget(0.5 * work_of_proof(problem)).before_proof(problem).exhausted
    assert not WorkBudget().before_proof(problem).exhausted


def test_a_deadline_ends_a_solve_and_is_named():
    plan = planner.solve(swing(), budget=WorkBudget(seconds=1e-9))  # over after any iteration
    assert plan.status is Status.TIME_LIMIT
    assert plan.nit == 1
    assert plan.options["cut"] == "TIME_LIMIT"
    several = planner.solve(swing(), starts=2, budget=WorkBudget(seconds=1e-9))
    assert several.status is Status.TIME_LIMIT


def test_the_headline_names_the_limit():
    plan = planner.solve(swing(), budget=WorkBudget(work_of(swing(), 3)))
    proof = planner.prove(plan, rollouts=0)
    assert not proof.passed
    assert proof.headline.endswith("not optimal, cut by its WORK_LIMIT")
    assert Status.WORK_LIMIT.value in {one.note for one in proof.optimality.failures}


def test_a_search_for_a_duration_ends_with_its_best_plan():
    problem = cases.two_link(horizon=30)
    budget = WorkBudget(work_of(problem, 60))
    plan = planner.solve_for(problem, {"effort": 1.0, "time": 20.0}, durations=(0.5, 3.0), budget=budget)
    assert plan.status is Status.WORK_LIMIT
    full = planner.solve_for(problem, {"effort": 1.0, "time": 20.0}, durations=(0.5, 3.0))
    assert 1 <= len(plan.options["tried"]) < len(full.options["tried"])


def test_passes_of_a_periodic_motion_end():
    problem = cases.build("human-step", phase="gait")
    plan = planner.solve_periodic(problem, budget=WorkBudget(work_of(problem, 5)))
    assert plan.status is Status.WORK_LIMIT
    assert len(plan.options["tried"]) == 1


def test_work_grows_with_what_a_machine_has():
    names = ("two-link", "puma", "human-step")
    assert sorted(names, key=lambda name: work_of_stage(cases.build(name))) == list(names)
    own = Problem(planner.FunctionDynamics(lambda x, u: x + u, nx=1, nu=1, dt=0.1), cost=Cost(), x0=[1.0], horizon=3)
    assert work_of_stage(own) > work_of_stage(cases.build("puma"))  # no kernel computes it


def test_contacts_with_a_lead_are_counted_and_most_of_them_in_derivatives():
    file = """<mujoco><worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 .1"><joint name="z" type="slide"
      axis="0 0 1"/><geom size=".1" mass="2"/></body></worldbody><actuator><motor joint="z"/></actuator></mujoco>"""
    ball, other = (
        Problem(planner.RigidBodyDynamics(m, dt=0.01), cost=Cost(), x0=m.home, horizon=3)
        for m in (planner.Mechanism.from_mjcf(file, contacts=way) for way in ("file", "avoid"))
    )
    assert work_of_stage(ball) > 1.1 * work_of_stage(other)
    added = work_of_stage(ball) - work_of_stage(other)
    assert work_of_proof(ball) - work_of_proof(other) < 20 * 3 * added  # other parts of a proof: as of 80 iterations


class Cost:
    def value(self, xs, us):
        return 0.5 * float(np.sum(us**2))

    def quadratize(self, xs, us):
        N = len(us)
        return planner.costs.Quadratic(np.zeros((N + 1, 1, 1)), np.zeros((N + 1, 1)), np.ones((N, 1, 1)), us.copy())


@pytest.mark.parametrize(("given", "said"), [
    ({"limit": -1.0}, "work"), ({"limit": math.nan}, "work"), ({"seconds": 0.0}, "budget"),
])  # fmt: skip
def test_refusals(given, said):
    with pytest.raises(PlannerError, match=said):
        WorkBudget(**given)


def test_a_budget_is_one():
    with pytest.raises(PlannerError, match="budget is 'much', expected a"):
        planner.solve(cases.two_link(horizon=10), budget="much")
