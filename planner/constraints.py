"""What a plan keeps: planner.Constraint(what, ...). Public names; planner.problem.constraints has the code.

Beside these the terms of planner.costs (Height, Distance, Gap, Velocity) and any function h(xs) or h(xs, us).
"""

from planner.problem.constraints import forces, quantities
from planner.problem.constraints.clearance import Avoid
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.forces import *  # noqa: F403
from planner.problem.constraints.quantities import *  # noqa: F403

__all__ = ["Avoid", "Constraint"]
__all__ += forces.__all__
__all__ += quantities.__all__
