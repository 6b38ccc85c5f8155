"""Forces as residuals: what actuators do, and the force that holds a closed chain together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import choice
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics, RigidBodyDynamics, constraint_forces
from planner.dynamics.joint_forces import force_derivatives_at, forces_at
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

    def _at(self, xs: np.ndarray, us: np.ndarray) -> tuple[Mechanism, np.ndarray, np.ndarray]:
        """Arguments of forces_at."""
        return self._mechanism, xs[:, : self._mechanism.space.nx], us[:, : self._mechanism.nu]

    def _parts(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Force and speed (K,)."""
        m = self._mechanism
        return forces_at(*self._at(xs, us))[:, self._a], xs[:, m.nq : m.nq + m.nv] @ m.actuators.moment[self._a]

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, 1) W."""
        force, speed = self._parts(xs, us)
        return (force * speed)[:, None]

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, 1, ndx) and (K, 1, nu)."""
        (force, speed), a, nv = self._parts(xs, us), self._a, self._mechanism.nv
        of_x, of_u = force_derivatives_at(*self._at(xs, us))
        by_x, by_u = np.zeros((len(xs), 1, self._ndx)), np.zeros((len(xs), 1, self._nu))
        by_x[:, 0, : of_x.shape[2]] = speed[:, None] * of_x[:, a]
        by_x[:, 0, nv : 2 * nv] += force[:, None] * self._mechanism.actuators.moment[a]
        by_u[:, 0, a] = of_u[:, a] * speed
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
        mechanism, *at = self._at(dynamics, xs, us)
        return forces_at(mechanism, *at) @ self.weights(mechanism)

    def jacobian(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, 1, ndx) and (K, 1, nu)."""
        mechanism, *at = self._at(dynamics, xs, us)
        weights, (of_x, of_u) = self.weights(mechanism), force_derivatives_at(mechanism, *at)
        by_x, by_u = np.zeros((len(xs), 1, space_of(dynamics).ndx)), np.zeros((len(xs), 1, dynamics.nu))
        by_x[:, 0, : of_x.shape[2]], by_u[:, 0, : len(weights)] = weights @ of_x, weights * of_u
        return by_x, by_u

    def _at(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> tuple[Mechanism, np.ndarray, np.ndarray]:
        """Arguments of forces_at."""
        mechanism = mechanism_of(dynamics, self)
        return mechanism, xs[:, : mechanism.space.nx], us[:, : mechanism.nu]


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
