"""Continuation in the contact: softer ground first, and the last solve on the ground of the file."""

import numpy as np
import pytest

import planner
from planner.solvers.options import SolverOptions
from planner.solvers.softer_contacts import SofterContacts, has_softer

DIRECT = SolverOptions(homotopy=False)


@pytest.fixture(scope="module")
def problem():
    return planner.load_problem("monopod")


@pytest.fixture(scope="module")
def jump(problem):
    return planner.solve(problem)


def test_softer_contacts_sink_deeper_and_bounce_alike(problem):
    family = SofterContacts(problem)
    assert family.at(1.0) is problem
    hard, soft = (family.at(f).dynamics.mechanism for f in (1.0, 10.0))
    assert len(soft.contacts) == len(hard.contacts) > 0
    for a, b in zip(hard.contacts, soft.contacts, strict=True):
        assert b.law.stiffness == pytest.approx(a.law.stiffness / 10.0)  # the depth that carries the weight is m g / K
        assert b.law.ramp == pytest.approx(10.0 * a.law.ramp)
        assert b.law.damping / np.sqrt(b.law.stiffness) == pytest.approx(a.law.damping / np.sqrt(a.law.stiffness))
        assert b.law.force_ramp == a.law.force_ramp
        assert b.law.friction == a.law.friction
    assert has_softer(problem)
    assert not has_softer(planner.cases.two_link(horizon=10))


@pytest.mark.slow  # a jump takes 10 s
def test_a_slow_jump_costs_less_by_way_of_softer_ground(problem, jump):
    direct = planner.solve(problem, DIRECT)
    steps = jump.options["relaxation"]["steps"]
    assert [step[0] for step in steps[:2]] == ["direct", "contacts"]
    assert steps[0][4] == direct.nit > 100  # else the direct plan would be the answer
    assert steps[1][1] == 10.0
    assert steps[-1][1] == 1.0
    assert jump.success
    assert jump.cost < direct.cost
    assert jump.problem is problem  # the ground of the file
    assert jump.total_iterations == sum(step[4] for step in steps)
    assert "relaxation" not in direct.options


@pytest.mark.slow  # a jump takes 10 s
def test_it_is_the_same_bit_for_bit_each_time_and_is_stored(problem, jump, tmp_path):
    assert np.array_equal(planner.solve(problem).us, jump.us)
    assert planner.load_plan(jump.save(tmp_path / "plan.npz")).options["relaxation"] == jump.options["relaxation"]


def test_a_quick_solve_with_contacts_stays_as_it_is():
    problem = planner.cases.human_step()
    plan = planner.solve(problem, max_iterations=1000)
    assert plan.nit < 100
    assert "relaxation" not in plan.options
