"""Plan a robot's motion, then prove the plan in a simulator that had no part in making it.

problem = planner.cases.hopper(height=20.0)
plan = planner.solve(problem)
proof = planner.prove(plan)
planner.render_video(proof.replay, "hopper.mp4")
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from planner import cases
    from planner.body_contact import BodyContact, Capsule
    from planner.check import Checked, check
    from planner.closing import Periodic
    from planner.contact import Contact, Law, Plane, Stop, Touch
    from planner.contact_forces import ContactForces, body_contact_forces, contact_forces
    from planner.control_spline import SplineControls, solve_by_splines
    from planner.cost import Cost, Quadratic, SumCost, TrackingCost
    from planner.drive_cost import DriveCost
    from planner.dynamics import Dynamics, FunctionDynamics, HopperDynamics, RigidBodyDynamics
    from planner.energy_cost import EnergyCost
    from planner.errors import FileError, ModelError, PlannerError, RenderingUnavailable
    from planner.frame_cost import FrameCost
    from planner.free_time import retimed, solve_for
    from planner.gradient_methods import Descended, cost_and_gradient, minimize_by_gradient
    from planner.hold import hold_gain
    from planner.jerk import JerkCost, driven_by_jerk
    from planner.joint_curves import ExponentialTorque
    from planner.limits import Limits
    from planner.mechanism import Mechanism
    from planner.mechanism_contacts import contact_attributes, stop_attributes
    from planner.momentum import angular_momentum, center_of_mass
    from planner.objective import Objective, with_objective
    from planner.payload import largest_payload, static_limit
    from planner.penalty_cost import PenaltyCost
    from planner.penalty_terms import Distance, Gap, Height, Point, Segment, Velocity
    from planner.periodic import Pass, solve_periodic
    from planner.plan import Iteration, Plan, Start, Status
    from planner.problem import Problem
    from planner.proof import Proof, prove
    from planner.proof.cost import proven_cost
    from planner.proof.parity import parity
    from planner.proof.perturbation import Perturbation
    from planner.refine import Refined, Refinement, refine
    from planner.render import render_frame, render_strip, render_video
    from planner.replay import Replay, replay
    from planner.rigid_body import (
        bias,
        bias_derivatives,
        forward_dynamics,
        forward_dynamics_derivatives,
        forward_kinematics,
        forward_kinematics_derivatives,
        frame_pose,
        hybrid_dynamics,
        hybrid_dynamics_derivatives,
        jacobian,
        jacobian_derivatives,
        mass_matrix,
        mass_matrix_derivatives,
        rnea,
        rnea_derivatives,
    )
    from planner.shooting import Extremal, shoot
    from planner.slq import solve
    from planner.space import StateSpace
    from planner.spline import SplineMotion, minimize_effort
    from planner.statics import settled
    from planner.twin import Twin
    from planner.underactuated import DrivenMotion, minimize_effort_underactuated

__version__ = "0.1.0"

# Where the names below are found when they are first asked for: a plan does not wait for the paper's other methods, and
# `import planner` chooses no OpenGL. What type checkers are told above must be the same.
_MODULES = {
    "body_contact": "BodyContact Capsule",
    "check": "Checked check",
    "closing": "Periodic",
    "contact": "Contact Law Plane Stop Touch",
    "contact_forces": "ContactForces body_contact_forces contact_forces",
    "control_spline": "SplineControls solve_by_splines",
    "cost": "Cost Quadratic SumCost TrackingCost",
    "drive_cost": "DriveCost",
    "dynamics": "Dynamics FunctionDynamics HopperDynamics RigidBodyDynamics",
    "energy_cost": "EnergyCost",
    "errors": "FileError ModelError PlannerError RenderingUnavailable",
    "frame_cost": "FrameCost",
    "free_time": "retimed solve_for",
    "gradient_methods": "Descended cost_and_gradient minimize_by_gradient",
    "hold": "hold_gain",
    "jerk": "JerkCost driven_by_jerk",
    "joint_curves": "ExponentialTorque",
    "limits": "Limits",
    "mechanism": "Mechanism",
    "mechanism_contacts": "contact_attributes stop_attributes",
    "momentum": "angular_momentum center_of_mass",
    "objective": "Objective with_objective",
    "payload": "largest_payload static_limit",
    "penalty_cost": "PenaltyCost",
    "penalty_terms": "Distance Gap Height Point Segment Velocity",
    "periodic": "Pass solve_periodic",
    "plan": "Iteration Plan Start Status",
    "problem": "Problem",
    "proof": "Proof prove",
    "proof.cost": "proven_cost",
    "proof.parity": "parity",
    "proof.perturbation": "Perturbation",
    "refine": "Refined Refinement refine",
    "render": "render_frame render_strip render_video",
    "replay": "Replay replay",
    "rigid_body": (
        "bias bias_derivatives forward_dynamics forward_dynamics_derivatives forward_kinematics "
        "forward_kinematics_derivatives frame_pose hybrid_dynamics hybrid_dynamics_derivatives jacobian "
        "jacobian_derivatives mass_matrix mass_matrix_derivatives rnea rnea_derivatives"
    ),
    "shooting": "Extremal shoot",
    "slq": "solve",
    "space": "StateSpace",
    "spline": "SplineMotion minimize_effort",
    "statics": "settled",
    "twin": "Twin",
    "underactuated": "DrivenMotion minimize_effort_underactuated",
}
_HOME = {name: f"planner.{module}" for module, names in _MODULES.items() for name in names.split()}


class _Package(ModuleType):
    """A package whose functions go before its modules of the same name, whichever is imported first."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):  # the import system offers `planner.check`, a module
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    """Import what is asked for: a name of `__all__`, or a module of the package."""
    if name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
        globals()[name] = value
        return value
    module = f"planner.{name}"
    if not name.startswith("_"):
        try:
            return import_module(module)
        except ModuleNotFoundError as error:
            if error.name != module:  # it is there, and misses something itself
                raise
    raise AttributeError(f"module 'planner' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


__all__ = [
    "BodyContact",
    "Capsule",
    "Checked",
    "Contact",
    "ContactForces",
    "Cost",
    "Descended",
    "Distance",
    "DriveCost",
    "DrivenMotion",
    "Dynamics",
    "EnergyCost",
    "ExponentialTorque",
    "Extremal",
    "FileError",
    "FrameCost",
    "FunctionDynamics",
    "Gap",
    "Height",
    "HopperDynamics",
    "Iteration",
    "JerkCost",
    "Law",
    "Limits",
    "Mechanism",
    "ModelError",
    "Objective",
    "Pass",
    "PenaltyCost",
    "Periodic",
    "Perturbation",
    "Plan",
    "Plane",
    "PlannerError",
    "Point",
    "Problem",
    "Proof",
    "Quadratic",
    "Refined",
    "Refinement",
    "RenderingUnavailable",
    "Replay",
    "RigidBodyDynamics",
    "Segment",
    "SplineControls",
    "SplineMotion",
    "Start",
    "StateSpace",
    "Status",
    "Stop",
    "SumCost",
    "Touch",
    "TrackingCost",
    "Twin",
    "Velocity",
    "angular_momentum",
    "bias",
    "bias_derivatives",
    "body_contact_forces",
    "cases",
    "center_of_mass",
    "check",
    "contact_attributes",
    "contact_forces",
    "cost_and_gradient",
    "driven_by_jerk",
    "forward_dynamics",
    "forward_dynamics_derivatives",
    "forward_kinematics",
    "forward_kinematics_derivatives",
    "frame_pose",
    "hold_gain",
    "hybrid_dynamics",
    "hybrid_dynamics_derivatives",
    "jacobian",
    "jacobian_derivatives",
    "largest_payload",
    "mass_matrix",
    "mass_matrix_derivatives",
    "minimize_by_gradient",
    "minimize_effort",
    "minimize_effort_underactuated",
    "parity",
    "prove",
    "proven_cost",
    "refine",
    "render_frame",
    "render_strip",
    "render_video",
    "replay",
    "retimed",
    "rnea",
    "rnea_derivatives",
    "settled",
    "shoot",
    "solve",
    "solve_by_splines",
    "solve_for",
    "solve_periodic",
    "static_limit",
    "stop_attributes",
    "with_objective",
]
