"""The actuators of a mechanism: motors, servos and the like. Data only.

Actuator a exerts the force gain u + bias[0] + bias[1] length + bias[2] (d length/dt), times moment[a] as generalized
forces. u is the control or, for an actuator with an activation state, the activation: d act/dt = u (INTEGRATOR) or
(u - act) / time_constant (FILTER); length = moment[a] q over the hinge and slide joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

DIRECT, INTEGRATOR, FILTER = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Actuators:
    """The nu actuators of a mechanism. Ranges are data only, infinite if unlimited."""

    names: tuple[str, ...]  # (nu,) "" if unnamed in the file
    moment: np.ndarray  # (nu, nv) generalized force per actuator force
    gain: np.ndarray  # (nu,)
    bias: np.ndarray  # (nu, 3) coefficients of 1, length, d length/dt
    dynamics: np.ndarray  # (nu,) DIRECT, INTEGRATOR or FILTER
    activation: np.ndarray  # (nu,) index into act, -1 for DIRECT
    time_constant: np.ndarray  # (nu,) s, for FILTER only
    control_range: np.ndarray  # (nu, 2)
    force_range: np.ndarray  # (nu, 2)
    activation_range: np.ndarray  # (nu, 2)

    @property
    def nu(self) -> int:
        """Number of actuators."""
        return len(self.names)

    @property
    def na(self) -> int:
        """Number of activations."""
        return int(np.sum(self.dynamics != DIRECT))
