"""Power, JointForce and ChainForce: what actuators do, and the force that holds a closed chain together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import choice
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics, RigidBodyDynamics, constraint_forces
from planner.dynamics.actuator_moments import force_rows
from planner.model.actuators import DIRECT
from planner.model.mechanism import SCREW, Mechanism
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
        one = mechanism.actuators
        self._a, self._nu, self._nv, self._nq = a, nu, mechanism.nv, mechanism.nq
        self._moment, self._gain, self._bias = one.moment[a], float(one.gain[a]), one.bias[a]
        self.of_controls = bool(one.dynamics[a] == DIRECT)
        self._state = mechanism.nq + mechanism.nv + int(one.activation[a])  # of its activation, where it has one
        screws = np.flatnonzero((mechanism.kind == SCREW) & (self._moment != 0.0))
        self._screws, self._address = screws, mechanism.q_address[screws]
        self._ndx, self.same = ndx, ("power", a)

    def _parts(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Force and speed (K,)."""
        speed = xs[:, self._nq : self._nq + self._nv] @ self._moment
        length = xs[:, self._address] @ self._moment[self._screws]
        input_ = us[:, self._a] if self.of_controls else xs[:, self._state]
        return self._gain * input_ + self._bias[0] + self._bias[1] * length + self._bias[2] * speed, speed

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, 1) W."""
        force, speed = self._parts(xs, us)
        return (force * speed)[:, None]

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, 1, ndx) and (K, 1, nu)."""
        force, speed = self._parts(xs, us)
        by_x, by_u = np.zeros((len(xs), 1, self._ndx)), np.zeros((len(xs), 1, self._nu))
        by_x[:, 0, self._nv : 2 * self._nv] = (force + self._bias[2] * speed)[:, None] * self._moment
        by_x[:, 0, self._screws] = (self._bias[1] * speed)[:, None] * self._moment[self._screws]
        if self.of_controls:
            by_u[:, 0, self._a] = self._gain * speed
        else:
            by_x[:, 0, self._state - self._nq + self._nv] = self._gain * speed
        return by_x, by_u


@dataclass(frozen=True)
class JointForce(Residual):
    """Sum of the generalized forces of the actuators on a hinge or slide, without clamps, N m or N.

    Attributes:
        joint: Its name.
    """

    joint: str
    of_controls = True

    def __str__(self) -> str:
        return f"force of the actuators on {self.joint}"

    def residual_function(self, dynamics: Dynamics, N: int) -> PythonResidual:
        """Its function, of a machine.

        Raises:
            PlannerError: It has no such joint, or the joint's force is not one number that is linear in the state.
        """
        mechanism = mechanism_of(dynamics, self)
        links = mechanism.joint(self.joint)
        acting = mechanism.actuators.acts_on[:, links.start]
        if links.stop - links.start != 1 or np.any(mechanism.actuators.by_wrenches[acting]):
            raise PlannerError(
                f"{self.joint} is a ball or free joint, or an actuator at a site moves it, expected a hinge or slide "
                "with actuators of joints and fixed tendons."
            )
        return PythonResidual(self, dynamics)

    def value(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(K,)."""
        mechanism, moment, (by_state, _, by_control) = self._parts(dynamics)
        constant, nx = moment @ mechanism.actuators.bias[:, 0], len(by_state)
        return constant + xs[:, :nx] @ by_state + us[:, : mechanism.nu] @ by_control

    def jacobian(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, 1, ndx) and (K, 1, nu)."""
        _, _, (_, by_deviation, by_control) = self._parts(dynamics)
        by_x, by_u = np.zeros((len(xs), 1, space_of(dynamics).ndx)), np.zeros((len(xs), 1, dynamics.nu))
        by_x[:, 0, : len(by_deviation)], by_u[:, 0, : len(by_control)] = by_deviation, by_control
        return by_x, by_u

    def _parts(self, dynamics: Any) -> tuple[Mechanism, np.ndarray, list[np.ndarray]]:
        """The machine, the moments (nu,) at the joint, and derivatives by state, its deviation and the controls."""
        mechanism = mechanism_of(dynamics, self)
        actuators, dof = mechanism.actuators, mechanism.joint(self.joint).start
        moment, gain = actuators.moment[:, dof], np.where(actuators.dynamics == DIRECT, actuators.gain, 0.0)
        return mechanism, moment, [*(moment @ rows for rows in force_rows(mechanism)), moment * gain]


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
