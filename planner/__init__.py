"""Plan a robot's motion, then prove the plan in a simulator that had no part in making it.

problem = planner.cases.hopper(height=20.0)
plan = planner.solve(problem)
proof = planner.prove(plan)
planner.render_video(proof.replay, "hopper.mp4")
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from planner import cases
from planner.check import Checked, check
from planner.closing import Periodic
from planner.contact import Contact, Law, Plane, Stop, Touch
from planner.contact_forces import ContactForces, contact_forces
from planner.control_spline import SplineControls, solve_by_splines
from planner.cost import Cost, Quadratic, SumCost, TrackingCost
from planner.dynamics import Dynamics, FunctionDynamics, HopperDynamics, RigidBodyDynamics
from planner.energy_cost import EnergyCost
from planner.errors import FileError, ModelError, PlannerError, RenderingUnavailable
from planner.frame_cost import FrameCost
from planner.free_time import retimed, solve_for
from planner.gradient_methods import Descended, cost_and_gradient, minimize_by_gradient
from planner.hold import hold_gain
from planner.jerk import JerkCost
from planner.limits import Limits
from planner.mechanism import Mechanism
from planner.mechanism_contacts import contact_attributes, stop_attributes
from planner.momentum import angular_momentum, center_of_mass
from planner.objective import Objective, with_objective
from planner.payload import largest_payload, static_limit
from planner.penalty_cost import PenaltyCost
from planner.penalty_terms import Distance, Gap, Height, Point, Segment
from planner.periodic import Pass, solve_periodic
from planner.plan import Iteration, Plan, Start, Status
from planner.problem import Problem
from planner.proof import Proof, prove
from planner.proof.cost import proven_cost
from planner.proof.parity import parity
from planner.proof.perturbation import Perturbation
from planner.refine import Refined, Refinement, refine
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
from planner.twin import Twin
from planner.underactuated import DrivenMotion, minimize_effort_underactuated

if TYPE_CHECKING:
    from planner.render import render_frame, render_strip, render_video

__version__ = "0.1.0"

_RENDERING = ("render_frame", "render_strip", "render_video")


def __getattr__(name: str) -> Any:
    """Rendering is imported when it is first asked for: `import planner` stays light and chooses no OpenGL."""
    if name in _RENDERING:
        from planner import render

        return getattr(render, name)
    raise AttributeError(f"module 'planner' has no attribute {name!r}")


__all__ = [
    "Checked",
    "Contact",
    "ContactForces",
    "Cost",
    "Descended",
    "Distance",
    "DrivenMotion",
    "Dynamics",
    "EnergyCost",
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
    "angular_momentum",
    "bias",
    "bias_derivatives",
    "cases",
    "center_of_mass",
    "check",
    "contact_attributes",
    "contact_forces",
    "cost_and_gradient",
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
    "shoot",
    "solve",
    "solve_by_splines",
    "solve_for",
    "solve_periodic",
    "static_limit",
    "stop_attributes",
    "with_objective",
]
