"""problem.toml: a machine of one's own (an MJCF or URDF file), a start, a goal and weights, as a Problem.

    model = "crane.xml"                 # or a URDF, relative to this file
    start = "start"                     # a keyframe, numbers, or a table of joints
    goal = { trolley = 2.0 }            # joints that a table does not name end where they started
    duration = 4.0                      # s
    dt = 0.02                           # s

    contacts = "file"                 # optional: chosen by itself (see planner.model.mjcf.contact_mode), as is settle

    [weights]                           # numbers, or tables by joint (effort: by actuator)
    effort = 0.01
    final_position = { trolley = 1000.0, swing = 1000.0 }

    [limits]                            # optional: the model's own hold unless they are "off"; see problem.limits
    control = "off"                     # or a number, or a table by actuator; "model" by default
    velocity = { trolley = 1.5 }        # and position: "model", "off", or { joint = [lower, upper] }
    margin = 0.02                       # rad or m, how far plans stay off the ends of the model's ranges
    final = "exact"                     # meet the goal exactly where final weights are above 0

    [[constraint]]                      # optional: what the plan keeps, see problem_file.constraints
    frame = "hook"
    along = "z"
    lower = 0.5                         # m

    [avoid]                             # optional: what is kept apart, see planner.problem.constraints.clearance
    self = true                         # the machine from itself
    world = true                        # and from what is at rest
    clearance = 0.02                    # m

In place of one goal of the joints there may be goals of frames, at times, and paths (docs/tasks.md):

    [[goal]]
    frame = "hook"                      # a site or body
    position = [2.0, 0.0, 0.8]

In place of the model the file may name a case of the package, with its parameters: case = "human-step", mass = 100.0.
A plan keeps the table with its defaults filled in and the model's text, so it is rebuilt without either file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from planner import cases
from planner.base.arguments import choice, number, short_repr
from planner.base.data_files import check_file, check_values, problem_files, read_table
from planner.base.errors import PlannerError
from planner.cases.problem_file.constraints import constraints_of
from planner.cases.problem_file.feasibility_checks import (
    check_goal,
    check_goal_controllable,
    deep_in_each_other,
)
from planner.cases.problem_file.keys import (
    DEFAULTS,
    KEYS,
    RESOLVED,
    TABLES,
    VALUES,
    checked_values,
    tables_of_joints,
    with_defaults,
    with_model_limits,
)
from planner.cases.problem_file.machine import folders_of, lands, machine_of, prescribed_of, with_step
from planner.cases.problem_file.reference_guess import ReferenceTrajectory, first_guess
from planner.cases.problem_file.solving import (
    GAIN_OF_CYCLE,
    ProblemFile,
    cycle_cost,
    cycle_in,
    ends_in,
    motion_in,
    periodic_of,
    without_cycles,
)
from planner.cases.problem_file.states import (
    place_on_ground,
    placed,
    stance_ramp,
    state_of,
    states_of,
    with_ramp,
)
from planner.cases.problem_file.tasks import (
    check_task_departure,
    cost_of,
    guess_of,
    is_task,
    path_lengths,
    resolve_task,
    steps_of,
    with_files,
    with_jumps,
    with_recorded_duration,
    with_resolved,
    with_tasks,
)
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.statics import stands_somewhere
from planner.model.mechanism import Mechanism
from planner.model.mjcf.attached import attachments, stored_records
from planner.model.mjcf.obstacles import obstacles_of
from planner.model.robot_collections import model_location
from planner.model.twin import Twin
from planner.problem.constraints.clearance import Avoid
from planner.problem.constraints.constraint import Constraint
from planner.problem.default_appearance import default_appearance, with_marks
from planner.problem.description import angles_in_degrees, ranges_in_degrees
from planner.problem.example_task import conflict_as_drawn, start_of_model
from planner.problem.limits import Limits
from planner.problem.objective import with_objective
from planner.problem.problem import Problem
from planner.problem.problem_parts import MAX_STAGES, PROBLEM_FILE, Recipe, durations_or_default
from planner.problem.reaching_cost import along_gait, straight_reference, weighed
from planner.problem.tasks.cycle import Cycle
from planner.problem.tasks.legs import free_times
from planner.solvers.periodic_boundary import PARAMETER

NAME = PROBLEM_FILE
GAIN = 1e-4  # of the cost, by an iteration at kinks of contact, where more are worth nothing
# What is done by itself and told at once.
TOLD = ("model", "start", "contacts", "goal", "angles", "closed", "settle", "stops", "gait", "avoid", "dt", "substeps")
# Of the cost, which is about 1: what an iteration gains below it shows in no picture of the motion. Of closed chains it
# counts what is gained, not only what is promised: towards the end less than a hundredth of the promise comes, perhaps
# because Gauss-Newton leaves out how the forces of chains turn.
DECREASE = 1e-7


def load(path: str | Path, **instead: Any) -> ProblemFile:
    """The problem in a file, with `starts`, `seed`, `objective` and `durations` in place of the file's unless None.

    Raises:
        PlannerError: The file cannot be read, a key is unknown, missing or wrong, or the model cannot be used.
    """
    return loaded(read_table(Path(path)), path, **instead)


def loaded(table: dict[str, Any], path: str | Path, **instead: Any) -> ProblemFile:
    """The problem of a file's table, as load(); the path is for messages, and files are relative to it.

    Raises:
        PlannerError: A key is unknown, missing or wrong, or the model cannot be used.
    """
    path, stated = Path(path), {name: value for name, value in instead.items() if value is not None}
    table = with_recorded_duration(table | stated, path.parent)
    check_file(table, KEYS, TABLES, VALUES, str(path))
    table, cycles = without_cycles(table)
    table = with_defaults(with_model_limits(table), str(path))
    duration = number("duration", table["duration"], greater_than=0.0)
    phases, free = free_times(table.get("phase"), duration)
    objective = table.get("objective", ())
    if free and isinstance(objective, (str, dict)) and "time" in objective:
        raise PlannerError("the objective has time, and times of phases are free: expected one of them.")
    table = table | {"phase": phases} if free else table
    if not isinstance(table["model"], str) or not table["model"]:
        raise PlannerError(f"model is {short_repr(table['model'])}, expected the name of an MJCF or URDF file.")
    for key, records, file in (("attach", attachments, "model"), ("obstacle", obstacles_of, "file")):
        if key in table:
            table[key] = stored_records(records(table[key]), file, path.parent)
    folders = {"package_path": folders_of(path.parent, table["package_path"])} if "package_path" in table else {}
    location = model_location(table["model"], path.parent)

    def built(table: dict[str, Any]) -> Problem:
        mechanism = machine_of(location, table | folders, None)
        return _problem(with_files(table, path.parent, mechanism), mechanism, str(path))

    problem = built(table)
    if table["contacts"] == "auto" and "avoid" not in table and lands(problem):
        problem = built(table | {"contacts": "file"})
    if cycles * problem.N > MAX_STAGES:
        raise PlannerError(
            f"periodic has {cycles} cycles of {problem.N} stages, expected at most {MAX_STAGES} stages together."
        )
    given, reasons = problem.parameters, problem.parameters[RESOLVED]["reasons"]
    notes = (*(reasons[key] for key in TOLD if key in reasons), *deep_in_each_other(problem))
    return ProblemFile(
        problem, given["starts"], given["seed"], given.get("objective"), given.get("durations"), notes,
        given.get("work"), cycles, free,
    )  # fmt: skip


def case_in(path: str | Path) -> tuple[str, dict[str, Any], int, int] | None:
    """The case that a file names, its parameters, starts and seed; None for a machine of the file's own.

    Raises:
        PlannerError: The file cannot be read, or it names a model besides.
    """
    table = read_table(Path(path))
    if "case" not in table:
        return None
    if "model" in table:
        raise PlannerError(f"{path} has both a case and a model, expected one of the two.")
    given = {name: value for name, value in table.items() if name not in ("case", "starts", "seed")}
    own = check_values({name: table.get(name, DEFAULTS[name]) for name in ("starts", "seed")}, VALUES)
    return choice("case", table["case"], cases.CASES), given, own["starts"], own["seed"]


def of_table(table: dict[str, Any], twin: Twin | None, found: Mapping[str, np.ndarray] | None = None) -> Problem:
    """The problem of a stored plan, from its table, the model beside it and what was `found`: first guess and poses.

    Raises:
        PlannerError: The table or the model is missing or wrong.
    """
    if twin is None:
        raise PlannerError("its model is missing.")
    table = with_defaults({"substeps": 1} | table, "the plan", stored=True)  # older plans know of no substeps
    mechanism = replace(machine_of(twin.planned, table, twin.assets), original=twin.original)
    return _problem(table, mechanism, "the plan", found=found)


def load_problem(path: str | Path) -> Problem:
    """The problem of a problem.toml: of a machine of one's own, or of a case that the file names.

    Its starts and seed, the times of phases that it leaves free and the number of its cycles are for `planner run`, and
    for load(path).solved(); give the first two to solve or solve_for yourself. The name of a problem file of the
    package, e.g. "quadrotor", stands for it.

    Raises:
        PlannerError: The file cannot be read, a key is unknown, missing or wrong, or the model cannot be used.
    """
    path = problem_files().get(str(path), path)
    named = case_in(path)
    return load(path).problem if named is None else cases.build(named[0], **named[1])


def again(mechanism: Mechanism, *constraints: Constraint, **table: Any) -> Problem:
    """The problem of a table and a machine that was read already, and constraints beside those of the table.

    None stands for a key that the table does not have.

    Raises:
        PlannerError: A key is unknown, missing or wrong.
    """
    table = {name: value for name, value in table.items() if value is not None}
    table = with_defaults(table, "the problem file", stored=True)
    return _problem(table, mechanism, "the problem file", constraints)


def _problem(
    table: dict[str, Any], mechanism: Mechanism, where: str, constraints: tuple[Constraint, ...] = (),
    found: Mapping[str, np.ndarray] | None = None,
) -> Problem:  # fmt: skip
    """The problem of a table; what is refused says how the model was read: a joint, or its range, may be missed."""
    try:
        return _built(table, mechanism, where, constraints, found)
    except PlannerError as error:
        left_out = _left_out(mechanism)
        read = [f"The model is read without {' and '.join(left_out)}."] if left_out else []
        hinges = mechanism.joint_range[np.any(mechanism.S[:, :3], axis=1)]
        read += [f"Mind that {one.problem}: {one.fix}." for one in ranges_in_degrees(hinges)]
        if not read:
            raise
        raise type(error)(" ".join([str(error), *read])) from None


def _left_out(mechanism: Mechanism) -> list[str]:
    """What the model is read without, but for contacts, of which a line of their own tells."""
    return [phrase for phrase in mechanism.ignored if phrase != "contacts"]


def _built(
    table: dict[str, Any], mechanism: Mechanism, where: str, constraints: tuple[Constraint, ...],
    found: Mapping[str, np.ndarray] | None,
) -> Problem:  # fmt: skip
    told, rebuilt = "", RESOLVED in table
    if table.get("prescribed"):
        mechanism = mechanism.without_lead_stops()
    if "start" not in table and (own := start_of_model(mechanism)) is not None:
        table = table | {"start": own}
        told = f"start is {f'the keyframe {own!r}' if own else 'the pose in which the file draws it'}: none is given."
    if "periodic" in table:
        table = {"goal": {}} | table
    for key in ("start", *(() if "follow" in table else ("goal",))):
        if key not in table:
            wanted = states_of(mechanism, as_drawn=key != "start")
            if key == "start":
                wanted += f": as drawn, {conflict_as_drawn(mechanism)}; `planner model FILE --write` has a start"
            more = ", or tables [[goal]] or [follow] for its frames" if key == "goal" else ""
            raise PlannerError(f"{where} has no key {key!r}, expected {wanted}{more}.")
    tasked = is_task(table, mechanism)
    cycle = cycle_in(table, tasked)
    if "goal" in table["weights"] and not tasked:
        raise PlannerError("weights.goal is for [[goal]] and [follow], expected final_position and final_velocity.")
    table = with_tasks(table, mechanism) if tasked else table
    closed: list[str] = []
    x0 = state_of("start", table["start"], mechanism, mechanism.home, closed)
    at_rest = x0.copy()
    at_rest[mechanism.nq :] = 0.0
    goal = at_rest if tasked else state_of("goal", table["goal"], mechanism, at_rest, closed)
    if table["contacts"] == "auto" and mechanism.contacts_mode:
        table = table | {"contacts": mechanism.contacts_mode}  # a stored model has but one mode left
    x0, goal, notes, stops = placed(mechanism, table, x0, goal)
    build = partial(again, mechanism, *constraints)
    gait = steps_of(table, mechanism)
    ramp = None if tasked or gait else stance_ramp(mechanism, table, x0, goal)
    if ramp is not None:
        mechanism = with_ramp(mechanism, ramp)
        x0, goal, _ = place_on_ground(mechanism, table, x0, goal)  # it stands elsewhere by a part of the ramp
    prescribed = prescribed_of(table, mechanism)
    leaps = gait is not None and gait.always_stands and cycle is None  # the errors of a cycle come round again
    table, substeps, reasons = with_step(table, mechanism, prescribed, (x0, goal), leaps)
    table, N = checked_values(table)
    dynamics = RigidBodyDynamics(mechanism, table["dt"], table["integrator"], prescribed, substeps)
    if told:
        reasons["start"] = told
    if turns := angles_in_degrees(mechanism, tables_of_joints(table)):
        reasons["angles"] = turns
    if mechanism.contacts_choice:
        reasons["contacts"] = f"{mechanism.contacts_choice}."
    if tasked or cycle is not None:
        notes.pop("goal", None)  # it has none of the whole machine
    elif table["goal"] == {} and cycle is None:
        reasons["goal"] = "goal names no joint, so that the machine is to end where it starts."
    if left_out := _left_out(mechanism):
        reasons["model"] = f"The model is read without {', '.join(left_out)}."
    said = {"closed": closed, "settle": notes.values(), "stops": stops}
    reasons |= {key: " ".join(each) for key, each in said.items() if each}
    limits = Limits.from_dict(table["limits"]) if table.get("limits") else None
    avoid = Avoid(**table["avoid"]) if "avoid" in table else None
    asked = constraints_of(table.get("constraint", []))
    if tasked and limits is not None:
        limits.check_start(dynamics, x0)
    way, us, poses = None, *((found or {}).get(name) for name in ("us", "poses"))
    if tasked:
        way = resolve_task(table, dynamics, x0, N, limits, avoid, (*asked, *constraints), poses)
    apart = way.apart if way is not None else None if avoid is None else avoid.constraint(mechanism, x0, goal)
    if apart is not None:
        told, *details = apart.notes
        reasons["avoid"] = f"{told.removesuffix('.')}; the report names them." if details else told
        if details:
            reasons["avoid, details"] = " ".join(details)
    if way is not None and way.waypoints:
        table = table | {"goal": [one.goal.to_dict() for one in way.task.goals]}
        passed = ", ".join(f"{way.task.goals[k].time:.3g}" for k in way.waypoints)
        reasons["goal"] = f"Via points without times are passed at {passed} s, in proportion to the way of the joints."
    along = guess_of(way, dynamics, x0) if way is not None and us is None else None
    cyclic, paths, stances = None, None, () if way is None else way.stances
    if cycle is not None:
        cyclic = motion_in(table, cycle, dynamics, x0, N, limits)
        along, stances = ReferenceTrajectory(None, cyclic.states, direct=True, walks=True), cyclic.stances
        reasons["gait"] = cyclic.said
        goal = cyclic.image.apply(dynamics.space, x0)
        paths = 0.5 * path_lengths(dynamics, cyclic.repeated(dynamics.space, 2).states)  # the same on either side
    elif way is None and gait is not None:
        ranges = (limits or Limits(position="off")).position_ranges(dynamics)
        straight = straight_reference(dynamics, x0, goal, N)
        rows, reasons["gait"], stances = gait.motion(mechanism, straight, dynamics.dt, ranges)
        along, paths = ReferenceTrajectory(None, rows, direct=True, walks=True), path_lengths(dynamics, rows)
    elif way is not None and way.gait:
        reasons["gait"] = way.gait
    table = with_resolved(table, dynamics, x0, goal, reasons, way, limits, paths, ramp)
    weights = table[RESOLVED]["weights"]
    wanted = None
    if cyclic is not None and cycle is not None:
        start, end = ends_in(table, cyclic.repeated(dynamics.space, cycle.cycles))
        table = table | {PARAMETER: [start.tolist(), end.tolist()]}
        along = along if cycle.cycles == 1 else None
        cost, x0 = cycle_cost(dynamics, x0, cyclic, cycle, end, weights), start
    elif way is None:
        straight = stands_somewhere(mechanism, np.stack([x0, goal])) and "position" not in table["weights"]
        walked = weights if along is None else along_gait(dynamics, along.states, weights)
        cost = weighed(dynamics, x0, goal, N, walked, straight=straight)
    else:
        cost, wanted = cost_of(way, dynamics, weights)
    kept = (*asked, *(() if apart is None else (apart.constraint,)), *constraints)
    appearance = with_marks(default_appearance(mechanism, prescribed), None if way is None else way.task, kept)
    problem = Problem(
        dynamics, cost, x0, recipe=Recipe(NAME, table, build, {} if way is None else {"poses": way.poses.table}),
        appearance=replace(appearance, title=table["title"] or appearance.title),
        limits=limits, constraints=kept, goal_specs=wanted if cyclic is None else (), stances=stances,
        tolerance=None if tasked else table["tolerance"] or {},  # by default those of all goals, as stated ones
        expected_reduction_tolerance=DECREASE,
        periodic=None if cyclic is None or cycle is None else periodic_of(dynamics, cyclic.image, cycle),
        actual_reduction_tolerance=_gain(mechanism, cycle),
    )  # fmt: skip
    jump = with_jumps(way, problem, table, limits) if way is not None and us is None else None
    problem = replace(problem, us=first_guess(problem, table["guess"], goal, along, jump) if us is None else us)
    if way is not None and wanted is not None:
        check_task_departure(x0, wanted, way.task)
        check_goal_controllable(problem, way.rows)
    elif cyclic is None:  # of a cycle the solver finds both ends
        between = durations_or_default(table.get("durations"), table.get("objective", {}), table["duration"])
        durations = () if rebuilt else (table["duration"], *(between or ()))  # a search goes below those that suffice
        check_goal(problem, goal, durations)
    return with_objective(problem, table["objective"]) if "objective" in table else problem


def _gain(mechanism: Mechanism, cycle: Cycle | None) -> float:
    """Of the cost, what an iteration is to gain."""
    if cycle is not None and cycle.cycles == 1:
        return GAIN_OF_CYCLE
    return GAIN if mechanism.contacts else DECREASE if mechanism.has_closed_chains else 0.0
