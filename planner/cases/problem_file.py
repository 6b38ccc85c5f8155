"""problem.toml: a machine of one's own (an MJCF file), a start, a goal and weights, as a Problem.

    model = "crane.xml"                 # relative to this file
    start = "start"                     # a keyframe, numbers, or a table of joints
    goal = { trolley = 2.0 }            # joints that a table does not name end where they started
    duration = 4.0                      # s
    dt = 0.02                           # s

    contacts = "ground"               # optional: a law for feet (see model.contact.laws); settle = true puts them down

    [weights]                           # numbers, or tables by joint (effort: by actuator)
    effort = 0.01
    final_position = { trolley = 1000.0, swing = 1000.0 }

    [limits]                            # optional; see planner.problem.limits
    control = "model"                   # or a number, or a table by actuator
    velocity = { trolley = 1.5 }        # and position: "model", or { joint = [lower, upper] }
    final = "exact"                     # meet the goal exactly where final weights are above 0

A plan keeps the table with its defaults filled in and the model's text, so it is rebuilt without either file.

In place of a machine of one's own the file may name a case of the package, with its parameters:

    case = "human-step"
    mass = 100.0
    cadence = 80.0
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Collection
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from planner import cases
from planner.base.arguments import array, choice, count, number, shown
from planner.base.errors import FileError, ModelError, PlannerError
from planner.base.files import read_text
from planner.base.measured import Measured, Section
from planner.cases.problem_keys import DEFAULT_WEIGHTS, DEFAULTS, GROUND, KEYS, LAW, LIMITS, REQUIRED, WEIGHTS
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.statics import settled
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import BALL, Mechanism
from planner.model.mjcf.driven import driven_dofs
from planner.model.mjcf.read import read
from planner.model.mjcf.refuse import KINDS
from planner.model.twin import Twin
from planner.problem.costs.tracking import TrackingCost, states
from planner.problem.criteria import with_objective
from planner.problem.default_appearance import default_appearance
from planner.problem.guess import holding_controls
from planner.problem.limits import Limits
from planner.problem.objective import checked_durations, weights_of
from planner.problem.problem import Problem, Requirements
from planner.problem.recipe import Recipe
from planner.solvers.multistart import MOST_STARTS

if TYPE_CHECKING:
    from planner.proof.replaying import Replay

NAME = "problem-file"

MOST_STAGES = 100_000


class ProblemFile(NamedTuple):
    """What a problem.toml says."""

    problem: Problem
    starts: int
    seed: int

    @property
    def objective(self) -> dict[str, float] | None:
        """Weights by names of OBJECTIVES, for solve_for; None for the problem as it is."""
        return self.problem.parameters.get("objective")

    @property
    def durations(self) -> list[float] | None:
        """The shortest and the longest, s, for an objective with time."""
        return self.problem.parameters.get("durations")


def load(
    path: str | Path, *, starts: int | None = None, seed: int | None = None, objective: Any = None,
    durations: list[float] | None = None,
) -> ProblemFile:  # fmt: skip
    """The problem in a file.

    Args:
        path: The problem.toml.
        starts: In place of the file's.
        seed: In place of the file's.
        objective: In place of the file's.
        durations: In place of the file's.

    Raises:
        PlannerError: The file cannot be read, a key is unknown, missing or wrong, or the model cannot be used.
    """
    path = Path(path)
    table = _checked(_read(path), str(path))
    instead = {"starts": starts, "seed": seed, "objective": objective, "durations": durations}
    table |= {name: value for name, value in instead.items() if value is not None}
    if not isinstance(table["model"], str) or not table["model"]:
        raise PlannerError(f"model is {shown(table['model'])}, expected the name of an MJCF file.")
    mechanism = _mechanism(path.parent / table["model"], table, None)
    problem = _problem(table, mechanism, str(path))
    given = problem.parameters
    return ProblemFile(problem, given["starts"], given["seed"])


def case_in(path: str | Path) -> tuple[str, dict[str, Any], int, int] | None:
    """The case that a file names, its parameters, starts and seed; None for a machine of the file's own.

    Raises:
        PlannerError: The file cannot be read, or it names a model besides.
    """
    table = _read(Path(path))
    if "case" not in table:
        return None
    if "model" in table:
        raise PlannerError(f"{path} has both a case and a model, expected one of the two.")
    given = {name: value for name, value in table.items() if name not in ("case", "starts", "seed")}
    starts = count("starts", table.get("starts", 1), most=MOST_STARTS)
    return choice("case", table["case"], cases.CASES), given, starts, count("seed", table.get("seed", 0), least=0)


def of_table(table: dict[str, Any], twin: Twin | None) -> Problem:
    """The problem of a stored plan, from its table and the model beside it.

    Raises:
        PlannerError: The table or the model is missing or wrong.
    """
    if twin is None:
        raise PlannerError("its model is missing.")
    table = _checked(table, "the plan")
    return _problem(table, _mechanism(twin.planned, table, twin.assets), "the plan")


def load_problem(path: str | Path) -> Problem:
    """The problem of a problem.toml: of a machine of one's own, or of a case that the file names.

    Raises:
        PlannerError: The file cannot be read, a key is unknown, missing or wrong, or the model cannot be used.
    """
    named = case_in(path)
    return load(path).problem if named is None else cases.build(named[0], **named[1])


def _again(mechanism: Mechanism, **table: Any) -> Problem:
    return _problem(_checked(table, "the problem file"), mechanism, "the problem file")


def _read(path: Path) -> dict[str, Any]:
    text = read_text(path, "the problem file")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"{path} is not TOML: {str(error).removesuffix('.')}.") from None
    except ValueError:  # Python reads no integers of more than 4300 digits
        raise FileError(f"{path} has a number of thousands of digits, expected numbers that fit 64 bits.") from None
    except RecursionError:
        raise FileError(f"{path} is nested too deeply, expected a table of numbers and names.") from None


def _checked(table: dict[str, Any], where: str) -> dict[str, Any]:
    """The table with its defaults, when all of its keys exist."""
    _known(table, KEYS, where)
    weights = table.get("weights", {})
    if not isinstance(weights, dict):
        raise PlannerError(
            f"weights is {shown(weights)}, expected a table [weights] with some of: {', '.join(WEIGHTS)}."
        )
    _known(weights, WEIGHTS, f"[weights] of {where}")
    limits = table.get("limits", {})
    if not isinstance(limits, dict):
        raise PlannerError(f"limits is {shown(limits)}, expected a table [limits] with some of: {', '.join(LIMITS)}.")
    _known(limits, LIMITS, f"[limits] of {where}")
    if "model" not in table:
        raise PlannerError(f"{where} has no key 'model', expected the name of an MJCF file.")
    return {**DEFAULTS, **table, "weights": {**DEFAULT_WEIGHTS, **weights}}


def _known(table: dict[str, Any], keys: Collection[str], where: str) -> None:
    for key in table:
        if key not in keys:
            near = difflib.get_close_matches(key, list(keys), n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise PlannerError(f"{where} has the key {key!r}, expected some of: {', '.join(keys)}.{hint}")


def _mechanism(model: str | Path, table: dict[str, Any], assets: dict[str, bytes] | None) -> Mechanism:
    ignore = table["ignore"]
    if not isinstance(ignore, list) or not all(isinstance(kind, str) for kind in ignore):
        raise PlannerError(f"ignore is {shown(ignore)}, expected a list of some of: {', '.join(KINDS)}.")
    contacts = table["contacts"]
    if not isinstance(contacts, dict):
        choice("contacts", contacts, ("on", "off", "ground"))
    if contacts not in ("on", "off"):
        # a stored model has the law already
        contacts = "on" if assets is not None else _touch(contacts, read(model, ignore=tuple(ignore), contacts="off"))
    mechanism = read(model, ignore=tuple(ignore), contacts=contacts, assets=assets)
    if mechanism.nu == 0 and not table.get("prescribed"):
        name = "the model" if assets is not None else f"the model {model}"
        raise ModelError(f"{name} has no actuators, expected at least one, or prescribed joints: nothing is planned.")
    return mechanism


def _touch(law: str | dict[str, Any], mechanism: Mechanism) -> ContactLaw:
    """The law of contacts = "ground", of a table of GROUND for the machine's mass, or of a table of LAW."""
    law = {} if isinstance(law, str) else law
    if "stiffness" in law:
        _known(law, LAW, "a contacts table with stiffness")
        return ContactLaw(**law)
    _known(law, GROUND, "a contacts table without stiffness")
    gravity = float(np.linalg.norm(mechanism.gravity))
    return ContactLaw.resting(float(mechanism.mass.sum()), gravity=gravity, **law)


def _problem(table: dict[str, Any], mechanism: Mechanism, where: str) -> Problem:
    for key in REQUIRED:
        if key not in table:
            wanted = "a number of seconds" if key == "duration" else _states_of(mechanism)
            raise PlannerError(f"{where} has no key {key!r}, expected {wanted}.")
    x0 = _state("start", table["start"], mechanism, mechanism.home)
    at_rest = x0.copy()
    at_rest[mechanism.nq :] = 0.0
    goal = _state("goal", table["goal"], mechanism, at_rest)
    if not isinstance(table["settle"], bool):
        raise PlannerError(f"settle is {shown(table['settle'])}, expected true or false.")
    if table["settle"]:
        x0, goal = (_on_ground(name, x, mechanism) for name, x in (("start", x0), ("goal", goal)))
    dt, N = _stages(table["duration"], table["dt"])
    table = table | {
        "duration": float(table["duration"]), "dt": dt, "starts": count("starts", table["starts"], most=MOST_STARTS),
        "seed": count("seed", table["seed"], least=0),
        "tolerance": number("tolerance", table["tolerance"], above=0.0),
        "guess": choice("guess", table["guess"], ("hold", "zero")),
    }  # fmt: skip
    if not isinstance(table["title"], str):
        raise PlannerError(f"title is {shown(table['title'])}, expected a text.")
    limits = Limits.from_dict(table["limits"]) if table.get("limits") else None
    if limits is not None:
        table["limits"] = limits.to_dict()
    if "objective" in table:
        table["objective"] = weights_of(table["objective"])
    if "durations" in table:
        table["durations"] = list(checked_durations(table["durations"], table.get("objective", {})) or ())
    prescribed = _prescribed(table, mechanism)
    dynamics = RigidBodyDynamics(mechanism, dt, table["integrator"], prescribed)
    cost = TrackingCost.joints(dynamics, goal, N, **table["weights"])
    _check_departure(x0, cost, table["tolerance"])
    appearance = default_appearance(mechanism, prescribed)
    problem = Problem(
        dynamics, cost, x0, recipe=Recipe(NAME, table, partial(_again, mechanism)),
        us=np.tile(_holding(dynamics, x0), (N, 1)) if table["guess"] == "hold" else None,
        appearance=replace(appearance, title=table["title"] or appearance.title),
        limits=limits,
        requirements=Requirements(goal=lambda replay: judge_arrival(replay, cost, table["tolerance"])),
    )  # fmt: skip
    return with_objective(problem, table["objective"]) if "objective" in table else problem


def _prescribed(table: dict[str, Any], mechanism: Mechanism) -> tuple[str, ...]:
    names = table.get("prescribed", [])
    known = [name for name in mechanism.joint_names if name]
    if not isinstance(names, list):
        raise PlannerError(f"prescribed is {shown(names)}, expected a list of some of: {', '.join(known)}.")
    return tuple(choice("a joint in prescribed", name, known) for name in names)


def _holding(dynamics: RigidBodyDynamics, x0: np.ndarray) -> np.ndarray:
    """Controls (nu,) that hold the start as far as they can; prescribed joints are held by an acceleration of zero."""
    mechanism, driven = dynamics.mechanism, driven_dofs(dynamics)
    moment = mechanism.actuators.moment.copy()
    moment[:, driven] = 0.0  # actuators do nothing there
    free = replace(mechanism, actuators=replace(mechanism.actuators, moment=moment))
    return np.concatenate([holding_controls(free, x0), np.zeros(len(driven))])


def _on_ground(name: str, x: np.ndarray, mechanism: Mechanism) -> np.ndarray:
    try:
        return settled(mechanism, x)
    except PlannerError as error:
        raise PlannerError(f"settle of {name}: {error}") from None


def _stages(duration: Any, dt: Any) -> tuple[float, int]:
    duration, dt = number("duration", duration, above=0.0), number("dt", dt, above=0.0)
    if not duration / dt < MOST_STAGES + 0.5:
        raise PlannerError(f"duration / dt is {duration / dt:.4g}, expected at most {MOST_STAGES} stages.")
    N = round(duration / dt)
    if N < 1 or abs(N * dt - duration) > 1e-9 * duration:
        near = max(N, 1) * dt
        raise PlannerError(f"duration is {duration:g} s, expected a whole number of stages of {dt:g} s, e.g. {near:g}.")
    return dt, N


def _states_of(mechanism: Mechanism) -> str:
    """What a start or a goal may be, in words."""
    nq, nv = mechanism.nq, mechanism.nv
    keyframes = f"a keyframe ({', '.join(mechanism.keyframes)}), " if mechanism.keyframes else ""
    joints = ", ".join(name for name in mechanism.joint_names if name) or "but no joint has a name"
    return f"{keyframes}{nq} or {nq + nv} numbers (positions, velocities), or a table of joints ({joints})"


def _state(name: str, value: Any, mechanism: Mechanism, base: np.ndarray) -> np.ndarray:
    """The state (nx,) of a keyframe, of positions, of positions and velocities, or of `base` with joints changed."""
    nq, nv = mechanism.nq, mechanism.nv
    x = base.copy()
    if isinstance(value, str):
        if value not in mechanism.keyframes:
            near = difflib.get_close_matches(value, list(mechanism.keyframes), n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise PlannerError(f"{name} is {shown(value)}, expected {_states_of(mechanism)}.{hint}")
        x = mechanism.keyframe(value)
    elif isinstance(value, list) and not any(isinstance(part, (list, dict)) for part in value):
        if len(value) not in (nq, nq + nv, len(x)):
            raise PlannerError(f"{name} has {len(value)} numbers, expected {_states_of(mechanism)}.")
        x[nq:] = 0.0
        x[: len(value)] = array(name, value, ("n",))
    elif isinstance(value, dict):
        for joint, position in value.items():
            links = mechanism.joint(choice(f"a joint in {name}", joint, [n for n in mechanism.joint_names if n]))
            place = int(mechanism.q_address[links.start])
            size = 7 if links.stop - links.start == 6 else 4 if mechanism.kind[links.start] == BALL else 1
            label = f"{name} of {joint}"
            x[place : place + size] = array(label, position, (size,)) if size > 1 else number(label, position)
    else:
        raise PlannerError(f"{name} is {shown(value)}, expected {_states_of(mechanism)}.")
    return states(name, x, mechanism.space, ())


def _judged(cost: TrackingCost) -> np.ndarray:
    """(ndx,) what the final weights act on."""
    return np.abs(cost.Q[-1]).max(axis=0) > 0.0


def _check_departure(x0: np.ndarray, cost: TrackingCost, tolerance: float) -> None:
    """That a plan which does nothing would miss the goal. Where start and goal are the same, to stay is the task."""
    way, judged = np.abs(cost.space.difference(x0, cost.x_ref[-1])), _judged(cost)
    if not np.any(way) or not np.any(judged):
        return
    largest = way[judged].max()
    if 0.0 < largest <= tolerance:
        raise PlannerError(
            f"the start is already within tolerance {tolerance:g} of the goal (largest difference {largest:.3g} where "
            f"final weights are above 0), expected a smaller tolerance: a plan that does nothing would pass."
        )
    if largest == 0.0 and not np.any(np.abs(cost.Q).max(axis=(0, 1))[way > 0.0]):
        raise PlannerError("no weight is above 0 where start and goal differ, expected one: nothing would move.")


def judge_arrival(replay: Replay, cost: TrackingCost, tolerance: float) -> Section:
    """Whether the plan, and MuJoCo with it, end at the goal, in what the final weights act on."""
    judged = _judged(cost)
    if not np.any(judged):
        return Section("goal", not_applicable="nothing is asked of the goal because no final weight is above 0")
    note = "largest component with a final weight: rad, m, rad/s, m/s; weights that are small beside the effort miss"
    ends = {"planned_goal_error": replay.plan.xs[-1], "replayed_goal_error": replay.xs[-1]}
    measured = tuple(
        Measured(name, float(np.abs(cost.space.difference(x, cost.x_ref[-1]))[judged].max()), "", tolerance, note)
        for name, x in ends.items()
    )
    return Section("goal", measured)
