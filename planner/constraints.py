"""What a plan keeps: planner.Constraint(what, ...). Public names; planner.problem.constraints has the code.

Beside these the terms of planner.costs (Height, Distance, Gap, Velocity) and any function h(xs) or h(xs, us).
"""

from planner.problem.avoid import Avoid
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.forces import ChainForce, Power
from planner.problem.constraints.quantities import (
    CenterOfMass,
    FrameAxisAngle,
    FrameOrientation,
    FramePosition,
    FramePositionAlong,
)

__all__ = [
    "Avoid",
    "CenterOfMass",
    "ChainForce",
    "Constraint",
    "FrameAxisAngle",
    "FrameOrientation",
    "FramePosition",
    "FramePositionAlong",
    "Power",
]
