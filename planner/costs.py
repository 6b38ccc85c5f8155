"""Cost terms: tracking, effort, energy, jerk, penalties, targets of frames. Add them with +."""

from planner.problem.costs.drive import DriveCost
from planner.problem.costs.energy import EnergyCost
from planner.problem.costs.frame import CenterOfMassCost, FrameCost
from planner.problem.costs.jerk import JerkCost, driven_by_jerk
from planner.problem.costs.least_squares import LeastSquares
from planner.problem.costs.penalty import PenaltyCost
from planner.problem.costs.penalty_terms import Clearance, Distance, Gap, Height, Point, Segment, Velocity
from planner.problem.costs.terms import Cost, Quadratic, SumCost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.default_weights import default_cost
from planner.problem.objective import Objective
from planner.problem.objective_problem import with_objective

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
