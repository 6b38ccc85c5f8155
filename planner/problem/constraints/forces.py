"""Forces and tendons as residuals: what actuators do, what holds a closed chain together, lengths of fixed tendons.

The constraint of a fixed tendon is

    low <= c'q <= high    at every knot,

with c'q divided by the largest |c|, so that margins and tolerances in rad or m mean the same as for joints. A tendon
has no constraint if the ranges of its joints imply its own, or if equalities fix its length within its range:
MuJoCo's equalities are soft, so the length varies slightly in any motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import choice
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics, RigidBodyDynamics, constraint_forces
from planner.dynamics.joint_forces import force_derivatives_at, forces_at
from planner.model.actuators import DIRECT
from planner.model.coordinates import ANGLE, LENGTH, Coordinate
from planner.model.mechanism import Mechanism
from planner.model.passive_forces import FixedTendon
from planner.model.space import space_of
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.quantities import mechanism_of
from planner.problem.costs.tracking import places
from planner.problem.joint_limits import TENDON_ROUNDING, Range, margin_of
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


def _acting(mechanism: Mechanism, xs: np.ndarray, us: np.ndarray) -> tuple[Mechanism, np.ndarray, np.ndarray]:
    """Arguments of forces_at of states (K, nx) and controls (K, nu), which may have more than the mechanism's."""
    return mechanism, xs[:, : mechanism.space.nx], us[:, : mechanism.nu]


class PowerFunction:
    """The power of actuator a, whose force depends on its control, or on its activation where it has one."""

    rows = 1

    def __init__(self, mechanism: Mechanism, a: int, ndx: int, nu: int) -> None:
        self._mechanism, self._a, self._ndx, self._nu = mechanism, a, ndx, nu
        self.of_controls, self.same = bool(mechanism.actuators.dynamics[a] == DIRECT), ("power", a)

    def _parts(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Force and speed (K,)."""
        m = self._mechanism
        return forces_at(*_acting(m, xs, us))[:, self._a], xs[:, m.velocities] @ m.actuators.moment[self._a]

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, 1) W."""
        force, speed = self._parts(xs, us)
        return (force * speed)[:, None]

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, 1, ndx) and (K, 1, nu)."""
        (force, speed), a, nv = self._parts(xs, us), self._a, self._mechanism.nv
        of_x, of_u = force_derivatives_at(*_acting(self._mechanism, xs, us))
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
        mechanism = mechanism_of(dynamics, self)
        return forces_at(*_acting(mechanism, xs, us)) @ self.weights(mechanism)

    def jacobian(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, 1, ndx) and (K, 1, nu)."""
        mechanism = mechanism_of(dynamics, self)
        weights, (of_x, of_u) = self.weights(mechanism), force_derivatives_at(*_acting(mechanism, xs, us))
        by_x, by_u = np.zeros((len(xs), 1, space_of(dynamics).ndx)), np.zeros((len(xs), 1, dynamics.nu))
        by_x[:, 0, : of_x.shape[2]], by_u[:, 0, : len(weights)] = weights @ of_x, weights * of_u
        return by_x, by_u


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


def tendon_ranges(
    mechanism: Mechanism, margin: Any, given: Mapping[str, Range], of_joints: Mapping[int, Range]
) -> list[tuple[TendonLength, Range]]:
    """The ranges of tendons that constrain a plan, less the margin.

    Args:
        mechanism: Of the plan.
        margin: Of the limits: a number, a table by joints and tendons, or None.
        given: Ranges by name of tendon, in place of the model's.
        of_joints: Ranges of joints in the plan, by degree of freedom.
    """
    found = []
    for tendon in mechanism.tendons:
        length = TendonLength(tendon, mechanism)
        if _is_fixed(length):
            continue
        joint_range = given.get(tendon.name) or _of_model(length, margin)
        ends = [[(one.low, one.high) if (one := of_joints.get(i)) else (-np.inf, np.inf)] for i in tendon.dofs]
        reached = np.sort(length.coefficients[:, None] * np.concatenate(ends), axis=1).sum(axis=0)
        if reached[0] < joint_range.low or reached[1] > joint_range.high:
            found.append((length, joint_range))
    return found


def _is_fixed(length: TendonLength) -> bool:
    """Whether equalities alone fix a tendon's length, at a value within its range."""
    reduction = length.mechanism.reduction
    if reduction is None:
        return False
    c = np.zeros(length.mechanism.nv)
    np.add.at(c, list(length.tendon.dofs), length.coefficients)
    if np.any(np.abs(c @ reduction.G) > TENDON_ROUNDING):
        return False
    low, high = np.array(length.tendon.range) / length.scale
    return bool(low - TENDON_ROUNDING <= c[reduction.dependent] @ reduction.offset <= high + TENDON_ROUNDING)


def tendon_constraint(
    length: TendonLength, joint_range: Range, start: np.ndarray, goal: np.ndarray | None, tolerance: float
) -> Any:
    """The constraint of a tendon, widened to a start or goal within the margin.

    Raises:
        PlannerError: A start, or a goal (nx,) if there is one, outside of the range.
    """
    for what, x in (("start", start), ("goal", goal)):
        if x is None:
            continue
        value = float(length.value(None, x[None], np.zeros((1, 0)))[0])
        widened = joint_range.widened_to(value)
        if widened is None:
            scaled = Range(*(end * length.scale for end in joint_range[:4]), of_model=joint_range.of_model)
            own, message = value * length.scale, f"the {what} has {length} at {value * length.scale:.6g}"
            raise PlannerError(message + scaled.refusal(Coordinate(length.tendon.name, ""), own))
        joint_range = widened
    lower, upper = (end if np.isfinite(end) else None for end in (joint_range.low, joint_range.high))
    return Constraint(length, lower=lower, upper=upper, tolerance=tolerance, name=f"range of {length}")


def _of_model(length: TendonLength, margin: Any) -> Range:
    low, high = np.array(length.tendon.range) / length.scale
    given = margin.get(length.tendon.name) if isinstance(margin, Mapping) else margin
    keep = min(margin_of(high - low, length.unit, given), 0.5 * (high - low))
    return Range(low + keep, high - keep, low, high, of_model=True)


@dataclass(frozen=True, eq=False)
class TendonLength(Residual):
    """The length of a fixed tendon divided by its largest |coefficient|."""

    tendon: FixedTendon
    mechanism: Mechanism

    def __str__(self) -> str:
        return f"tendon {self.tendon.name!r}"

    @property
    def scale(self) -> float:
        """The largest of its |coefficients|."""
        return float(np.abs(self.tendon.coefficients).max())

    @property
    def coefficients(self) -> np.ndarray:
        """(k,) scaled coefficients of its degrees of freedom; the largest is 1 or -1."""
        return np.array(self.tendon.coefficients) / self.scale

    @property
    def unit(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride] - that of its joints
        """Unit, rad or m, of the joint with the largest |coefficient|."""
        dof = self.tendon.dofs[int(np.argmax(np.abs(self.tendon.coefficients)))]
        return ANGLE if np.any(self.mechanism.S[dof, :3]) else LENGTH

    def value(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(K,) scaled lengths for states (K, nx)."""
        return xs[:, self.mechanism.q_address[list(self.tendon.dofs)]] @ self.coefficients

    def jacobian(self, dynamics: Any, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """(K, 1, nv)."""
        by_q = np.zeros((len(xs), 1, self.mechanism.nv))
        by_q[:, 0, list(self.tendon.dofs)] = self.coefficients
        return by_q
