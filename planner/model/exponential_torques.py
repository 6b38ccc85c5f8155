"""ExponentialTorque: a joint's passive torque that is exponential in joint coordinates, and its derivatives. In NumPy.

Passive torques of human joints are small in mid-range and rise steeply at its ends, and biarticular muscles couple
joints. Riener and Edrich (J Biomech 32, 1999) model both by sums of

    tau_i = amplitude exp(constant + sum_j slope_j q_j),

a constant torque if there are no slopes. MJCF has no such element: a replay adds it to MuJoCo's passive forces
(planner.proof.replays.passive_torque_callback).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from planner.base.arguments import count, number, set_fields, short_repr
from planner.base.errors import PlannerError

LARGEST = 700.0  # magnitude at which the exponent is clipped: exp overflows above 709


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


def curve_torque_derivatives(mechanism: Any, q: np.ndarray) -> np.ndarray:
    """Exact derivative (..., nv, nv) of exponential_joint_torques with respect to q (tangent space)."""
    by_q = np.zeros((*np.shape(q)[:-1], mechanism.nv, mechanism.nv))
    for curve in mechanism.curves:
        torque = one_torque(curve, mechanism.q_address, q)
        for j, slope in curve.slopes:
            by_q[..., curve.dof, j] += slope * torque
    return by_q
