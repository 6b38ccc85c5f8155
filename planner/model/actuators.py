"""The actuators of a mechanism: motors, servos, thrusters and the like. Data only.

Actuator a exerts the force gain u + bias[0] + bias[1] length + bias[2] (d length/dt), times moment[a] as generalized
forces. u is the control or, for an actuator with an activation state, the activation: d act/dt = u (INTEGRATOR) or
(u - act) / time_constant (FILTER); length = moment[a] q over the hinge and slide joints.

An actuator may have a force law beside that, a force that is added to it (planner.kernels.force_laws).

The moment of an actuator at a site (a thruster), or of one in the axes of a ball's parent, depends on the pose: it is
that of its `wrenches`, in place of a row of `moment`, and its force is gain u + bias[0] alone.
`planner.dynamics.joint_forces` gives all moments at a pose, and all forces with their derivatives at a state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

DIRECT, INTEGRATOR, FILTER = 0, 1, 2


@dataclass(frozen=True, eq=False)
class ActuatorWrench:
    """What an actuator does to one link, per unit of its force; a refsite feels a second one, opposite."""

    actuator: int  # index
    link: int  # that it acts on
    place: np.ndarray  # (3,) where the force acts, in the link's frame, m
    frame: int  # link in whose axes force and torque are constant, -1 for the world
    force: np.ndarray  # (3,) along the axes of `frame`
    torque: np.ndarray  # (3,) along the axes of `frame`, m
    dofs: np.ndarray  # indices of the degrees of freedom that feel it, ascending
    frame_dofs: np.ndarray  # of those that turn `frame` alone, ascending; none where the frame is the link


@dataclass(frozen=True)
class ForceLaw:
    """What one actuator exerts beside gain u + bias: a function of u, length and length rate, affine in u."""

    actuator: int  # index
    kind: str  # in planner.kernels.force_laws.LAWS
    numbers: tuple[float, ...]  # its constants, at most LAW_SIZE


@dataclass(frozen=True, eq=False)
class Actuators:
    """The nu actuators of a mechanism. Ranges are data only, infinite if unlimited."""

    names: tuple[str, ...]  # (nu,) "" if unnamed in the file
    moment: np.ndarray  # (nu, nv) generalized force per actuator force; 0 for those with wrenches
    gain: np.ndarray  # (nu,)
    bias: np.ndarray  # (nu, 3) coefficients of 1, length, d length/dt
    dynamics: np.ndarray  # (nu,) DIRECT, INTEGRATOR or FILTER
    activation: np.ndarray  # (nu,) index into act, -1 for DIRECT
    time_constant: np.ndarray  # (nu,) s, for FILTER only
    control_range: np.ndarray  # (nu, 2)
    force_range: np.ndarray  # (nu, 2)
    activation_range: np.ndarray  # (nu, 2)
    wrenches: tuple[ActuatorWrench, ...] = ()
    laws: tuple[ForceLaw, ...] = ()

    @property
    def nu(self) -> int:
        """Number of actuators."""
        return len(self.names)

    @property
    def na(self) -> int:
        """Number of activations."""
        return int(np.sum(self.dynamics != DIRECT))

    @property
    def by_wrenches(self) -> np.ndarray:
        """(nu,) bool, whether the moment depends on the pose."""
        return np.isin(np.arange(self.nu), [one.actuator for one in self.wrenches])

    @property
    def by_law(self) -> np.ndarray:
        """(nu,) bool, whether the force has a law beside gain u + bias."""
        return np.isin(np.arange(self.nu), [one.actuator for one in self.laws])

    @property
    def depends_on_state(self) -> np.ndarray:
        """(nu,) bool, whether the force depends on length or length rate: servos, dampers and the like."""
        return np.any(self.bias[:, 1:] != 0.0, axis=1) | self.by_law

    @property
    def pushes(self) -> np.ndarray:
        """(nu,) bool, whether the input changes the force, in some state."""
        return (self.gain != 0.0) | self.by_law

    @property
    def acts_on(self) -> np.ndarray:
        """(nu, nv) bool, the degrees of freedom that each actuator acts on, in some pose."""
        acts = self.moment != 0.0
        for one in self.wrenches:
            acts[one.actuator, one.dofs] = True
        return acts
