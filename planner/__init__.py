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
    from planner.base.errors import FileError, ModelError, PlannerError, RenderingUnavailable
    from planner.dynamics import Dynamics, FunctionDynamics, HopperDynamics, RigidBodyDynamics
    from planner.dynamics.algorithms import (
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
    from planner.dynamics.contacts import ContactForces, body_contact_forces, contact_forces
    from planner.dynamics.momentum import angular_momentum, center_of_mass
    from planner.dynamics.statics import settled
    from planner.model.contact.between_bodies import BodyContact, Capsule
    from planner.model.contact.laws import Contact, ContactLaw, Law, Plane, Stop
    from planner.model.joint_curves import ExponentialTorque
    from planner.model.mechanism import Mechanism
    from planner.model.mjcf.contacts import contact_attributes, stop_attributes
    from planner.model.space import StateSpace
    from planner.model.twin import Twin
    from planner.paper.methods.control_spline import SplineControls, solve_by_splines
    from planner.paper.methods.gradient_methods import Descended, cost_and_gradient, minimize_by_gradient
    from planner.paper.methods.shooting import Extremal, shoot
    from planner.paper.methods.splines import SplineMotion, minimize_effort
    from planner.paper.methods.underactuated import DrivenMotion, minimize_effort_underactuated
    from planner.paper.payload import largest_payload, static_limit
    from planner.problem.costs.drive import DriveCost
    from planner.problem.costs.energy import EnergyCost
    from planner.problem.costs.frame import FrameCost
    from planner.problem.costs.jerk import JerkCost, driven_by_jerk
    from planner.problem.costs.penalty import PenaltyCost
    from planner.problem.costs.penalty_terms import Distance, Gap, Height, Point, Segment, Velocity
    from planner.problem.costs.tracking import Cost, Quadratic, SumCost, TrackingCost
    from planner.problem.limits import Limits
    from planner.problem.objective import Objective, with_objective
    from planner.problem.periodicity import Periodic
    from planner.problem.plan import Iteration, Plan, Start, Status
    from planner.problem.problem import Problem
    from planner.proof import Proof, prove
    from planner.proof.cost import proven_cost
    from planner.proof.hold import hold_gain
    from planner.proof.models_agree import parity
    from planner.proof.perturbation import Perturbation
    from planner.proof.refinement import Refined, Refinement, refine
    from planner.proof.replaying import Replay, replay
    from planner.solvers.free_time import retimed, solve_for
    from planner.solvers.periodic import Pass, solve_periodic
    from planner.solvers.slq import solve
    from planner.sweeps.stored_plans import Checked, check
    from planner.view.render.video import render_frame, render_strip, render_video

__version__ = "0.1.0"

# Where the names below are found when they are first asked for: a plan does not wait for the paper's other methods, and
# `import planner` chooses no OpenGL. What type checkers are told above must be the same.
_MODULES = {
    "model.contact.between_bodies": "BodyContact Capsule",
    "sweeps.stored_plans": "Checked check",
    "problem.periodicity": "Periodic",
    "model.contact.laws": "Contact Law Plane Stop ContactLaw",
    "dynamics.contacts": "ContactForces body_contact_forces contact_forces",
    "paper.methods.control_spline": "SplineControls solve_by_splines",
    "problem.costs.tracking": "Cost Quadratic SumCost TrackingCost",
    "problem.costs.drive": "DriveCost",
    "dynamics": "Dynamics FunctionDynamics HopperDynamics RigidBodyDynamics",
    "problem.costs.energy": "EnergyCost",
    "base.errors": "FileError ModelError PlannerError RenderingUnavailable",
    "problem.costs.frame": "FrameCost",
    "solvers.free_time": "retimed solve_for",
    "paper.methods.gradient_methods": "Descended cost_and_gradient minimize_by_gradient",
    "proof.hold": "hold_gain",
    "problem.costs.jerk": "JerkCost driven_by_jerk",
    "model.joint_curves": "ExponentialTorque",
    "problem.limits": "Limits",
    "model.mechanism": "Mechanism",
    "model.mjcf.contacts": "contact_attributes stop_attributes",
    "dynamics.momentum": "angular_momentum center_of_mass",
    "problem.objective": "Objective with_objective",
    "paper.payload": "largest_payload static_limit",
    "problem.costs.penalty": "PenaltyCost",
    "problem.costs.penalty_terms": "Distance Gap Height Point Segment Velocity",
    "solvers.periodic": "Pass solve_periodic",
    "problem.plan": "Iteration Plan Start Status",
    "problem.problem": "Problem",
    "proof": "Proof prove",
    "proof.cost": "proven_cost",
    "proof.models_agree": "parity",
    "proof.perturbation": "Perturbation",
    "proof.refinement": "Refined Refinement refine",
    "view.render.video": "render_frame render_strip render_video",
    "proof.replaying": "Replay replay",
    "dynamics.algorithms": (
        "bias bias_derivatives forward_dynamics forward_dynamics_derivatives forward_kinematics "
        "forward_kinematics_derivatives frame_pose hybrid_dynamics hybrid_dynamics_derivatives jacobian "
        "jacobian_derivatives mass_matrix mass_matrix_derivatives rnea rnea_derivatives"
    ),
    "paper.methods.shooting": "Extremal shoot",
    "solvers.slq": "solve",
    "model.space": "StateSpace",
    "paper.methods.splines": "SplineMotion minimize_effort",
    "dynamics.statics": "settled",
    "model.twin": "Twin",
    "paper.methods.underactuated": "DrivenMotion minimize_effort_underactuated",
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
    "ContactLaw",
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
