"""Continuation in the contact: softer ground first, and the last solve on the ground of the file."""

import math
from dataclasses import replace

import numpy as np
import pytest

import planner
from planner.dynamics import RigidBodyDynamics, body_contact_forces
from planner.problem.plan import Status
from planner.solvers import relaxation
from planner.solvers.continuation import REACH, DistantContacts, SofterContacts, has_softer, stays_on_feet
from planner.solvers.engine import CompiledEngine, NumpyEngine, acquire_engine
from planner.solvers.options import SolverOptions
from planner.solvers.relaxation import relax
from planner.solvers.trapped import MAX_QUICK_ITERATIONS, is_settled, lacks_weight

DIRECT = SolverOptions(homotopy=False)


@pytest.fixture(scope="module")
def problem():
    """The jump from a guess that holds: the default one leaves the ground, and needs no softer contacts."""
    return planner.load_problem("monopod").recipe.rebuilt(guess="hold")


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
    assert steps[0][4] >= MAX_QUICK_ITERATIONS  # else the direct plan would be the answer
    assert steps[1][1] == 10.0
    assert steps[-1][1] == 1.0
    assert jump.success
    assert jump.cost < direct.cost
    assert jump.problem is problem  # the ground of the file
    assert jump.total_iterations == sum(step[4] for step in steps)
    assert "relaxation" not in direct.options


def test_feet_stay_that_are_loaded_at_all_knots(problem, push):
    standing = np.tile(problem.x0, (3, 1))
    hop = standing.copy()
    hop[1, problem.dynamics.mechanism.joint("z").start] += 1.0
    assert stays_on_feet(problem, standing)
    assert not stays_on_feet(problem, hop)
    assert not stays_on_feet(push, np.tile(push.x0, (3, 1)))  # an object
    assert not stays_on_feet(planner.cases.two_link(horizon=10), np.zeros((3, 4)))  # no contact


@pytest.fixture(scope="module")
def rise():
    """The quadruped's plan, and the entries of its velocities."""
    plan = planner.solve(planner.load_problem("quadruped"))
    return plan, plan.problem.dynamics.mechanism.velocities


def test_a_solve_on_feet_that_stay_and_that_meets_its_goals_goes_on_before_softer_contacts_are_tried(rise):
    plan, _ = rise
    cut = replace(plan, status=Status.MAX_ITERATIONS)
    asked = []

    def solve_one(problem, options, states, penalties, us, iterations, callback):
        asked.append(iterations)
        return plan

    found, record = relax(plan.problem, cut, solve_one, SolverOptions(), None)
    assert found.converged
    assert [step[0] for step in record["steps"]] == ["direct", "resumed"]
    assert asked == [MAX_QUICK_ITERATIONS]  # as many again


def test_a_cost_has_settled_once_a_third_of_the_iterations_took_little_off(unfinished):
    def solved(*costs):
        rows = tuple(unfinished.history[0]._replace(cost=cost) for cost in costs)
        return replace(unfinished, history=rows, cost=costs[-1])

    assert is_settled(solved(9.0, 8.0, 7.0, 2.0, 1.04, 1.02, 1.0))
    assert not is_settled(solved(9.0, 8.0, 7.0, 2.0, 1.06, 1.02, 1.0))  # 6 % in the last third, 5 % is SETTLED
    assert not is_settled(replace(unfinished, history=()))


def test_a_plan_that_slows_down_lacks_weight_and_one_that_does_not_or_stays_away_does_not(rise):
    plan, velocities = rise
    slower, fast, low = (plan.xs.copy() for _ in range(3))
    most = np.abs(plan.xs[:, velocities]).max(axis=0)
    slower[-1, velocities], fast[-1, velocities] = 0.7 * most, most  # SLOWER is 0.75
    low[-1] = plan.xs[plan.N // 2]
    assert lacks_weight(plan.problem, plan)
    assert lacks_weight(plan.problem, replace(plan, xs=slower))
    assert not lacks_weight(plan.problem, replace(plan, xs=fast))
    assert not lacks_weight(plan.problem, replace(plan, xs=low))


@pytest.mark.parametrize(
    ("costs", "second"),
    [((9.0, 8.0, 7.0, 1.0, 1.0, 1.0), "resumed"), ((9.0, 8.0, 7.0, 6.0, 5.0, 1.0), "contacts")],
)
def test_a_solve_that_steps_and_has_settled_at_its_goals_goes_on_before_softer_contacts_are_tried(rise, costs, second):
    plan, _ = rise
    xs = plan.xs.copy()
    xs[plan.N // 2, 2] += 0.1  # m: the feet leave the ground
    rows = tuple(plan.history[0]._replace(cost=cost) for cost in costs)
    cut = replace(plan, xs=xs, status=Status.MAX_ITERATIONS, history=rows, cost=costs[-1])
    assert not stays_on_feet(plan.problem, xs)
    _, record = relax(plan.problem, cut, lambda *_: plan, SolverOptions(), None)
    assert [step[0] for step in record["steps"][:2]] == ["direct", second]


def test_the_cheapest_attempt_goes_on_where_the_branch_of_softer_contacts_ends(rise):
    """A quadruped's leap: the direct solve had cost 195 and went on to 124, an attempt 3.5, and it goes on to 3."""
    plan, _ = rise
    away = replace(plan, xs=np.repeat(plan.xs[:1], len(plan.xs), axis=0), status=Status.MAX_ITERATIONS)
    direct = replace(away, cost=100.0)
    costs, begun = iter((7.0, 4.0, *[9.0] * 20)), []

    def solve_one(problem, options, states, penalties, us, iterations, callback):
        if problem is not plan.problem:
            return replace(away, cost=1.0, status=Status.CONVERGED, problem=problem)  # of softer contacts
        if begun and us is begun[-1].us:
            return replace(plan, cost=3.0)
        attempt = replace(away, cost=next(costs), us=us.copy())
        begun.extend([attempt] if attempt.cost == 4.0 else [])
        return attempt

    found, record = relax(plan.problem, direct, solve_one, SolverOptions(), None)
    assert found.cost == 3.0
    assert record["steps"][-1][0] == "resumed"


def test_an_attempt_on_the_branch_of_softer_contacts_goes_on_until_it_converges(rise):
    plan, _ = rise
    away = replace(plan, xs=np.repeat(plan.xs[:1], len(plan.xs), axis=0), status=Status.MAX_ITERATIONS)
    allowed = []

    def solve_one(problem, options, states, penalties, us, iterations, callback):
        if problem is not plan.problem:
            return replace(away, cost=1.0, status=Status.CONVERGED, problem=problem)
        allowed.append(iterations)
        return replace(plan if len(allowed) > 1 else away, cost=1.05)  # within NEAR of the softer one's

    found, _ = relax(plan.problem, replace(away, cost=100.0), solve_one, SolverOptions(), None)
    assert found.converged
    assert allowed == [60, 1000]


@pytest.mark.slow  # a jump takes 10 s
def test_it_is_the_same_bit_for_bit_each_time_and_is_stored(problem, jump, tmp_path):
    assert np.array_equal(planner.solve(problem).us, jump.us)
    assert planner.load_plan(jump.save(tmp_path / "plan.npz")).options["relaxation"] == jump.options["relaxation"]


def test_a_quick_solve_with_contacts_stays_as_it_is():
    problem = planner.cases.human_step()
    plan = planner.solve(problem, max_iterations=1000)
    assert plan.nit < 100
    assert "relaxation" not in plan.options


@pytest.fixture(scope="module")
def push():
    return planner.load_problem("pusher")


def test_a_contact_with_an_object_begins_at_a_distance(push):
    family = DistantContacts(push)
    assert family.at(1.0) is push
    nq, start, still = push.dynamics.mechanism.nq, push.x0[: push.dynamics.mechanism.nq], np.zeros(3)
    near, far = (body_contact_forces(family.at(f).dynamics.mechanism, start, still) for f in (1.0, family.factor))
    assert nq == 3
    assert not near.forces.any()
    assert far.forces.any()
    (hard,), (soft,) = (family.at(f).dynamics.mechanism.body_contacts for f in (1.0, family.factor))
    assert soft.law.ramp / 2.0 == pytest.approx(REACH * -near.depths[0])  # of its gap
    assert soft.law.stiffness * soft.law.ramp / 8.0 == pytest.approx(hard.law.stiffness * hard.law.ramp)  # in touch
    assert family.at(4.0).dynamics.mechanism.body_contacts[0].law.stiffness == hard.law.stiffness


def test_only_what_nothing_drives_is_pushed_from_afar(problem, push):
    assert DistantContacts(problem).factor == 1.0  # feet alone
    assert DistantContacts(planner.cases.two_link(horizon=10)).factor == 1.0
    mechanism = push.dynamics.mechanism
    motor = replace(mechanism.actuators, moment=np.roll(mechanism.actuators.moment, 1, axis=1))
    driven = replace(push, dynamics=RigidBodyDynamics(replace(mechanism, actuators=motor), push.dynamics.dt))
    assert motor.moment[:, 2].any() != mechanism.actuators.moment[:, 2].any()  # the trolley has a motor, too
    assert DistantContacts(driven).factor == 1.0


@pytest.fixture(scope="module")
def push_plan(push):
    return planner.solve(push)


def test_an_object_that_nothing_touches_is_pushed_and_the_last_solve_has_the_files_law(push, push_plan):
    """The direct solve has no gradient: wherever the finger is, the trolley does not feel it."""
    plan = push_plan
    steps = plan.options["relaxation"]["steps"]
    assert plan.success
    assert plan.problem is push
    assert (steps[0][0], steps[0][-1]) == ("direct", False)
    assert {step[0] for step in steps[1:]} == {"distance"}
    assert steps[-1][1] == 1.0
    q, qd = np.split(plan.xs, 2, axis=1)
    touching = body_contact_forces(push.dynamics.mechanism, q, qd).forces.any(axis=(1, 2))
    assert touching.any()
    assert not touching[[0, -1]].any()


@pytest.mark.parametrize(("share", "goes_on"), [(0.85, True), (0.95, False)], ids=["it is moved", "it is hardly moved"])
def test_from_afar_plans_are_kept_that_miss_the_goal_and_cost_less(push, push_plan, share, goes_on):
    """A gentle force for a long time may bring the object part of the way: only the last plan has to be there."""
    direct = planner.solve(push, DIRECT)
    assert direct.missed_goals
    ramp = push.dynamics.mechanism.body_contacts[0].law.ramp

    def solve_one(asked, *_):
        near = asked.dynamics.mechanism.body_contacts[0].law.ramp == ramp
        return push_plan if near and asked is push else replace(direct, problem=asked, cost=share * direct.cost)

    plan, record = relax(push, direct, solve_one, SolverOptions(), None)
    first = next(step for step in record["steps"] if step[0] == "distance")
    assert first[-1] == goes_on
    if goes_on:
        assert plan.xs is push_plan.xs
        assert not plan.missed_goals


@pytest.mark.parametrize("other", ["none", "there", "as far"])
def test_an_object_that_is_moved_part_of_the_way_leaves_other_ways_to_it(monkeypatch, push, push_plan, other):
    """Forces at a distance that end without the goal, at less cost, are the answer only if nothing better is found."""
    direct = planner.solve(push, DIRECT)
    halfway = replace(direct, cost=0.5 * direct.cost)
    dearer = {
        "none": None,
        "there": replace(push_plan, cost=0.6 * direct.cost),
        "as far": replace(direct, cost=0.6 * direct.cost),
    }
    ways = {"_by_forces_at_a_distance": halfway, "_by_smoother_friction": None, "_by_softer_contacts": dearer[other]}
    for name, plan in ways.items():
        monkeypatch.setattr(relaxation._Relaxation, name, lambda self, direct, plan=plan: plan)
    plan, _ = relax(push, direct, lambda asked, *_: replace(direct, problem=asked), SolverOptions(), None)
    assert plan.cost == (0.6 if other == "there" else 0.5) * direct.cost


def test_other_contacts_keep_the_compiled_engine_and_other_masses_do_not(problem):
    assert isinstance(acquire_engine(SofterContacts(problem).at(10.0)), CompiledEngine)
    dynamics = problem.dynamics
    heavier = replace(dynamics.mechanism, mass=2.0 * dynamics.mechanism.mass)
    other = replace(problem, dynamics=RigidBodyDynamics(heavier, dynamics.dt), recipe=None)
    assert isinstance(acquire_engine(other), NumpyEngine)


@pytest.fixture(scope="module")
def unfinished(problem):
    """A plan of two iterations whose end is 1 m beside its goal."""
    plan = planner.solve(problem, DIRECT, max_iterations=2)
    xs = plan.xs.copy()
    xs[-1, 0] += 1.0
    return replace(plan, xs=xs)


def relaxed(problem, direct, cost_at):
    """relax() with solves that return the direct plan's motion as one that has converged, at a cost by the factor."""
    stiffness = problem.dynamics.mechanism.contacts[0].law.stiffness

    def solve_one(asked, *_):
        factor = stiffness / asked.dynamics.mechanism.contacts[0].law.stiffness
        return replace(direct, problem=asked, cost=cost_at(factor), status=Status.CONVERGED)

    plan, record = relax(problem, direct, solve_one, SolverOptions(), None)
    return plan, [(stage, round(factor or math.inf, 2), kept) for stage, factor, *_, kept in record["steps"]]


def test_softer_contacts_whose_first_plan_costs_far_more_are_given_up(problem, unfinished):
    assert replace(unfinished, status=Status.CONVERGED).missed_goals
    most = 10.0 * max(1.0, unfinished.cost)
    for cost, kept in ((0.99 * most, True), (1.01 * most, False)):
        _, steps = relaxed(problem, unfinished, lambda _, cost=cost: cost)
        assert steps[1] == ("contacts", 10.0, kept)
        assert any(stage == "contacts" for stage, *_ in steps[2:]) is kept


def test_a_plan_on_the_branch_that_lacks_weight_ends_the_continuation(problem, unfinished):
    """Its goals are missed as on softer ground, at the same cost: shorter steps would lead to it again."""
    plan, steps = relaxed(problem, unfinished, lambda factor: 0.5 * unfinished.cost * (1.0 + 0.01 * factor))
    assert [step for step in steps if step[0] == "contacts"] == [("contacts", f, True) for f in (10.0, 3.16, 1.0)]
    assert plan.cost == 0.505 * unfinished.cost
    assert plan.problem is problem
    dearer = relaxed(problem, unfinished, lambda factor: (0.5 if factor > 1.0 else 0.9) * unfinished.cost)[1]
    assert ("contacts", 1.0, False) in dearer  # it fell off its branch
