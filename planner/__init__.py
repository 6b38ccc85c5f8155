"""Plan a robot's motion, then prove the plan in a simulator that had no part in making it.

problem = planner.cases.hopper(height=20.0)
plan = planner.solve(problem)
proof = planner.prove(plan)
planner.render_video(proof.replay, "hopper.mp4")
"""

from planner import cases
from planner.cost import Cost, Quadratic, TrackingCost
from planner.dynamics import Dynamics, FunctionDynamics, HopperDynamics
from planner.errors import FileError, ModelError, PlannerError, RenderingUnavailable
from planner.plan import Iteration, Plan, Status
from planner.problem import Problem
from planner.proof import Proof, parity, prove
from planner.replay import Replay, replay
from planner.slq import solve
from planner.twin import Twin

__version__ = "0.1.0"

__all__ = [
    "Cost",
    "Dynamics",
    "FileError",
    "FunctionDynamics",
    "HopperDynamics",
    "Iteration",
    "ModelError",
    "Plan",
    "PlannerError",
    "Problem",
    "Proof",
    "Quadratic",
    "RenderingUnavailable",
    "Replay",
    "Status",
    "TrackingCost",
    "Twin",
    "cases",
    "parity",
    "prove",
    "replay",
    "solve",
]
