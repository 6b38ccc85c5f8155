"""ChainForce: how hard a closed chain is held together, a pin's load or a grip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planner.base.arguments import choice
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics, RigidBodyDynamics, constraint_forces
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.constraint_functions import UserFunction
from planner.problem.constraints.quantities import machine_of


@dataclass(frozen=True)
class ChainForce:
    """The force with which an equality of the model (connect, weld) holds its two frames together, N.

    Attributes:
        equality: Its name.
    """

    equality: str
    unit = "N"

    def __str__(self) -> str:
        return f"force of {self.equality}"

    def measure(self, dynamics: Dynamics, N: int) -> UserFunction:
        """Of a machine.

        Raises:
            PlannerError: It has no such closed chain.
        """
        mechanism, row, known = machine_of(dynamics, self), 0, dict[str, int]()
        for loop in mechanism.loops:
            known[loop.name.removeprefix("equality ").strip("'")] = row
            row += loop.rows
        if not known or not isinstance(dynamics, RigidBodyDynamics):
            raise PlannerError(f"the {self} is that of a closed chain, expected a machine with a connect or a weld.")
        first = known[choice("the equality of a force", self.equality, known)]

        def force(xs: np.ndarray, us: np.ndarray) -> np.ndarray:
            return np.linalg.norm(constraint_forces(dynamics, xs, us)[:, first : first + 3], axis=1)

        return UserFunction(Constraint(force, upper=0.0), dynamics, mechanism.home, np.zeros(dynamics.nu))
