"""ExponentialTorque: a joint's passive torque that grows like an exponential, and its derivatives. In NumPy.

Passive joints of living bodies hardly resist in the middle of their range and steeply at its ends, and muscles that
span two joints couple them. Riener and Edrich (J Biomech 32, 1999) describe both by sums of

    tau_i = amplitude exp(constant + sum_j slope_j q_j),

of which a constant torque is the one without slopes. MJCF has no such spring: a replay adds it to MuJoCo's passive
forces (planner.proof.replays.passive_torque_callback).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from planner.base.arguments import count, number, set_fields, short_repr
from planner.base.errors import PlannerError

LARGEST = 700.0  # an exponent beyond which a torque grows no further: e^709 is the last finite number


@dataclass(frozen=True)
class ExponentialTorque:
    """A torque (of a slide, a force) that is an exponential of hinges' and slides' coordinates.

    Attributes:
        dof: The degree of freedom it acts on.
        amplitude: N m or N, with its sign.
        constant: Of the exponent.
        slopes: Degree of freedom -> per rad or m; given as a mapping or as pairs, kept as pairs in order.
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
        """Its degree of freedom and those that it depends on."""
        return (self.dof, *(j for j, _ in self.slopes))

    def to_list(self) -> list[Any]:
        """JSON values: ExponentialTorque(*torque.to_list()) == torque."""
        return [self.dof, self.amplitude, self.constant, [list(pair) for pair in self.slopes]]


def check_curve(curve: Any, turning: np.ndarray, name: str) -> None:
    """Raise a PlannerError unless a torque acts on hinges and slides of a machine, `turning` (nv,) bool, alone."""
    if not isinstance(curve, ExponentialTorque):
        raise PlannerError(f"{name} is {short_repr(curve)}, expected an ExponentialTorque.")
    for dof in curve.dofs:
        if not (dof < len(turning) and turning[dof]):
            raise PlannerError(f"{name} is of dof {dof}, expected those of hinges or slides, below {len(turning)}.")


def one_torque(curve: ExponentialTorque, address: Sequence[int] | np.ndarray, q: np.ndarray) -> np.ndarray:
    """The torque (...) of one curve at q (..., nq), whose coordinates lie at `address` (nv,)."""
    exponent = np.full(np.shape(q)[:-1], curve.constant)
    for j, slope in curve.slopes:
        exponent = exponent + slope * q[..., address[j]]
    return curve.amplitude * np.exp(np.clip(exponent, -LARGEST, LARGEST))


def exponential_joint_torques(mechanism: Any, q: np.ndarray) -> np.ndarray:
    """The applied force tau (..., nv) of all curves of a mechanism at q (..., nq)."""
    tau = np.zeros((*np.shape(q)[:-1], mechanism.nv))
    for curve in mechanism.curves:
        tau[..., curve.dof] += one_torque(curve, mechanism.q_address, q)
    return tau


def curve_torque_derivatives(mechanism: Any, q: np.ndarray) -> np.ndarray:
    """Derivative (..., nv, nv) of exponential_joint_torques by q (in the tangent), exact."""
    by_q = np.zeros((*np.shape(q)[:-1], mechanism.nv, mechanism.nv))
    for curve in mechanism.curves:
        torque = one_torque(curve, mechanism.q_address, q)
        for j, slope in curve.slopes:
            by_q[..., curve.dof, j] += slope * torque
    return by_q
