"""The keys of a problem.toml, each with what it says and its default. Data only."""

from __future__ import annotations

from typing import Any

from planner.dynamics import INTEGRATORS
from planner.problem.objective import OBJECTIVES

KEYS = {
    "model": "MJCF or URDF file, relative to this file",
    "base": "of a URDF: fixed or free, what its root link is; by default fixed, but for a floating joint of the file",
    "floor": "of a URDF: true to add the plane z = 0, on which a free base starts",
    "package_path": "of a URDF: folder of packages, or a list of some, where package:// is sought before the folders "
    "above the file; relative to this file",
    "inertia": "of a URDF: nearest to replace inertias that no body has by the nearest ones, given to refuse them",
    "start": "keyframe, nq numbers (at rest), nq + nv numbers, or a table of joints (the others as the model says)",
    "goal": "the same; joints that a table does not name end where they started",
    "duration": "s, a whole number of stages",
    "dt": "length of a stage, s",
    "integrator": f"one of {', '.join(INTEGRATORS)}",
    "guess": "first controls: hold (the start against gravity, as far as actuators can) or zero",
    "contacts": "on, off to take them out of a model whose shapes may collide, ground, or a table of their law, below",
    "settle": "true to put start and goal on the ground: what no actuator drives moves until it carries them",
    "ignore": "list of what to take out of the model, e.g. frictionloss",
    "prescribed": "list of joints whose acceleration is a control instead of their force; none by default",
    "starts": "number of first guesses to try",
    "seed": "of the first guesses after the first",
    "tolerance": "how far from the goal passes: a number in rad, m, rad/s, m/s, or a table by position, velocity and "
    "joint; 'soft' for no check; by default 2 % of the way",
    "title": "shown in pictures",
    "weights": "table, below",
    "objective": f"one of {', '.join(OBJECTIVES)}, or a table of weights by these names; by default the effort",
    "durations": "[shortest, longest] s, between which an objective with time chooses",
    "limits": "table, below; none by default",
}
LIMITS = {
    "control": 'bounds of the controls: "model" (ctrlrange, forcerange), a number, or a table by actuator',
    "position": 'ranges of hinge and slide joints: "model", or a table of [lower, upper] by joint, rad or m',
    "velocity": "a number for all joints, or a table by joint: a number or [lower, upper], rad/s or m/s",
    "final": '"exact" for all that has a final weight, or a list of joints: to end at the goal exactly',
    "tolerance": "how far a state may be outside its range, or from an exact goal",
}
WEIGHTS = {
    "effort": "on |u|^2 / 2, per second",
    "final_position": "on the squared distance from the goal / 2 at the end",
    "final_velocity": "on the squared velocity error / 2 at the end",
    "position": "on the squared distance from the goal / 2 on the way, per second",
    "velocity": "on the squared velocity error / 2 on the way, per second",
}
LAW = {
    "stiffness": "N/m",
    "damping": "N s/m",
    "ramp": "m of smoothing",
    "slip_damping": "N s/m, of friction before it slips",
    "friction": "mu",
    "bend": "how gradually friction turns from viscous to Coulomb's, 0 to 1",
}
GROUND = {
    "sink": "m, how deep the machine sinks in when it stands on one contact",
    "friction": "mu",
    "damping_ratio": "of the machine bouncing on one contact",
    "slip": "m/s, at which viscous friction would be all there is",
    "ramp": "m of smoothing",
}
URDF = ("base", "floor", "package_path", "inertia")
REQUIRED = ("model", "start", "goal", "duration")
DEFAULTS: dict[str, Any] = {
    "dt": 0.01, "integrator": "rk4", "guess": "hold", "contacts": "on", "settle": False, "ignore": [],
    "starts": 1, "seed": 0, "title": "",
}  # fmt: skip
DEFAULT_WEIGHTS: dict[str, Any] = {
    "effort": 1.0, "final_position": 1000.0, "final_velocity": 1000.0, "position": 0.0, "velocity": 0.0,
}  # fmt: skip
