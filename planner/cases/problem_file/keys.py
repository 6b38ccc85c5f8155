"""The keys of a problem.toml, each with what it says and its default; a table with checked values and its defaults."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from planner.base.arguments import number, numbers, short_repr
from planner.base.data_files import check_keys, check_values
from planner.base.errors import PlannerError
from planner.cases.problem_file.reference_guess import GUESSES
from planner.dynamics.rigid_body import MAX_SUBSTEPS
from planner.kernels.integrators import KNOWN_INTEGRATORS
from planner.model.mjcf.contact_mode import MODES
from planner.problem.costs.terms import checked_tolerance, stored_tolerance
from planner.problem.joint_limits import OFF
from planner.problem.limits import Limits
from planner.problem.problem_parts import OBJECTIVES, checked_durations, stages_of, weights_of
from planner.problem.tasks.gait import TURNS
from planner.problem.tasks.timed_task import DEFAULT_TOLERANCES, PATH_TOLERANCES
from planner.solvers.options import MAX_STARTS
from planner.solvers.periodic_boundary import PARAMETER
from planner.solvers.waypoints import WAYPOINTS

_IMPLICIT = [name for name, one in KNOWN_INTEGRATORS.items() if one.implicit]
KEYS = {
    "model": "MJCF or URDF file, relative to this file, or robot_descriptions:NAME of that package",
    "base": "of a URDF: fixed or free, what its root link is; by default fixed, but for a floating joint of the file",
    "floor": "of a URDF: true to add the plane z = 0, on which a free base starts",
    "package_path": "of a URDF: folder of packages, or a list of some, where package:// is sought before the folders "
    "above the file; relative to this file",
    "inertia": "of a URDF: nearest to replace inertias that no body has by the nearest ones, given to refuse them, "
    "'from shapes' or { density = kg/m^3 } for links without <inertial>; from shapes has 1000 kg/m^3",
    "start": "keyframe, nq numbers (at rest), nq + nv numbers, or a table of joints (the others as the model says); "
    "by default the model's keyframe 'home', else its first one, else the pose in which it is drawn",
    "goal": "the same; joints that a table does not name end where they started. Or tables [[goal]], below",
    "follow": "table, below, or several [[follow]]: a path of a frame or of joints to keep to",
    "gait": f"{', '.join(TURNS)}, or a table of kind, stride (m, at most), duty (share of a cycle in which a foot "
    "stands), lift (m), or of feet (turns from 0 to 1 by bodies) in place of kind: which feet swing when",
    "phase": "tables [[phase]], below, in place of gait: which feet stand when",
    "periodic": "table of travel (m ahead along the ground, or [ahead, to the left], in the axes of the base), turn "
    "(rad), mirror (whether its two sides, in the plane along its way, have changed places), cycles (how many the plan "
    "has; 1), left_open (names of coordinates that need not return) and passes (solves, at most 20): a cycle of a gait "
    "that goes on, or half of one with mirror, in place of a goal; duration is that of one, start is how the machine "
    "stands, the solver finds where the cycle begins",
    "attach": "table, below, or several [[attach]]: a payload or tool at a frame of the model",
    "obstacle": "table, below, or several [[obstacle]]: a shape at rest beside the model; [avoid] keeps clear of it",
    "exclude": "list of pairs of bodies or shapes that do not touch each other, whatever the model says",
    "duration": "s",
    "dt": "length of a stage, s, or auto: 0.01, less where the machine is stiff, a whole part of the duration",
    "integrator": f"one of {', '.join(KNOWN_INTEGRATORS)}, or auto: rk4, leapfrog for gaits, or "
    f"{' or '.join(_IMPLICIT)} for fast damping",
    "substeps": "in a stage: 1 to 16, or auto: as many as the machine's fastest motion needs",
    "guess": "first controls: line (straight to the goal in joint space, by inverse dynamics), collision-free (a "
    "path that keeps its distance from what is avoided), tracking (feedback gains along that line), hold (the start "
    "against gravity), zero; "
    "auto is what multiple shooting finds along a gait, or jumps to goals in the air; collision-free where something "
    "is avoided, line where all joints have actuators, else the better of tracking and hold",
    "contacts": "model (the file's law, of springs and dampers), ground (a law for the mass of what stands), file "
    "(planes with the law that MuJoCo computes), avoid, off, or a table of their law, below; auto chooses",
    "settle": "true to put start and goal on the ground: what no actuator drives moves until it carries them; auto "
    "does so with contacts = 'ground' or 'file', unless they are in the air",
    "ignore": "list of what to take out of the model, e.g. frictionloss",
    "prescribed": "list of joints whose acceleration is a control instead of their force; none by default",
    "starts": "number of first guesses to try",
    "seed": "of the first guesses after the first",
    "work": "that planner run may take, about so many s of one core, counted; by default about a minute",
    "tolerance": "how far from the goal passes: a number in rad, m, rad/s, m/s, or a table by position, velocity and "
    "joint; 'soft' for no check; by default 2 % of the way",
    "title": "shown in pictures",
    "weights": "table, below",
    "objective": f"one of {', '.join(OBJECTIVES)}, or a table of weights by these names; by default the effort",
    "durations": "[shortest, longest] s, between which an objective with time chooses; by default a fifth and twice "
    "the duration",
    "constraint": "tables [[constraint]], below: what the plan keeps of a frame or an actuator",
    "limits": 'table, below; by default the model\'s own, "off" for none',
    "avoid": "table, below: what is kept apart; nothing by default",
}
AVOID = {
    "self": "whether shapes of the machine are kept from each other; true by default",
    "world": "whether they are kept from what is at rest; true by default",
    "clearance": "m between them; by default 0.01",
    "extra_clearance": "table of m beyond the clearance by the names of a pair, which `planner run` writes where "
    "shapes touched",
}
GOAL = {
    "frame": "a site or body, or",
    "joints": "a table of joints, a keyframe, or all positions; rad or m",
    "position": "[x, y, z] m of the frame in the world",
    "orientation": "quaternion, w first, or a table of roll, pitch, yaw in degrees about the world's x, y, z",
    "pointing": "[x, y, z] the direction to which the frame's z axis points, free to turn about it; or a table of axis "
    "(x, y, z or numbers) and to",
    "time": "s; by default the end",
    "share": "of the duration, 0 to 1, in place of a time",
    "through": "true to pass without stopping; before the goal of the end also without a time, which is then chosen",
    "tolerance": "how far from it passes, m and rad, or a table of position, orientation, pointing, velocity; by "
    f"default {1e3 * DEFAULT_TOLERANCES['position']:g} mm, {DEFAULT_TOLERANCES['orientation']:g} rad, "
    f"{DEFAULT_TOLERANCES['velocity']:g} m/s",
}
FOLLOW = {
    "frame": "a site or body, or",
    "joints": "list of the joints that points are of; a file has them in its heading",
    "points": "rows of t, x, y, z, or without t for equal parts of the duration",
    "file": "CSV of such rows, a ROS bag or a LeRobot data set's parquet, relative to this file",
    "part": "of a bag the topic, of a data set the episode; where there are several",
    "degrees": "true where the file has degrees",
    "tolerance": f"how far from the path passes, m or rad; by default {1e3 * PATH_TOLERANCES['m']:g} mm or "
    f"{PATH_TOLERANCES['rad']:g} rad",
}
ATTACH = {
    "frame": "a site or body that carries it",
    "mass": "kg",
    "size": "m: the radius of a ball, or the three edges of a box; by default that of a ball of aluminium",
    "com": "[x, y, z] m, its centre in the frame; by default the frame's origin",
    "inertia": "kg m^2 about its centre, along the frame's axes: three numbers, or six (xx, yy, zz, xy, xz, yz); by "
    "default that of the shape",
    "model": "in place of a mass an MJCF file, relative to this file, whose body is attached: a tool",
    "body": "which of its bodies; by default the first",
    "name": "of the new body, a frame for goals; by default payload",
}
OBSTACLE = {
    "shape": "box, sphere, capsule, cylinder, plane or mesh",
    "size": "m: the edges of a box, the radius of a sphere, radius and length of a capsule or cylinder",
    "position": "[x, y, z] m of its centre in the world; by default the origin",
    "orientation": "quaternion, w first, or a table of roll, pitch, yaw in degrees",
    "file": "of a mesh: STL, OBJ, DAE or GLB, relative to this file; its convex hull counts",
    "scale": "of a mesh: a number, or three",
    "name": "for messages; by default obstacle, or obstacle 1, obstacle 2",
}
PHASE = {
    "until": "s, when it ends, or [earliest, latest] for the time at which the plan costs least; the last one lasts to "
    "the end",
    "stand": "list of the bodies that stand on the ground; other feet swing, [] for a flight",
}
LIMITS = {
    "control": 'bounds of the controls: "model" (ctrlrange, forcerange, actuatorfrcrange), a number, "off", or a table '
    "by actuator",
    "position": 'ranges of hinge and slide joints: "model", "off", or a table of [lower, upper] by joint, rad or m',
    "velocity": '"model" (of a URDF), "off", a number for all joints, or a table by joint: a number or [lower, upper], '
    "rad/s or m/s",
    "margin": "how far plans stay off the ends of the model's ranges, rad or m: a number or a table by joint; by "
    "default 1 % of the range, at least 0.01 rad or 1 mm",
    "final": '"exact" for all that has a final weight, or a list of joints: to end at the goal exactly',
    "tolerance": "how far a state may be outside its range, or from an exact goal",
}
CONSTRAINT = {
    "frame": "a site or body, with one of the next four",
    "position": "[x, y, z] m in the world, exactly",
    "orientation": "quaternion, w first, exactly",
    "pointing": "direction of the world, x, y, z or three numbers, that the frame's axis stays within an angle of",
    "along": "direction of the world, likewise, along which the frame stays between lower and upper",
    "axis": "of the frame, for pointing: x, y, z or three numbers; z by default",
    "within": "rad, for pointing",
    "power": "an actuator, whose force times speed stays between lower and upper, in place of a frame",
    "chain": "an equality that closes a chain, whose force stays between lower and upper, likewise",
    "lower": "m, W or N",
    "upper": "m, W or N",
    "when": '"always", "end" or [from, to] in s; by default the end for position and orientation, else always',
    "tolerance": "how far beyond passes, in the same unit; by default 1e-4, and 1e-4 of a bound above 1",
    "name": "for messages",
}
WEIGHTS = {
    "effort": "on |u|^2 / 2, per second; by default 1 / limit^2",
    "final_position": "on the squared distance from the goal / 2 at the end; by default 4 / tolerance^2",
    "final_velocity": "on the squared velocity error / 2 at the end; by default 10 / tolerance^2",
    "position": "on the squared distance from the goal / 2 on the way, per second; by default 0",
    "velocity": "on the squared distance / 2 from the velocity of a smooth motion to the goal, per second; by default "
    "(duration / 2 way)^2",
    "hold": "s: what it costs to stay at the goal as long is added at the end; by default 1 for machines that stand on "
    "the ground, in place of final weights, else 0",
    "rest": "share of the duration, at the end, in which the machine is to be at its goal, before which positions have "
    "no weight; by default a quarter of the time to the last goal where feet have to move, else 0: all of it",
    "slip": "on the squared speed / 2 of feet along the ground, or less than 6 cm above it, per second; by default 400 "
    "where feet have to move, else 0",
    "goal": "on each goal of [[goal]], over the square of its tolerance; 4 by default, and 25 times as much per second "
    "on a path",
}
LAW = {
    "stiffness": "N/m",
    "damping": "N s/m",
    "ramp": "m of smoothing",
    "slip_damping": "N s/m, of friction before it slips",
    "friction": "mu",
    "friction_smoothing": "how gradually friction turns from viscous to Coulomb's, 0 to 1",
    "uncertainty": "how many times softer the ground may be, at least 1, for which gains allow; by default 1",
}
GROUND = {
    "penetration": "m, how deep the contact is when it stands on one contact",
    "friction": "mu",
    "damping_ratio": "of the machine bouncing on one contact",
    "uncertainty": "how many times softer the ground may be, at least 1, for which gains allow; by default 4",
    "slip": "m/s, at which viscous friction would be all there is",
    "ramp": "m of smoothing",
}
RESOLVED = "resolved"  # in the table of a plan, not of a file: what was chosen by itself, and why
RAMP = "ramp"  # in that table: of the ground under feet that stay, m
MODEL_LIMITS = {"control": "model", "position": "model", "velocity": "model"}
"""What holds unless it is switched off: a key of it is "off", or limits itself is."""
URDF = ("base", "floor", "package_path", "inertia")
TABLES = {
    "weights": WEIGHTS, "limits": LIMITS, "avoid": AVOID, "goal": GOAL, "follow": FOLLOW, "attach": ATTACH,
    "obstacle": OBSTACLE, "phase": PHASE, "constraint": CONSTRAINT,
}  # fmt: skip
_TABLE, _LIST = (Mapping,), (list, tuple, np.ndarray)
_AXIS: dict[str, Any] = {"choices": ("x", "y", "z"), "others": _LIST}
_LIMIT: dict[str, Any] = {
    "choices": ("model", "off"), "others": (*_TABLE, *_LIST, float), "greater_than": 0.0, "infinite": True,
}  # fmt: skip
VALUES: dict[str, dict[str, Any]] = {
    "dt": {"word": "auto", "greater_than": 0.0}, "substeps": {"word": "auto", "whole": True, "maximum": MAX_SUBSTEPS},
    "starts": {"whole": True, "maximum": MAX_STARTS}, "seed": {"whole": True, "minimum": 0},
    "work": {"greater_than": 0.0}, "guess": {"choices": GUESSES}, "contacts": {"choices": MODES, "others": _TABLE},
    "integrator": {"choices": ("auto", *KNOWN_INTEGRATORS)}, "gait": {"choices": tuple(TURNS), "others": _TABLE},
    "title": {"kind": "a text"}, "avoid": {"kind": "a table"}, "avoid.self": {"kind": "true or false"},
    "avoid.world": {"kind": "true or false"}, "avoid.clearance": {"greater_than": 0.0},
    "limits": {"choices": ("off",), "others": _TABLE},
    "limits.control": _LIMIT | {"example": "control = 5.0 or { elbow = 5.0 }, in the unit of the actuators"},
    "limits.position": {"choices": ("model", "off"), "others": _TABLE, "example": "position = { elbow = [-1.0, 1.0] }"},
    "limits.velocity": _LIMIT | {"example": "velocity = 2.0 or { elbow = 2.0 }, rad/s or m/s"},
    "limits.margin": {"others": _TABLE, "minimum": 0.0}, "limits.final": {"choices": ("exact",), "others": _LIST},
    "limits.tolerance": {"greater_than": 0.0}, "constraint.pointing": _AXIS, "constraint.along": _AXIS,
    "constraint.axis": _AXIS, "constraint.within": {"greater_than": 0.0}, "constraint.lower": {},
    "constraint.upper": {},
    "constraint.when": {"choices": ("always", "end"), "others": _LIST, "example": "when = [0.2, 0.5]"},
    "constraint.tolerance": {"greater_than": 0.0},
    **{f"constraint.{name}": {"kind": "a text"} for name in ("frame", "power", "chain", "name")},
}  # fmt: skip
"""Of keys whose value is a word, a number, a text or a table: which words, the number's bounds (see check_values)."""
DEFAULTS: dict[str, Any] = {
    "dt": "auto", "integrator": "auto", "substeps": "auto", "guess": "auto", "contacts": "auto",
    "settle": "auto", "ignore": [], "starts": 1, "seed": 0, "title": "",
}  # fmt: skip


def with_defaults(table: dict[str, Any], where: str, stored: bool = False) -> dict[str, Any]:
    """The table with its defaults; PlannerError where it has an unknown key or no model.

    A plan's own table, `stored`, holds beside the keys of a file what was chosen by itself.
    """
    check_keys(table, (*KEYS, RESOLVED, PARAMETER) if stored else KEYS, where)
    resolved = ("weights", "reasons", WAYPOINTS, RAMP)
    for name, keys in (("weights", WEIGHTS), ("limits", LIMITS), ("avoid", AVOID), (RESOLVED, resolved)):
        part = table.get(name, {})
        if not isinstance(part, dict):
            raise PlannerError(
                f"{name} is {short_repr(part)}, expected a table [{name}] with some of: {', '.join(keys)}."
            )
        check_keys(part, keys, f"[{name}] of {where}")
    if RESOLVED in table:
        _check_resolved(table[RESOLVED], where)
    if "model" not in table:
        raise PlannerError(f"{where} has no key 'model', expected the name of an MJCF or URDF file.")
    if "duration" not in table and isinstance(table.get("durations"), (list, tuple)) and table["durations"]:
        table = table | {"duration": table["durations"][-1]}  # a search begins where there is time enough
    if "duration" not in table:
        raise PlannerError(f"{where} has no key 'duration', expected a number of seconds, e.g. duration = 2.0.")
    return {**DEFAULTS, **table, "weights": dict(table.get("weights", {}))}


def _check_resolved(resolved: dict[str, Any], where: str) -> None:
    """Refuse what was chosen by itself unless it has tables of weights and of sentences."""
    for name in ("weights", "reasons"):
        part = resolved.get(name)
        if not isinstance(part, dict):
            raise PlannerError(f"{name} of [{RESOLVED}] is {short_repr(part)}, expected a table.")
    check_keys(resolved["weights"], (*WEIGHTS, "control"), f"[{RESOLVED}.weights] of {where}")
    if "effort" not in resolved["weights"]:
        raise PlannerError(f"[{RESOLVED}.weights] of {where} has no key 'effort', expected a weight of the controls.")
    numbers("a waypoint of the plan", resolved.get(WAYPOINTS, []))
    if RAMP in resolved:
        number("the ramp of the plan", resolved[RAMP], greater_than=0.0)
    for name, reason in resolved["reasons"].items():
        if not isinstance(reason, str):
            raise PlannerError(f"the reason for {short_repr(name)} is {short_repr(reason)}, expected a sentence.")


def with_model_limits(table: dict[str, Any]) -> dict[str, Any]:
    """The table of a file with the limits of its model, as far as it does not say otherwise."""
    limits = table.get("limits", {})
    if limits == OFF:
        limits = dict.fromkeys(MODEL_LIMITS, OFF)
    if not isinstance(limits, dict):
        raise PlannerError(f"limits is {short_repr(limits)}, expected {OFF!r} or a table [limits].")
    return table | {"limits": MODEL_LIMITS | limits}


def checked_values(table: dict[str, Any]) -> tuple[dict[str, Any], int]:
    """The table with its numbers, names, limits and objective checked, and the number of stages."""
    dt, N = stages_of(table["duration"], table["dt"])
    table = table | check_values(table, VALUES)
    table |= {"duration": float(table["duration"]), "dt": dt}
    table["tolerance"] = stored_tolerance(checked_tolerance(table.get("tolerance")))
    if table.get("limits"):
        table["limits"] = Limits.from_dict(table["limits"]).to_dict()
    if "objective" in table:
        table["objective"] = weights_of(table["objective"])
    if "durations" in table:
        table["durations"] = list(checked_durations(table["durations"], table.get("objective", {})) or ())
    return table, N


def tables_of_joints(table: dict[str, Any]) -> list[tuple[str, Any]]:
    """Where a table has positions of joints by name: what it is called there, and what is given."""
    goals = table.get("goal")
    if not isinstance(goals, list):
        return [("start", table["start"]), ("goal", goals)]
    several = [one for one in goals if isinstance(one, dict)]
    return [("start", table["start"]), *((f"goal {k + 1}", one.get("joints")) for k, one in enumerate(several))]
