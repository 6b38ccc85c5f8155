"""Refinement: plans that their own step has deceived become plans that MuJoCo repeats, and nothing else is refined."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from places import ROOT
from swings import mechanism, quick, solved, strange, swing

import planner
from planner.base.measured import Measurement, Section
from planner.cases.problem_file import load
from planner.problem.plan import Status
from planner.problem.rediscretize import step_error
from planner.proof.diagnostics.solving import contacts_differ, shorter_stage
from planner.proof.error_scales import SMOOTHED, ranges_of_motion
from planner.proof.original_model import OVERLAPS_THAT_PUSH
from planner.proof.repair import refinement
from planner.proof.repair.refinement import Refinement, refine
from planner.solvers.work import WorkBudget, work_of_stage


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
    assert refined.path[0].end_error > 10.0 * refined.path[-1].end_error
    assert [line.verdict for line in refined.path] == ["FAIL"] * (len(lines) - 1) + ["PASS"]
    return refined


@pytest.mark.slow
def test_a_swing_up_that_a_semi_implicit_step_had_deceived():
    problem = planner.cases.acrobot(horizon=150, integrator="semi-implicit-euler")
    refined = arrives(problem, ["semi-implicit-euler", "rk4"])
    assert refined.path[0].end_error > 10.0  # bounds
    assert refined.path[-1].mode == "feedback"
    assert sum(line.seconds for line in refined.path[1:]) < 60.0
    first = planner.solve(problem)
    for furthest in (np.min, np.max):  # the motion is kept: in others of the acrobot the elbow turns by radians more
        kept = furthest(refined.plan.xs[:, :2], axis=0) - furthest(first.xs[:, :2], axis=0)
        assert np.abs(kept).max() < 0.5


def test_a_refined_plan_is_stored_with_its_integrator(tmp_path):
    problem = planner.cases.two_link(horizon=100, integrator="semi-implicit-euler")
    refined = arrives(problem, ["semi-implicit-euler", "rk4"])
    refined.plan.save(tmp_path / "plan.npz")
    stored = planner.load_plan(tmp_path / "plan.npz")
    assert stored.parameters == problem.parameters | {"integrator": "rk4"}
    assert quick(stored).passed


@pytest.mark.slow
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


# What is refined


def section(title, name="an_error", value=1.0):
    return Section(title, (Measurement(name, value, "rad", 0.1),))


@pytest.mark.parametrize(
    ("changes", "fragment"),
    [
        ({"sections": {"plan": section("plan")}}, "where plan fails: an error 1 rad"),
        ({"sections": {"parity": section("parity")}}, "where parity fails"),
        ({"sections": {"same_step": section("same step")}}, "where same step fails"),
        ({"sections": {"goal": section("goal", "planned_goal_error")}}, "misses its goal: planned goal error 1 rad"),
        ({"sections": {"refined_feedback": section("refined", value=0.0)}, "reason": "Far."},
         "repeats the plan (feedback): Far."),
        ({"errors": SimpleNamespace(ratio=lambda mode: 50.0)}, "50 times worse than the step makes it (open-loop)"),
    ],
    ids=["plan", "parity", "same step", "goal", "tracked", "growth"],
)  # fmt: skip
def test_other_failures_are_left_alone(failed, changes, fragment):
    plan, proof = failed
    sections = proof.sections | changes.get("sections", {})
    proof = replace(proof, **changes | {"sections": sections})
    refined = refine(plan, proof)
    assert refined.plan is plan
    assert refined.proof is proof
    assert fragment in refined.reason
    assert refined.reason.startswith("A finer step does not help where ")


def test_a_plan_that_its_steps_do_not_resolve_is_refined(failed):
    plan, proof = failed
    plan = replace(plan, status=Status.UNRESOLVED)
    repeated = proof.sections | {"refined_feedback": section("refined", value=0.0)}
    proof = replace(proof, sections=repeated, replay=replace(proof.replay, plan=plan))
    assert refine(plan, proof).passed


@pytest.mark.slow
def test_a_ball_that_is_pushed_is_refined_to_half_the_stage_in_as_many_substeps():
    """Three substeps follow the arm at its start, and not the ball's contact; of half a stage two would.

    Whether the first plan is resolved, and whether the finer one passes, are matters of a processor's rounding.
    """
    plan = load(ROOT / "benchmarks" / "moving" / "ball-push.toml").solved(None)
    plan = replace(plan, status=Status.UNRESOLVED)
    refined = refine(plan, planner.prove(plan, rollouts=0), limit=1)
    assert refined.plan.N == 2 * plan.N
    assert refined.plan.problem.dynamics.substeps == plan.problem.dynamics.substeps == 3


def test_a_goal_that_only_the_replay_misses_is_refined(failed):
    plan, proof = failed
    sections = proof.sections | {"goal": section("goal", "replayed_goal_error")}
    assert refine(plan, replace(proof, sections=sections)).passed


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
    assert refinement._other_cause(limited) == ""


def test_shapes_that_overlap_at_the_start_and_push(failed):
    _, proof = failed
    assert refinement._other_cause(proof) == ""
    seen = (Measurement("unknown_contacts", 1.0, "", 0.0), Measurement(OVERLAPS_THAT_PUSH, 1.0, "", None))
    file = replace(proof.your_file, measured=(*proof.your_file.measured, *seen), not_applicable="")
    other = refinement._other_cause(replace(proof, sections=proof.sections | {"your_file": file}))
    assert other.startswith("shapes of the file overlap at the start")


@pytest.fixture(scope="module")
def rise():
    """A plan of a machine with contacts, and its proof as if both refined replays failed."""
    plan = planner.solve(planner.load_problem("quadruped"))
    proof = planner.prove(plan, rollouts=0)
    failing = {name: section(name) for name in ("refined_open_loop", "refined_feedback")}
    errors = SimpleNamespace(ratio=lambda mode: None)
    return plan, replace(proof, sections=proof.sections | failing, errors=errors)


@pytest.mark.parametrize(("bounds", "of_contacts"), [(2.0, False), (6.0, True), (110.0, False)])
def test_contacts_that_are_the_cause(rise, bounds, of_contacts):
    """An error of the replay that is far above that of the step, but a small one; one that has fallen says nothing."""
    plan, proof = rise
    run, thigh = proof.replays["feedback"], 8  # an angle
    error = np.zeros_like(run.error)
    error[1:, thigh] = bounds * SMOOTHED * ranges_of_motion(plan)[thigh]
    assert bounds * SMOOTHED > 10.0 * step_error(plan)
    moved = SimpleNamespace(plan=run.plan, error=error)
    off = replace(proof, replays=proof.replays | {"feedback": moved})
    other = refinement._other_cause(off)
    assert other.startswith("contacts put the replay " if of_contacts else "")
    assert bool(other) is of_contacts
    shares = {"feedback": np.full(plan.N + 1, bounds)}  # by a step that is said to make as much
    off = replace(off, errors=SimpleNamespace(ratio=lambda mode: 1.0, measured=shares, predicted=shares))
    assert bool(shorter_stage(plan, plan.problem, off)) is not of_contacts  # none that does not help
    found = contacts_differ(plan, plan.problem, off)
    assert [(one.code, one.values["off"]) for one in found] == (
        [("contacts_differ", pytest.approx(bounds))] * of_contacts
    )


# Ends


def test_the_limit_of_refinements_ends_refinement(failed):
    plan, proof = failed
    judged = []

    def strict(plan):
        judged.append(plan)
        return replace(proof, replay=proof.replay)

    refined = refine(plan, proof, limit=1, prove=strict)
    assert refined.reason == "The limit of 1 refinement was reached."
    assert [line.horizon for line in refined.path] == [20, 20]
    assert [plan.N for plan in judged] == [20]
    assert refined.plan is judged[-1]
    assert refine(plan, proof, limit=0).reason == "The limit of 0 refinements was reached."


@pytest.mark.parametrize(
    ("errors", "ends"),
    [
        ((2.3, 2.2, 2.15), True),
        ((4.0, 2.0, 1.5), False),
        ((0.9, 0.8, 0.8), False),
        ((math.inf, math.inf, 2.0), False),
        ((4e3, 4e3, 4e3), False),
    ],
)
def test_an_end_error_that_half_the_step_leaves_ends_refinement(failed, errors, ends):
    """Within its bound it is not what fails; a step of first order halves it."""
    path = [SimpleNamespace(end_error=error) for error in errors]
    assert refinement._done(failed[1], path, 4).endswith("hardly changes the error of the end.") is ends
    assert refinement._done(failed[1], path[:2], 4) == ""  # RK4 in place of Euler may be another plan


@pytest.mark.parametrize(
    ("errors", "ends"),
    [
        ((17.0, 585.0, 552.0), True),
        ((17.0, 585.0, 9.0), False),
        ((1e-3, 0.02, 0.02), False),  # all within their bounds: something else fails
        ((17.0, 585.0), False),
        ((17.0, math.inf, math.inf), True),
    ],
)
def test_of_two_refinements_that_end_further_off_none_is_kept(failed, monkeypatch, errors, ends):
    """Gains of shorter stages may follow a foot worse than those of longer ones."""
    plan, proof = failed
    lines = iter(errors)
    monkeypatch.setattr(refinement, "_end_error", lambda _, mode: next(lines) if mode == "feedback" else 1.0)
    refined = refine(plan, proof, limit=len(errors) - 1, prove=lambda _: replace(proof, replay=proof.replay))
    assert (refined.plan is plan) is ends
    assert (refined.proof is proof) is ends
    assert len(refined.path) == len(errors)


def test_the_work_budget_ends_refinement(failed):
    _, proof = failed
    plan = planner.solve(planner.cases.two_link(horizon=50, integrator="semi-implicit-euler"))  # of 26 iterations
    work = 10 * plan.N * work_of_stage(plan.problem)
    refined = refine(plan, proof, budget=WorkBudget(work), prove=lambda _: proof)
    assert refined.reason.startswith("The work budget of the run was reached")
    assert refined.plan is plan  # a solve that was cut has no plan to prove, and is no Ctrl-C
    assert len(refined.path) == 1
    assert len(refine(plan, proof, budget=WorkBudget(0.0)).path) == 1


def test_the_callback_and_ctrl_c_end_it(failed, monkeypatch):
    plan, proof = failed

    def stop(_):
        raise StopIteration

    assert refine(plan, proof, callback=stop).reason == "It was interrupted."
    assert refine(*failed, callback=stop).plan is plan

    def interrupted(problem, **_):
        return replace(plan, problem=problem, status=Status.INTERRUPTED)

    monkeypatch.setattr(refinement, "solve", interrupted)
    refined = refine(plan, proof, prove=lambda _: proof)
    assert refined.reason == "It was interrupted."
    assert len(refined.path) == 2


def test_a_plan_that_runs_away_ends_it(failed, monkeypatch):
    plan, proof = failed
    monkeypatch.setattr(refinement, "solve", lambda problem, **_: replace(plan, status=Status.NOT_FINITE))
    refined = refine(plan, proof)
    assert refined.plan is plan
    assert "lead to infinite states" in refined.reason


def test_a_problem_that_cannot_be_refined_ends_refinement(failed):
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
        ({"plan": None}, "plan is None"),
        ({"proof": None}, "proof is None"),
    ],
    ids=str,
)
def test_wrong_arguments_of_refine_are_refused(failed, arguments, fragment):
    given = {"plan": failed[0], "proof": failed[1]} | arguments
    with pytest.raises(planner.PlannerError, match=fragment):
        refine(**given)


def test_lines_stand_under_their_header():
    header = Refinement.header()
    numbers = ("semi-implicit-euler", 0.02, 150, 574, 2.15)
    line = str(Refinement(*numbers, Status.CONVERGED, "PASS", "open-loop", 6.25, 1.5))
    ends = {"integrator": "euler", "stage, s": "0.02", "horizon": "150", "cost": "2.15", "end error/bound": "6.25e+00"}
    for word, end in ends.items():
        assert header.index(word) + len(word) == line.index(end) + len(end), word
    assert header.index("status") == line.index("CONVERGED")
    assert header.index("verdict") == line.index("PASS")
