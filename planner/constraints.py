"""What a plan keeps: planner.Constraint(what, ...). Public names; planner.problem.constraints has the code.

Beside these the terms of planner.costs (Height, Distance, Gap, Velocity) and any function h(xs) or h(xs, us).
"""

from planner.problem.avoid import Avoid
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.of_terms import Along, MassCentre, Place, Tilt, Turn
from planner.problem.constraints.power import Power

__all__ = ["Along", "Avoid", "Constraint", "MassCentre", "Place", "Power", "Tilt", "Turn"]
