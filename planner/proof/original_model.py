"""Step 6 of a proof: the plan in the model exactly as the user gave it.

A plan's model may lack contacts, friction loss or equalities of the user's file. Here the file is simulated unedited,
at a refined step, under the plan's controls alone and with its gains as in step 3. Each mode is judged by itself: a
plan passes in a mode if steps 3, 4 and 6 pass in it. Prescribed joints of the plan are moved by motors in it too, and
torques that MJCF cannot express act in it too.

The integrator is MuJoCo's RK4, as in the rest of a proof: Euler's error at the refined step alone is 0.4 rad of the
acrobot's path, which is no error of a plan. A stiff file may need its own integrator, which is used where RK4 fails. A
plan with implicit damping is replayed by MuJoCo's implicitfast. That is of first order: where damping is as fast as its
step, its own error after a control jump is a fifth of the jump. If it fails, the plan's method takes smaller steps with
the accelerations that MuJoCo computes of the file.

Elements that the plan's model lacks must have no effect: no contact of an unmodelled pair, no joint limit reached, no
actuator clamp, no divergence, every goal is met, and the path stays within the bounds of the path in the plan's model.
With gains, the path without them may do that in their place.
Pairs that penetrate at the plan's start are watched in the file, where MuJoCo would separate them by force: they must
not go deeper, nor part and meet again. The verdict names them. So are pairs that prescribed joints alone move.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.base.measured import Measurement, Section
from planner.model.capabilities import capabilities_of, stationary_object_bodies, stationary_object_dofs
from planner.model.mechanism import SCREW
from planner.model.mjcf.file_law import watched_pairs
from planner.model.mjcf.initial_overlaps import (
    MAX_EMBEDDED,
    OVERLAP_TOLERANCE,
    TOUCH_ROUNDING,
    distances_in,
    initial_overlaps,
    starts_inside,
    watching,
)
from planner.model.mjcf.model_index import ModelIndex, named
from planner.model.mjcf.prescribed_joints import in_order, prescribe_joints
from planner.model.mjcf.unmodelled_features import names_of
from planner.model.mjcf.unsupported import unsupported_elements
from planner.model.twin import Twin
from planner.problem.goals import GoalCheck
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.error_scales import (
    bounds_in_file,
    has_contacts,
    is_path_judged,
    path_error_bounds,
    replayed_violations,
    worst_by_unit,
)
from planner.proof.reached_limits import clamps_hit, largest_excess, stops_hit
from planner.proof.replay_errors import misses
from planner.proof.replays.compiled_twin import CompiledTwin, unmodelled_of, with_model
from planner.proof.replays.replaying import Replay, passages, replay_in
from planner.proof.replays.sampled_gains import sampling_of
from planner.proof.replays.simulation import NATIVE_IMPLICIT, ROSENBROCK, damping_of
from planner.proof.robustness.rollouts import MODES
from planner.proof.verdict import PATH_WITH_GAINS

TITLE = "your file"
OPEN_LOOP_MISSES = "open_loop_misses"
EQUALITY_RATE = "equality_rate"
TIMESTEP = "timestep"
PATH_IN_FILE = "path_over_its_bound"  # above 1, its note is for the first line
RANGE_EXCESS = "range_excess"
OVERLAPS_THAT_PUSH = "overlaps_at_the_start_that_push"
MAX_NAMED = 3  # pairs, joints or actuators in a sentence
NEGLIGIBLE_FORCE = 1e-3  # of the machine's weight: smaller contact forces of flush shapes are ignored
MAX_GAIN_EFFORT = 0.02  # of a control's largest value: larger corrections by the gains show unmodelled forces
DEEPER = 1e-3, 0.1  # m (as GRAZE), or share of the initial depth: tolerated growth of an overlap at the start


class PrescriptionError(ModelError):
    """The file's joints cannot be prescribed as in the plan."""


@np.errstate(all="ignore")  # a trajectory may diverge: NaN passes no bound
def your_file(
    plan: Plan, problem: Problem, goals: Sequence[GoalCheck], *, runs: Mapping[str, Replay] | None = None,
    followed: Sequence[str] = MODES[1:], mjcf: Any = None, twin: Twin | None = None,
) -> dict[str, tuple[Section, Replay | None]]:  # fmt: skip
    """Replay a plan in the model as the user gave it, open loop and with its gains, and judge unmodelled elements.

    Args:
        plan: A plan of this problem.
        problem: With a twin.
        goals: Goal checks of the end, where the machine has no rule of its own.
        runs: The replays of step 3 by mode; reused where the file is the model that they ran in.
        followed: The modes that may still pass: integrators are tried until each of them does.
        mjcf: Another MJCF, a path or the XML text, in place of the user's own; nothing is taken out.
        twin: Another model and other maps in place of the plan's own.

    Returns:
        By mode, the step and the replay in the file; None where the step does not apply.

    Raises:
        PlannerError: The plan cannot be replayed.
        ModelError: MuJoCo refuses the file, or it is of another machine.
    """
    twin = twin or plan.twin
    if twin is None:
        return _not_applicable("the plan has no MuJoCo model to be replayed in")
    try:
        given = as_given(problem, twin, mjcf)
    except PrescriptionError as error:
        return _not_applicable(str(error))
    known, sampling = tuple((runs or {}).values()), sampling_of(plan)
    if known and _same_model(known[0].twin, given.twin):
        given = known[0].compiled  # compiled already
    compiled = _without_overlaps(problem, given)
    planned = known[0].plan_xs if known else None
    own = load_mujoco().mjtIntegrator(compiled.model.opt.integrator).name.removeprefix("mjINT_")
    tried = ("RK4", own) if damping_of(problem.dynamics) is None else (NATIVE_IMPLICIT, ROSENBROCK, own)
    best: dict[str, tuple[Section, Replay]] = {}
    for integrator in dict.fromkeys(tried):
        at_hand = {one.feedback: one for one in known if one.compiled is compiled and one.integrator == integrator}
        both: dict[str, Replay] = {}
        for mode, feedback in zip(MODES, (False, True), strict=True):
            both[mode] = at_hand.get(feedback) or replay_in(
                compiled, plan, feedback=feedback, integrator=integrator, sampling=sampling, planned=planned
            )
            planned = both[mode].plan_xs
        for mode, section in _sections(problem, both, goals).items():
            if mode not in best or len(section.failures) < len(best[mode][0].failures):
                best[mode] = section, both[mode]
        if all(best[mode][0].passed for mode in followed):  # by one integrator or another; more cannot help
            break
    return dict(best)


def _not_applicable(why: str) -> dict[str, tuple[Section, Replay | None]]:
    return dict.fromkeys(MODES, (Section(TITLE, not_applicable=why), None))


def _sections(problem: Problem, both: Mapping[str, Replay], goals: Sequence[GoalCheck]) -> dict[str, Section]:
    """What is judged and shown of the replays in the file by mode, each by the same rules."""
    alone, fed = (both[mode] for mode in MODES)
    openly = Section(TITLE, (*_measured(alone, problem, goals), *_path(fed, alone, ("without gains",))))
    ends = _open_loop(alone, openly.failures)
    with_gains = (*_measured(fed, problem, goals), *_path(fed, alone, ("with gains", "without gains")), *ends)
    return {MODES[0]: replace(openly, measured=(*openly.measured, *ends)), MODES[1]: Section(TITLE, with_gains)}


def _measured(run: Replay, problem: Problem, goals: Sequence[GoalCheck]) -> list[Measurement]:
    """What is judged and shown of one replay, but for its path."""
    touching, at_start, overlaps = _touches(run, problem)
    sentences = {
        "unknown_contacts": (touching, "touches of pairs that the plan's model lacks"),
        "passages_between_steps": (passages(run), "shapes that pass through each other between two steps"),
        "unknown_stops": (stops_hit(run), "joints that run into a stop that the plan's model lacks"),
        "clamped_actuators": (clamps_hit(run), "actuators that are asked for more than they give"),
        "simulator_warnings": (list(run.warnings), "MuJoCo's complaints"),
    }
    judged = [
        Measurement(name, float(len(found)), "", 0.0, _together(found) or meaning)
        for name, (found, meaning) in sentences.items()
    ]
    method = "Rosenbrock, with MuJoCo's accelerations" if run.integrator == ROSENBROCK else f"MuJoCo's {run.integrator}"
    step = Measurement(TIMESTEP, run.timestep, "s", None, f"of {method}, for this step of the proof")
    kept = replayed_violations(run, problem, problem.constraints)  # joint ranges are judged by stops_hit()
    return [
        *judged,
        *_goals(run, problem, goals),
        *kept,
        *_objects(run, problem),
        *_forces(run, overlaps),
        *_range_excess(run),
        *([Measurement(OVERLAPS_THAT_PUSH, float(at_start), "", None, "of the unknown contacts")] if at_start else []),
        step,
    ]


def _range_excess(run: Replay) -> list[Measurement]:
    """How far the replay moves a joint beyond its range: nothing where no joint is."""
    worst = largest_excess(run)
    note = "" if worst is None else f"of {worst.name}"
    return [] if worst is None else [Measurement(RANGE_EXCESS, float(worst.beyond.max()), worst.unit, None, note)]


def as_given(problem: Problem, twin: Twin, mjcf: Any = None) -> CompiledTwin:
    """The user's file, or `mjcf`, in place of a twin's text, unedited but for motors of prescribed joints."""
    if mjcf is None and not twin.original:
        return CompiledTwin(twin)
    given = with_model(twin, mjcf) if mjcf is not None else replace(twin, mjcf=twin.original)
    compiled = CompiledTwin(given)
    mechanism, prescribed = (getattr(problem.dynamics, name, None) for name in ("mechanism", "prescribed"))
    if mechanism is None and not twin.original:
        return compiled  # which actuators such dynamics have is unknown
    model = compiled.model
    unused = [one.index for one in unsupported_elements(model) if one.kind == "actuator"]
    if prescribed and mechanism and model.nu - len(unused) == mechanism.nu:  # else motors exist already
        try:
            text = prescribe_joints(given.mjcf, given.assets, model, in_order(mechanism, prescribed))
        except ModelError as error:
            raise PrescriptionError(f"the plan prescribes joints that cannot be driven in the file: {error}") from None
        given = replace(given, mjcf=text)
    used = CompiledTwin(_with_idle_states(given, model, unused), unused)
    if given.mjcf == compiled.twin.mjcf:
        used.model = model  # compiled already
    return used


def _without_overlaps(problem: Problem, compiled: CompiledTwin) -> CompiledTwin:
    """The file with pairs that overlap at the start and are not in the plan's model watched, not pushed apart."""
    model, known = compiled.model, unmodelled_of(problem, compiled).known
    start = compiled.twin.sim_of(problem.x0)
    if len(start) != model.nq + model.nv + model.na:
        return compiled  # of another machine: reported by the check before a replay
    pairs = [pair for pair in initial_overlaps(model, start[: model.nq]) if names_of(model, pair) not in known]
    if not pairs:
        return compiled
    try:
        text = watching(compiled.twin.mjcf, model, pairs)
    except ModelError:  # generated shapes, which cannot be edited: they are judged as they are
        return compiled
    return CompiledTwin(replace(compiled.twin, mjcf=text), compiled.unused)


def _with_idle_states(twin: Twin, model: Any, unused: Sequence[int]) -> Twin:
    """The twin with maps for activations that the plan lacks; they start at 0."""
    idle = {int(model.actuator_actadr[i]) + k for i in unused for k in range(int(model.actuator_actnum[i]))}
    idle -= {address for address in idle if address < 0}
    if not idle:
        return twin
    nw = model.nq + model.nv + model.na
    kept = [i for i in range(nw) if i - model.nq - model.nv not in idle]
    if len(kept) != twin.to_x.shape[1]:
        return twin  # of another machine: reported by the check before a replay
    to_x, to_sim = np.zeros((len(twin.to_x), nw)), np.zeros((len(twin.to_sim), nw, len(twin.to_x)))
    offset = np.zeros((len(twin.to_sim), nw))
    to_x[:, kept], to_sim[:, kept], offset[:, kept] = twin.to_x, twin.to_sim, twin.to_sim_offset
    return replace(twin, to_x=to_x, to_sim=to_sim, to_sim_offset=offset)


def _same_model(one: Twin, other: Twin) -> bool:
    return one.mjcf == other.mjcf and one.assets == other.assets and one.curves == other.curves


def _touches(run: Replay, problem: Problem) -> tuple[list[str], int, list[str]]:
    """Sentences about unmodelled pairs in contact, how many of these overlap at the start, and sentences about others.

    The others overlap at the start and go no deeper.
    """
    model, wrong, at_start, overlaps = run.compiled.model, [], 0, []
    beside = bodies_at_rest(problem, model)
    known, watched, index = unmodelled_of(problem, run.compiled).known, watched_pairs(model), ModelIndex(model)
    scale = min(1.0, float(model.stat.extent))
    rubs = NEGLIGIBLE_FORCE * float(model.body_mass.sum()) * float(np.linalg.norm(model.opt.gravity) or 1.0)
    for touch in run.contact_extremes:
        if np.all(beside[model.geom_bodyid[list(touch.geoms)]]):
            continue
        grazes, presses = touch.deepest <= TOUCH_ROUNDING * scale, touch.force > rubs
        acts = names_of(model, touch.geoms) in known and frozenset(touch.geoms) not in watched
        if acts or (grazes and not presses):
            continue
        pair = " and ".join(named(model, "geom", geom) for geom in sorted(touch.geoms))
        overlap = touch.at_start > TOUCH_ROUNDING * scale
        depth = touch.at_start and -distances_in(model, run.qpos[0], [touch.geoms], 0.0)[touch.geoms]  # without margins
        if starts_inside(index, touch.geoms, run.qpos[0], depth):
            wrong.append(
                f"{pair} overlap by {depth:.3g} m at the start, expected at most {MAX_EMBEDDED * scale:.2g} m "
                "of what can move out of it: move one of the two, or exclude the pair in the model "
                "(<contact><exclude>)."
            )
        elif presses and (grazes or (overlap and _pushed(run))):  # overlapping shapes may carry load
            how = f"overlap by {touch.at_start:.3g} m at the start" if overlap else "lie flush"
            when = f"from t = {run.t[touch.first]:.4g} s"
            wrong.append(f"{pair} {how} and press on each other {when} with up to {touch.force:.3g} N.")
        elif not overlap:
            wrong.append(f"{pair} touch from t = {run.t[touch.first]:.4g} s, by up to {touch.deepest:.3g} m.")
        elif goes_deeper(touch.at_start, touch.deepest - touch.at_start, scale):
            wrong.append(f"{pair} touch at the start by {touch.at_start:.3g} m, later by up to {touch.deepest:.3g} m.")
        elif touch.met_again > OVERLAP_TOLERANCE * scale:
            wrong.append(f"{pair} touch at the start, part, and meet again by up to {touch.met_again:.3g} m.")
        else:
            overlaps.append(f"{pair} touch at the start by {touch.at_start:.3g} m and go no deeper.")
            continue
        at_start += overlap
    return wrong, at_start, overlaps


def bodies_at_rest(problem: Problem, model: Any) -> np.ndarray:
    """(nbody,) bool, bodies that no control moves: those fixed to the world, and objects at rest on it."""
    mechanism, fixed = capabilities_of(problem.dynamics).mechanism, model.body_weldid == 0
    if mechanism is not None and len(mechanism.bodies) == model.nbody:
        fixed = fixed | stationary_object_bodies(mechanism)
    return np.asarray(fixed)


def goes_deeper(at_start: float, by: float, scale: float) -> bool:
    """Whether an overlap at the start grows by more than is tolerated, in a model of a scale, m."""
    return by > max(DEEPER[0] * scale, DEEPER[1] * at_start)


def _pushed(run: Replay) -> bool:
    """Whether unmodelled forces have an effect: path errors beyond their bounds, or large corrections by the gains."""
    us = np.repeat(run.plan.us, run.substeps, axis=0)
    size = np.abs(us).max(axis=0)
    added = np.abs(run.ctrl - us).max(axis=0) > MAX_GAIN_EFFORT * np.maximum(
        size, MAX_GAIN_EFFORT * size.max(initial=0.0)
    )
    return bool(np.any(added)) or not bool(np.all(np.abs(run.error) <= path_error_bounds(run.plan)))


def _together(sentences: list[str]) -> str:
    """The first sentences, and the number of the others."""
    more = [f"And {len(sentences) - MAX_NAMED} more."] if len(sentences) > MAX_NAMED else []
    return " ".join([*sentences[:MAX_NAMED], *more])


def _goals(run: Replay, problem: Problem, goals: Sequence[GoalCheck]) -> Sequence[Measurement]:
    """Distance of the end from each goal, or the measurements of the machine's own rule."""
    if problem.requirements is not None and problem.requirements.goal is not None:
        return problem.requirements.goal(run).measured
    return misses("replayed", run.t, run.xs, tuple(goals))


def _path(fed: Replay, alone: Replay, modes: Sequence[str]) -> list[Measurement]:
    """The largest deviation from the plan at any step, of each unit, in whichever of the modes follows better.

    Of a plan with contacts, whose law may be another than the file's, the path is not judged, and its velocities, which
    jump there, are no part of the shares; where the file's equalities are softer than the plan's it may be off by
    SMOOTHED.
    What is beyond its own bound is said by the first measurement, for the first line.
    """
    plan, rate = fed.plan, _spring_rate(fed.compiled.model)
    allowed = bounds_in_file(plan, rate)
    errors = {
        how: list(worst_by_unit(plan, run.error, allowed))
        for how, run in (("with gains", fed), ("without gains", alone))
    }
    judged = {how: [one for one in each if is_path_judged(plan, one.unit)] for how, each in errors.items()}
    shares = {how: max(one.share for one in each) for how, each in judged.items()}
    how = min(modes, key=lambda how: shares[how])
    worst = max(judged[how], key=lambda one: one.share)
    note = f"in your file {worst.value:.2g} {worst.unit} ({worst.name}) off its path {how}"
    bounds = [None if has_contacts(plan) else one.bound for one in errors[how]]
    return [
        Measurement(PATH_IN_FILE, worst.share, "", None, note),
        Measurement(PATH_WITH_GAINS, shares["with gains"], "", None, "the largest error at any step"),
        *(
            Measurement(f"largest_{one.word}_error", one.value, one.unit, bound,
                        f"of {one.name} from the plan, at any step, {how}")
            for one, bound in zip(errors[how], bounds, strict=True)
        ),
        Measurement(EQUALITY_RATE, rate, "rad/s", None, "largest natural frequency of equalities, 0 without any"),
    ]  # fmt: skip


def _spring_rate(model: Any) -> float:
    """The largest natural frequency of the model's equalities, rad/s: (time constant, ratio) or (-stiffness, ..)."""
    first, ratio = model.eq_solref[model.eq_active0.astype(bool)].T
    rates = np.where(first > 0.0, 1.0 / np.maximum(first * ratio, np.finfo(float).tiny), np.sqrt(np.abs(first)))
    return float(np.max(rates, initial=0.0))


def _objects(run: Replay, problem: Problem) -> list[Measurement]:
    """Displacement in the file of objects that the plan models as stationary."""
    mechanism = capabilities_of(problem.dynamics).mechanism
    if mechanism is None or not np.any(lies := stationary_object_dofs(mechanism)):
        return []
    places = mechanism.q_address[lies & (mechanism.kind == SCREW)]
    most = float(np.abs(run.xs[:, places] - run.xs[0, places]).max())
    return [Measurement("objects_moved", most, "m", None, "at most, by themselves: the plan keeps them at the start")]


def _forces(run: Replay, overlaps: list[str]) -> list[Measurement]:
    """Forces in the file that the plan does not model."""
    model = run.compiled.model
    loss, largest = model.dof_frictionloss, float(np.nanmax(run.contact_force, initial=0.0))
    return [
        Measurement("overlaps_at_the_start", float(len(overlaps)), "", None, _together(overlaps)),
        Measurement("largest_contact_force", largest, "N", None, "sum of the normal forces of all contacts"),
        Measurement("friction_loss", float(loss.max(initial=0.0)), "N m, N", None,
                 f"largest, of {np.count_nonzero(loss)} of {len(loss)} degrees of freedom"),
    ]  # fmt: skip


def _open_loop(run: Replay, failures: Sequence[Measurement]) -> list[Measurement]:
    """How much fails in the file without gains, and the errors of that replay's end."""
    note = "; ".join(map(str, failures)) or "without gains"
    ends = [
        Measurement(f"open_loop_end_{one.word}_error", one.value, one.unit, None, f"of {one.name} from the plan's end")
        for one in worst_by_unit(run.plan, run.error[-1:])
    ]
    return [Measurement(OPEN_LOOP_MISSES, float(len(failures)), "", None, note), *ends]
