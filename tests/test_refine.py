"""Refinement: plans that their own step has deceived become plans that MuJoCo repeats, and nothing else is refined."""

import importlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from carts import write

import planner
from planner.figures import Figure, Section
from planner.finer import finer, halved
from planner.plan import Status
from planner.problem_file import load
from planner.refine import Refinement, refine
from planner.warm_start import roll_out, warm_start

module = importlib.import_module("planner.refine")  # the name is the function's in planner

PENDULUM = """
<mujoco model="pendulum">
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body>
      <joint name="pivot" axis="0 -1 0" ARGUMENTS/>
      <inertial pos="0 0 -1" mass="1" diaginertia="1e-6 1e-6 1e-6"/>
    </body>
  </worldbody>
  <actuator><motor joint="pivot"/></actuator>
</mujoco>
"""


def mechanism(arguments=""):
    return planner.Mechanism.from_mjcf(PENDULUM.replace("ARGUMENTS", arguments))


def swing(integrator="semi-implicit-euler", N=20, machine=None, dynamics=None, **weights):
    """A pendulum to the other side in a second, made in Python."""
    machine = machine or mechanism()
    dynamics = dynamics or planner.RigidBodyDynamics(machine, 1.0 / N, integrator)
    weights = {"final_position": 200.0, "final_velocity": 200.0, "effort": 0.1, "position": 0.5} | weights
    cost = planner.TrackingCost.joints(machine, [1.0, 0.0], N, dt=1.0 / N, **weights)
    return planner.Problem(dynamics, cost, x0=[-1.0, 0.0], twin=planner.Twin.of(machine))


def quick(plan):
    return planner.prove(plan, rollouts=0)


def solved(problem):
    plan = planner.solve(problem)
    return plan, quick(plan)


@pytest.fixture(scope="module")
def failed():
    plan, proof = solved(swing())
    assert not proof.passed
    return plan, proof


# Arriving


def arrives(problem, integrators, **options):
    plan, proof = solved(problem)
    assert plan.success
    assert not proof.passed
    lines = []
    refined = refine(plan, proof, callback=lines.append, **options)
    assert refined.passed, refined
    assert refined.plan.success
    assert quick(refined.plan).passed
    assert [line.integrator for line in refined.path] == integrators
    assert tuple(lines) == refined.path
    assert refined.path[0].end_state_error > 10.0 * refined.path[-1].end_state_error
    assert [line.verdict for line in refined.path] == ["FAIL"] * (len(lines) - 1) + ["PASS"]
    return refined


def test_a_swing_up_that_a_semi_implicit_step_had_deceived(tmp_path):
    problem = planner.cases.acrobot(horizon=150, integrator="semi-implicit-euler")
    refined = arrives(problem, ["semi-implicit-euler", "rk4"])
    assert refined.path[0].end_state_error > 1.0  # radians
    assert refined.path[-1].mode == "feedback"
    assert sum(line.seconds for line in refined.path[1:]) < 60.0
    assert refined.plan.cost < 3.0  # the motion is kept: another local minimum costs 6.6
    refined.plan.save(tmp_path / "plan.npz")
    stored = planner.Plan.load(tmp_path / "plan.npz")
    assert stored.parameters == problem.parameters | {"integrator": "rk4"}
    assert quick(stored).passed


def test_an_arm_with_two_motors():
    arrives(planner.cases.two_link(horizon=100, integrator="semi-implicit-euler"), ["semi-implicit-euler", "rk4"])


def test_a_hopper_takes_half_the_stage_too():
    refined = arrives(planner.cases.hopper(horizon=50, integrator="euler"), ["euler", "rk4", "rk4"])
    assert [line.horizon for line in refined.path] == [50, 50, 100]
    assert [line.dt for line in refined.path] == [0.02, 0.02, 0.01]


def test_a_machine_made_in_python():
    refined = arrives(swing(), ["semi-implicit-euler", "rk4"])
    assert refined.plan.problem.cost is not None
    assert refined.plan.case is None
    assert refined.reason == "It passed after 1 refinement."


def test_rates_made_in_python():
    def rates(x, u):
        return np.stack([x[..., 1], (-9.81 * np.sin(x[..., 0]) + u[..., 0]) / (1.0 + 1e-6)], axis=-1)

    def problem(integrator):
        return swing(dynamics=planner.FunctionDynamics(rates, 2, 1, 0.05, integrator))

    arrives(problem("euler"), ["euler", "rk4"])


def test_a_plan_that_passes_is_left_alone():
    plan, proof = solved(swing("rk4", 40))
    refined = refine(plan, proof)
    assert refined.plan is plan
    assert refined.proof is proof
    assert len(refined.path) == 1
    assert refined.reason == "It passed as it was."


# The finer problem


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
    twice = np.concatenate([np.repeat(xs[:-1], 2, axis=0), xs[-1:]]), np.repeat(us, 2, axis=0)
    for whole in (problem.cost, cost):
        assert halved(whole).value(*twice) == pytest.approx(whole.value(xs, us), rel=1e-12)


def test_quaternions_and_prescribed_joints_are_kept():
    text = PENDULUM.replace('name="pivot" axis="0 -1 0" ARGUMENTS', 'name="pivot" type="ball"').replace(
        '<motor joint="pivot"/>', '<motor joint="pivot" gear="0 1 0"/>'
    )
    machine = planner.Mechanism.from_mjcf(text)
    dynamics = planner.RigidBodyDynamics(machine, 0.1, prescribed=("pivot",))
    cost = planner.TrackingCost.joints(dynamics, machine.home, 10, effort=1.0, final_position=1.0)
    fine = finer(planner.Problem(dynamics, cost, x0=machine.home))
    assert fine.dynamics.prescribed == ("pivot",)
    assert fine.cost.space == machine.space
    assert fine.twin is None


def discrete():
    dynamics = planner.FunctionDynamics(lambda x, u: x + 0.05 * u, 2, 2, 0.05, "discrete")
    cost = planner.TrackingCost.reach([1.0, 1.0], 20, final=1.0, effort=1.0, nu=2)
    return planner.Problem(dynamics, cost, [0.0, 0.0])


def strange(problem):
    """With dynamics of a user's own."""
    names = ("nx", "nu", "dt", "step", "linearize", "space")
    dynamics = SimpleNamespace(**{name: getattr(problem.dynamics, name) for name in names})
    return replace(problem, dynamics=dynamics)


class Own:
    """A user's own cost."""

    def value(self, xs, us):
        return 0.0

    def quadratize(self, xs, us):
        raise NotImplementedError


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
def test_what_cannot_be_made_finer_says_so(problem, fragment):
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
    chosen = roll_out(fine, warm_start(plan, fine))[0]
    others = [(fine.first_guess,), (plan.us,), (plan.us, plan.K, plan.xs)]
    # none of these stays near the old motion; gains of the new dynamics do
    assert chosen < 0.1 * min(roll_out(fine, *other)[0] for other in others)
    for K in (0.0 * plan.K, np.full_like(plan.K, np.nan)):  # whatever the plan's gains are
        assert roll_out(fine, warm_start(replace(plan, K=K), fine))[0] == chosen


def test_every_way_may_be_the_best():
    plan = planner.solve(swing("rk4", 40))
    fine = finer(plan.problem)
    np.testing.assert_allclose(warm_start(plan, fine), np.repeat(plan.us, 2, axis=0), atol=0.05)
    better = replace(fine, us=planner.solve(fine).us)
    np.testing.assert_array_equal(warm_start(plan, better), better.us)


def test_a_runaway_costs_infinitely_much():
    problem = planner.cases.hopper(horizon=20)
    with np.errstate(all="ignore"):
        cost, _ = roll_out(problem, np.full((20, 1), 1e308), np.full((20, 1, 3), 1e308), np.zeros((21, 3)))
    assert cost == np.inf


# What is refined


def section(title, name="an_error", value=1.0):
    return Section(title, (Figure(name, value, "rad", 0.1),))


@pytest.mark.parametrize(
    ("changes", "fragment"),
    [
        ({"plan": section("plan")}, "where plan fails: an error 1 rad"),
        ({"parity": section("parity")}, "where parity fails"),
        ({"same_step": section("same step")}, "where same step fails"),
        ({"goal": section("goal", "planned_goal_error")}, "misses its goal: planned goal error 1 rad"),
        ({"refined_feedback": section("refined", value=0.0), "reason": "Far."}, "repeats the plan (feedback): Far."),
        ({"errors": SimpleNamespace(ratio=lambda mode: 50.0)}, "50 times worse than the step makes it (open-loop)"),
    ],
    ids=["plan", "parity", "same step", "goal", "tracked", "growth"],
)  # fmt: skip
def test_other_failures_are_left_alone(failed, changes, fragment):
    plan, proof = failed
    proof = replace(proof, **changes)
    refined = refine(plan, proof)
    assert refined.plan is plan
    assert refined.proof is proof
    assert fragment in refined.reason
    assert refined.reason.startswith("A finer step does not help where ")


def test_a_goal_that_only_the_replay_misses_is_refined(failed):
    plan, proof = failed
    assert refine(plan, replace(proof, goal=section("goal", "replayed_goal_error"))).passed


def test_a_range_that_the_plan_reaches():
    """Only MuJoCo knows the range, so its replay stops there, and would at every step."""
    plan, proof = solved(swing(machine=mechanism('range="-80 30" limited="true"')))
    assert not proof.passed
    refined = refine(plan, proof)
    assert not refined.passed
    assert "the plan itself goes where MuJoCo holds it: joint 'pivot' is outside" in refined.reason


def test_a_floor_that_the_plan_goes_through():
    """The tip swings through it, and MuJoCo's does not."""
    solid = '<geom type="sphere" size="0.05" pos="0 0 -1" mass="0"/></body>'
    floor = '<geom type="plane" size="1 1 1" pos="0 0 -0.9"/>'
    problem = swing()
    plan = planner.solve(problem)
    text = plan.twin.mjcf.replace("<worldbody>", f"<worldbody>{floor}").replace("</body>", solid)
    proof = planner.prove(plan, twin=replace(plan.twin, mjcf=text), rollouts=0)
    assert not proof.passed
    assert "the plan itself goes where MuJoCo holds it: shapes touch at t = " in refine(plan, proof).reason


def test_a_range_that_only_a_replay_gone_astray_reaches():
    plan = planner.solve(planner.cases.acrobot(horizon=150, integrator="semi-implicit-euler"))
    far = np.abs(plan.xs[:, 1]).max() + 0.2
    text = plan.twin.mjcf.replace('name="elbow"', f'name="elbow" limited="true" range="{-far} {far}"', 1)
    assert text != plan.twin.mjcf
    limited = planner.prove(plan, mjcf=text, rollouts=0)
    assert limited.replay.reached
    assert module._from_discretisation(limited) == ""


# Ends


def test_the_limit_ends_it(failed):
    plan, proof = failed
    judged = []

    def strict(plan):
        judged.append(plan)
        return replace(proof, replay=proof.replay)

    refined = refine(plan, proof, limit=2, prove=strict)
    assert refined.reason == "The limit of 2 refinements was reached."
    assert [line.horizon for line in refined.path] == [20, 20, 40]
    assert [plan.N for plan in judged] == [20, 40]
    assert refined.plan is judged[-1]
    assert refine(plan, proof, limit=0).reason == "The limit of 0 refinements was reached."


def test_the_time_ends_it(failed, monkeypatch):
    _, proof = failed
    plan = planner.solve(planner.cases.two_link(horizon=50, integrator="semi-implicit-euler"))  # of 26 iterations
    seconds = iter(range(1000))
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: next(seconds)))
    refined = refine(plan, proof, seconds=8.0, prove=lambda _: proof)
    assert refined.reason == "The time limit of 8 s was reached."
    assert len(refined.path) == 2
    assert refined.path[-1].status is Status.INTERRUPTED  # the solve was cut, and its plan proved
    assert 1 < refined.path[-1].iterations < 8
    assert len(refine(plan, proof, seconds=0.0).path) == 1


def test_the_callback_and_ctrl_c_end_it(failed, monkeypatch):
    plan, proof = failed

    def stop(_):
        raise StopIteration

    assert refine(plan, proof, callback=stop).reason == "It was interrupted."
    assert refine(*failed, callback=stop).plan is plan

    def interrupted(problem, **_):
        return replace(plan, problem=problem, status=Status.INTERRUPTED)

    monkeypatch.setattr(module, "solve", interrupted)
    refined = refine(plan, proof, prove=lambda _: proof)
    assert refined.reason == "It was interrupted."
    assert len(refined.path) == 2


def test_a_plan_that_runs_away_ends_it(failed, monkeypatch):
    plan, proof = failed
    monkeypatch.setattr(module, "solve", lambda problem, **_: replace(plan, status=Status.NOT_FINITE))
    refined = refine(plan, proof)
    assert refined.plan is plan
    assert "lead to infinite states" in refined.reason


def test_what_cannot_be_refined_ends_it(failed):
    plan, proof = failed
    rough = replace(plan, problem=strange(plan.problem))
    refined = refine(rough, proof)
    assert refined.plan is rough
    assert refined.reason.startswith("It cannot be refined: the dynamics are of the type SimpleNamespace")


def test_options_reach_the_solver(failed):
    refined = refine(*failed, limit=1, prove=lambda _: failed[1], max_iterations=1)
    assert refined.path[-1].iterations == 1
    with pytest.raises(planner.PlannerError, match="update is 'best'"):
        refine(*failed, update="best")


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        ({"limit": -1}, "limit is -1"),
        ({"seconds": float("nan")}, "seconds is nan"),
        ({"plan": None}, "plan is None"),
        ({"proof": None}, "proof is None"),
    ],
    ids=str,
)
def test_wrong_arguments_are_refused(failed, arguments, fragment):
    given = {"plan": failed[0], "proof": failed[1]} | arguments
    with pytest.raises(planner.PlannerError, match=fragment):
        refine(**given)


def test_lines_stand_under_their_header():
    header = Refinement.header()
    numbers = ("semi-implicit-euler", 0.02, 150, 574, 2.15)
    line = str(Refinement(*numbers, Status.CONVERGED, "PASS", "open-loop", 6.25, 1.5))
    ends = {"integrator": "euler", "stage, s": "0.02", "horizon": "150", "cost": "2.15", "error": "6.25e+00"}
    for word, end in ends.items():
        assert header.index(word) + len(word) == line.index(end) + len(end), word
    assert header.index("status") == line.index("CONVERGED")
    assert header.index("verdict") == line.index("PASS")
