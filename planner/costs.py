"""Cost terms: tracking, effort, energy, jerk, penalties, targets of frames. Add them with +."""

from planner.problem.costs.frame import CenterOfMassCost, FrameCost
from planner.problem.costs.jerk import JerkCost, driven_by_jerk
from planner.problem.costs.least_squares import LeastSquares, PenaltyCost
from planner.problem.costs.motors import DriveCost, EnergyCost
from planner.problem.costs.penalty_terms import Clearance, Distance, Gap, Height, Point, Segment, Velocity
from planner.problem.costs.terms import Cost, Quadratic, SumCost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.objective import with_objective
from planner.problem.problem_parts import Objective
from planner.problem.reaching_cost import default_cost

__all__ = [
    "CenterOfMassCost",
    "Clearance",
    "Cost",
    "Distance",
    "DriveCost",
    "EnergyCost",
    "FrameCost",
    "Gap",
    "Height",
    "JerkCost",
    "LeastSquares",
    "Objective",
    "PenaltyCost",
    "Point",
    "Quadratic",
    "Segment",
    "SumCost",
    "TrackingCost",
    "Velocity",
    "default_cost",
    "driven_by_jerk",
    "with_objective",
]
