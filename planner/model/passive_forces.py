"""Passive forces beside springs and dampers of joints: tendons, drag and exponential torques; and all damping.

A fixed tendon is a weighted sum of joint coordinates with a spring, a damper and a range. With length = coefficients q
and rate = coefficients qd, the generalized force is coefficients' f,

    f = stiffness (nearer end of rest - length if outside of rest, else 0) - damping rate.

Drag of a still fluid is that of MuJoCo's inertia-box model. A body moves through the fluid as the box with its inertia
does. In the frame of its inertia, every component of its twist is opposed by itself: by viscosity in proportion, by
density in proportion to its square. So drag is a sum of wrenches of fixed direction in the link's frame,

    W = -(linear + quadratic |x|) x screw,   x = screw' V,

with V the twist of the link: (angular, linear), as all twists and wrenches of the planner.

Passive torques of human joints are small in mid-range and rise steeply at its ends, and biarticular muscles couple
joints. Riener and Edrich (J Biomech 32, 1999) model both by sums of

    tau_i = amplitude exp(constant + sum_j slope_j q_j),

a constant torque if there are no slopes. MJCF has no such element: a replay adds it to MuJoCo's passive forces
(planner.proof.replays.passive_torque_callback).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from planner.base.arguments import count, number, set_fields, short_repr
from planner.base.errors import PlannerError

LARGEST = 700.0  # magnitude at which the exponent is clipped: exp overflows above 709
_LEAST = 1e-15  # MuJoCo's mjMINVAL: lighter bodies feel nothing, and no box is thinner than its root


@dataclass(frozen=True)
class FixedTendon:
    """A weighted sum of hinge and slide coordinates, with spring, damper and range.

    Attributes:
        name: "" if unnamed in the file.
        dofs: The degrees of freedom that it sums.
        coefficients: One per entry of dofs.
        stiffness: N/m, or N m/rad where the coefficients have no unit.
        rest: Lower and upper end of the interval of lengths in which the spring is slack; equal if it never is.
        damping: N s/m or N m s/rad.
        range: Lower and upper limit of the length, infinite if unlimited: data only, as joint ranges are.
    """

    name: str
    dofs: tuple[int, ...]
    coefficients: tuple[float, ...]
    stiffness: float = 0.0
    rest: tuple[float, float] = (0.0, 0.0)
    damping: float = 0.0
    range: tuple[float, float] = (-math.inf, math.inf)

    @property
    def acts(self) -> bool:
        """Whether it has stiffness or damping, not only a range."""
        return self.stiffness > 0.0 or self.damping > 0.0


def acting_tendons(mechanism: Any) -> tuple[FixedTendon, ...]:
    """The tendons of a mechanism with stiffness or damping."""
    return tuple(tendon for tendon in mechanism.tendons if tendon.acts)


def slack_tendons(mechanism: Any) -> Iterator[FixedTendon]:
    """The tendons with a slack interval, at whose ends the spring force is nonsmooth."""
    return (tendon for tendon in mechanism.tendons if tendon.stiffness > 0.0 and tendon.rest[0] < tendon.rest[1])


def tendon_forces(mechanism: Any, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Generalized force tau (..., nv) of all tendons at q (..., nq), qd (..., nv), which may be complex."""
    tau = np.zeros(np.shape(qd), dtype=np.result_type(q, qd))
    for tendon in acting_tendons(mechanism):
        dofs, c = list(tendon.dofs), np.array(tendon.coefficients)
        length, rate = q[..., mechanism.q_address[dofs]] @ c, qd[..., dofs] @ c
        low, high = tendon.rest
        pull = np.where(np.real(length) < low, low - length, np.where(np.real(length) > high, high - length, 0.0))
        tau[..., dofs] += (tendon.stiffness * pull - tendon.damping * rate)[..., None] * c
    return tau


@dataclass(frozen=True, eq=False)
class Drag:
    """One term of drag on a link."""

    link: int
    screw: np.ndarray  # (6,) direction of the wrench (moment, force) in the link's frame
    linear: float  # N per m/s or N m per rad/s
    quadratic: float  # N per (m/s)^2 or N m per (rad/s)^2


def drags_of(model: Any, links: np.ndarray, inertial: np.ndarray) -> tuple[Drag, ...]:
    """The drag of a compiled MjModel whose passive forces are on.

    Args:
        model: The MjModel.
        links: (nbody,) link that carries each body, -1 for the world.
        inertial: (nbody, 4, 4) inertial frames of the bodies in the frames of their links.
    """
    density, viscosity = max(model.opt.density, 0.0), max(model.opt.viscosity, 0.0)
    if density == viscosity == 0.0:
        return ()
    found: list[Drag] = []
    for body in np.flatnonzero((links >= 0) & (model.body_mass >= _LEAST)):
        R, centre = inertial[body, :3, :3], inertial[body, :3, 3]
        for screw, linear, quadratic in _terms(model.body_mass[body], model.body_inertia[body], density, viscosity):
            moment, force = R @ screw[:3], R @ screw[3:]
            found.append(Drag(int(links[body]), np.append(moment + np.cross(centre, force), force), linear, quadratic))
    return tuple(found)


def _terms(
    mass: float, inertia: np.ndarray, density: float, viscosity: float
) -> Iterator[tuple[np.ndarray, float, float]]:
    """Direction in the inertial frame and coefficients of the six terms of a body (mj_inertiaBoxFluidModel)."""
    box = np.sqrt(np.maximum(np.sum(inertia) - 2.0 * inertia, _LEAST) / mass * 6.0)
    diameter = np.sum(box) / 3.0
    for k in range(3):
        one, other = np.delete(box, k)
        turning = density * box[k] * (one**4 + other**4) / 64.0
        yield np.eye(6)[k], np.pi * diameter**3 * viscosity, turning
        yield np.eye(6)[3 + k], 3.0 * np.pi * diameter * viscosity, 0.5 * density * one * other


def drag_wrenches(mechanism: Any, V: np.ndarray) -> np.ndarray:
    """Wrenches (nv, 6) of drag on the links, in their frames, at their twists V (nv, 6), which may be complex."""
    W = np.zeros((mechanism.nv, 6), dtype=V.dtype)
    for drag in mechanism.drags:
        x = drag.screw @ V[drag.link]
        size = np.where(np.real(x) < 0.0, -x, x)
        W[drag.link] -= (drag.linear + drag.quadratic * size) * x * drag.screw
    return W


@dataclass(frozen=True)
class ExponentialTorque:
    """A torque (on a slide, a force) amplitude exp(constant + sum_j slope_j q_j) of hinge and slide coordinates.

    Attributes:
        dof: Index of the degree of freedom it acts on.
        amplitude: N m or N, signed.
        constant: Constant term of the exponent, no unit.
        slopes: Degree of freedom -> 1/rad or 1/m; a mapping or pairs, stored as sorted pairs.
    """

    dof: int
    amplitude: float
    constant: float = 0.0
    slopes: tuple[tuple[int, float], ...] = field(default=())

    def __post_init__(self) -> None:
        given: Any = self.slopes.items() if isinstance(self.slopes, Mapping) else self.slopes
        try:
            pairs = [(one, other) for one, other in given]
        except (TypeError, ValueError):
            raise PlannerError(f"slopes is {short_repr(self.slopes)}, expected numbers by degree of freedom.") from None
        slopes = {count("slopes: dof", j, minimum=0): number(f"slopes[{j}]", slope) for j, slope in pairs}
        if len(slopes) < len(pairs):
            raise PlannerError(f"slopes is {short_repr(self.slopes)}, expected each degree of freedom once.")
        set_fields(self, slopes=tuple(sorted(slopes.items())), dof=count("dof", self.dof, minimum=0))
        set_fields(self, **{name: number(name, getattr(self, name)) for name in ("amplitude", "constant")})

    @property
    def dofs(self) -> tuple[int, ...]:
        """The degree of freedom it acts on, then those in its exponent."""
        return (self.dof, *(j for j, _ in self.slopes))

    def to_list(self) -> list[Any]:
        """As JSON values: ExponentialTorque(*torque.to_list()) == torque."""
        return [self.dof, self.amplitude, self.constant, [list(pair) for pair in self.slopes]]


def check_curve(curve: Any, turning: np.ndarray, name: str) -> None:
    """Raise a PlannerError unless all dofs of a torque are hinges or slides, which are True in `turning` (nv,)."""
    if not isinstance(curve, ExponentialTorque):
        raise PlannerError(f"{name} is {short_repr(curve)}, expected an ExponentialTorque.")
    for dof in curve.dofs:
        if not (dof < len(turning) and turning[dof]):
            raise PlannerError(f"{name} is of dof {dof}, expected those of hinges or slides, below {len(turning)}.")


def one_torque(curve: ExponentialTorque, address: Sequence[int] | np.ndarray, q: np.ndarray) -> np.ndarray:
    """The torque (...), N m or N, of one curve at q (..., nq); `address` (nv,) is the index of each dof in q."""
    exponent = np.full(np.shape(q)[:-1], curve.constant)
    for j, slope in curve.slopes:
        exponent = exponent + slope * q[..., address[j]]
    return curve.amplitude * np.exp(np.clip(exponent, -LARGEST, LARGEST))


def exponential_joint_torques(mechanism: Any, q: np.ndarray) -> np.ndarray:
    """Generalized force tau (..., nv) of all exponential torques of a mechanism at q (..., nq), N m or N."""
    tau = np.zeros((*np.shape(q)[:-1], mechanism.nv))
    for curve in mechanism.curves:
        tau[..., curve.dof] += one_torque(curve, mechanism.q_address, q)
    return tau


def damping_matrix(mechanism: Any) -> np.ndarray:
    """Damping matrix (nv, nv) = -d(tau)/d(qd) of dampers, actuators and tendons, N m s/rad and N s/m.

    Without that of the actuators' force laws, which depends on the state.
    """
    actuators = mechanism.actuators
    D = np.diag(np.array(mechanism.damping, dtype=float))
    D -= actuators.moment.T @ (actuators.bias[:, 2:3] * actuators.moment)
    for tendon in acting_tendons(mechanism):
        row = np.zeros(mechanism.nv)
        row[list(tendon.dofs)] = tendon.coefficients
        D += tendon.damping * np.outer(row, row)
    return D


def implicit_damping(mechanism: Any) -> np.ndarray:
    """Diagonal damping (nv,) of an implicit step: the absolute row sums of the damping matrix.

    As a matrix it bounds the damping matrix from above, so damping that couples joints is stable too.
    """
    return np.abs(damping_matrix(mechanism)).sum(axis=1)


def damped_implicitly(mechanism: Any, h: float) -> Any:
    """The mechanism with M + h D in place of M, for MuJoCo's implicitfast step of h s; D is the damping matrix.

    With D diagonal that is a larger armature. MuJoCo's D holds no constraint forces, so neither does this.

    Raises:
        PlannerError: D is not diagonal, negative, or depends on the pose, as that of fluid drag.
    """
    D, why = damping_matrix(mechanism), ""
    own = np.diag(D)
    for i, j in np.argwhere(D - np.diag(own))[:1]:
        why = f"damps {mechanism.joint_of(int(i))} and {mechanism.joint_of(int(j))} together"
    for i in np.flatnonzero(own < 0.0)[:1]:
        why = f"drives {mechanism.joint_of(int(i))} by negative damping"
    if mechanism.drags:
        why = "has fluid drag"
    by_rate = [law for law in mechanism.actuators.laws if law.kind != "affine gain" or law.numbers[1] != 0.0]
    for law in by_rate[:1]:
        why = f"has an actuator, {mechanism.actuators.names[law.actuator]!r}, with a damping that depends on the state"
    if why:
        raise PlannerError(
            f'the integrators "implicitfast" and "leapfrog" take damping of single joints and this machine {why}, '
            'expected "rosenbrock", or "rk4".'
        )
    return replace(mechanism, armature=mechanism.armature + h * own)


def damped_later(mechanism: Any, delay: float) -> Any:
    """The mechanism whose damping, friction loss and laws with a lead feel the velocity that comes `delay` s later.

    That is v + delay a: armatures become heavier, as of damped_implicitly, leads longer by it, and friction loss, of
    x = inertia / loss (a + rate v), gets another inertia and rate.

    Raises:
        PlannerError: As of damped_implicitly.
    """
    later, parts = 1.0 + delay * mechanism.friction_rate, {}
    for name in ("contacts", "body_contacts", "stops"):
        parts[name] = tuple(
            replace(one, law=replace(one.law, lead=one.law.lead + delay)) if one.law.lead > 0.0 else one
            for one in getattr(mechanism, name)
        )
    return replace(
        damped_implicitly(mechanism, delay), friction_inertia=mechanism.friction_inertia * later,
        friction_rate=mechanism.friction_rate / later, **parts,
    )  # fmt: skip
