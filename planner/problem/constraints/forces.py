"""Forces as residuals: what actuators do, and the force that holds a closed chain together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import choice
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics, RigidBodyDynamics, constraint_forces
from planner.dynamics.actuator_moments import StateForces, forces_at
from planner.model.actuators import DIRECT
from planner.model.mechanism import Mechanism
from planner.model.space import space_of
from planner.problem.constraints.quantities import mechanism_of
from planner.problem.costs.weights import places
from planner.problem.residual import PythonResidual, Residual

__all__ = ["ChainForce", "Power"]


@dataclass(frozen=True)
class Power(Residual):
    """Force times moment'qd of an actuator, W: positive where it drives, negative where it brakes.

    The force is that of planner.model.mechanism, without clamps.

    Attributes:
        actuator: Its name.
    """

    actuator: str
    unit = "W"

    def __str__(self) -> str:
        return f"power of {self.actuator}"

    def residual_function(self, dynamics: Dynamics, N: int) -> PowerFunction:
        """Its function, of a machine.

        Raises:
            PlannerError: It has no such actuator, or one at a site.
        """
        mechanism = mechanism_of(dynamics, self)
        inputs = places(mechanism, ())[1]
        index = inputs[choice("the actuator of a power", self.actuator, inputs)].start
        if mechanism.actuators.by_wrenches[index]:
            raise PlannerError(f"{self.actuator} acts at a site, expected an actuator of joints or a fixed tendon.")
        return PowerFunction(mechanism, index, space_of(dynamics).ndx, dynamics.nu)


class PowerFunction:
    """The power of actuator a, whose force depends on its control, or on its activation where it has one."""

    rows = 1

    def __init__(self, mechanism: Mechanism, a: int, ndx: int, nu: int) -> None:
        self._mechanism, self._a, self._ndx, self._nu = mechanism, a, ndx, nu
        self.of_controls, self.same = bool(mechanism.actuators.dynamics[a] == DIRECT), ("power", a)

    def _parts(self, xs: np.ndarray, us: np.ndarray) -> tuple[StateForces, np.ndarray]:
        """Forces of the actuators, and the speed (K,) of this one."""
        m = self._mechanism
        forces = forces_at(m, xs[:, : m.space.nx], us[:, : m.nu])
        return forces, xs[:, m.nq : m.nq + m.nv] @ m.actuators.moment[self._a]

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, 1) W."""
        forces, speed = self._parts(xs, us)
        return (forces.force[:, self._a] * speed)[:, None]

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, 1, ndx) and (K, 1, nu)."""
        (forces, speed), a, nv = self._parts(xs, us), self._a, self._mechanism.nv
        by_x, by_u = np.zeros((len(xs), 1, self._ndx)), np.zeros((len(xs), 1, self._nu))
        by_x[:, 0, : forces.by_x.shape[2]] = speed[:, None] * forces.by_x[:, a]
        by_x[:, 0, nv : 2 * nv] += forces.force[:, a, None] * self._mechanism.actuators.moment[a]
        by_u[:, 0, a] = forces.by_u[:, a] * speed
        return by_x, by_u


class _SumOfForces(Residual):
    """A weighted sum of the actuators' forces, without clamps."""

    of_controls = True

    def weights(self, mechanism: Mechanism) -> np.ndarray:
        """The weight (nu,) of each force."""
        raise NotImplementedError

    def residual_function(self, dynamics: Dynamics, N: int) -> PythonResidual:
        """Its function, of a machine.

        Raises:
            PlannerError: It has no such joint or actuator, or the sum is not one number.
        """
        self.weights(mechanism_of(dynamics, self))
        return PythonResidual(self, dynamics)

    def value(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(K,)."""
        weights, forces = self._parts(dynamics, xs, us)
        return forces.force @ weights

    def jacobian(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, 1, ndx) and (K, 1, nu)."""
        weights, forces = self._parts(dynamics, xs, us)
        by_x, by_u = np.zeros((len(xs), 1, space_of(dynamics).ndx)), np.zeros((len(xs), 1, dynamics.nu))
        by_x[:, 0, : forces.by_x.shape[2]] = weights @ forces.by_x
        by_u[:, 0, : len(weights)] = weights * forces.by_u
        return by_x, by_u

    def _parts(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, StateForces]:
        mechanism = mechanism_of(dynamics, self)
        return self.weights(mechanism), forces_at(mechanism, xs[:, : mechanism.space.nx], us[:, : mechanism.nu])


@dataclass(frozen=True)
class JointForce(_SumOfForces):
    """Sum of the generalized forces of the actuators on a hinge or slide, without clamps, N m or N.

    Attributes:
        joint: Its name.
    """

    joint: str

    def __str__(self) -> str:
        return f"force of the actuators on {self.joint}"

    def weights(self, mechanism: Mechanism) -> np.ndarray:
        """The moments (nu,) at the joint; PlannerError unless its force is one number."""
        links = mechanism.joint(self.joint)
        acting = mechanism.actuators.acts_on[:, links.start]
        if links.stop - links.start != 1 or np.any(mechanism.actuators.by_wrenches[acting]):
            raise PlannerError(
                f"{self.joint} is a ball or free joint, or an actuator at a site moves it, expected a hinge or slide "
                "with actuators of joints and fixed tendons."
            )
        return mechanism.actuators.moment[:, links.start]


@dataclass(frozen=True)
class ActuatorForce(_SumOfForces):
    """Force of an actuator, without clamps, N m or N.

    Attributes:
        actuator: Its name.
    """

    actuator: str

    def __str__(self) -> str:
        return f"force of {self.actuator}"

    def weights(self, mechanism: Mechanism) -> np.ndarray:
        """1 (nu,) for this one."""
        names = mechanism.actuators.names
        return np.eye(len(names))[names.index(choice("the actuator of a force", self.actuator, names))]


@dataclass(frozen=True)
class ChainForce(Residual):
    """Magnitude of the force with which an equality of the model (connect, weld) acts on its two frames, N.

    Attributes:
        equality: Its name.
    """

    equality: str
    unit = "N"
    of_controls = True

    def __str__(self) -> str:
        return f"force of {self.equality}"

    def residual_function(self, dynamics: Dynamics, N: int) -> PythonResidual:
        """Its function, of a machine.

        Raises:
            PlannerError: It has no such closed chain.
        """
        self._row(dynamics)
        return PythonResidual(self, dynamics)

    def value(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(K,) N."""
        row = self._row(dynamics)
        return np.linalg.norm(constraint_forces(dynamics, xs, us)[:, row : row + 3], axis=1)

    def _row(self, dynamics: Dynamics) -> int:
        """The first row of the equality among those of all loops."""
        row, known = 0, dict[str, int]()
        for loop in mechanism_of(dynamics, self).loops:
            known[loop.name.removeprefix("equality ").strip("'")] = row
            row += loop.rows
        if not known or not isinstance(dynamics, RigidBodyDynamics):
            raise PlannerError(f"the {self} needs a closed chain, expected a machine with a connect or a weld.")
        return known[choice("the equality of a force", self.equality, known)]
