"""Forces that another engine is given, since it does not read them: actuators, springs, dampers, tendons, curves.

They are those of the mechanism that MuJoCo's compiler makes of the same text.
"""

from __future__ import annotations

import numpy as np

from planner.model.actuators import DIRECT, INTEGRATOR
from planner.model.exponential_torques import exponential_joint_torques
from planner.model.mechanism import SCREW, Mechanism
from planner.model.space import conjugate, log_quaternion, product
from planner.model.tendons import tendon_forces


class Applied:
    """The forces tau(q, v, act, u) on the joints of a mechanism, and the rates of its activations."""

    def __init__(self, mechanism: Mechanism, damping: np.ndarray) -> None:
        """For an engine that has the mechanism's inertia and gravity; `damping` (nv,) is what it lacks."""
        self._mechanism, self._damping = mechanism, damping
        self._screws = mechanism.kind == SCREW
        actuators = mechanism.actuators
        self._states = np.flatnonzero(actuators.dynamics != DIRECT)
        self._places = actuators.activation[self._states]
        self._integrates = actuators.dynamics[self._states] == INTEGRATOR

    def __call__(self, q: np.ndarray, v: np.ndarray, act: np.ndarray, u: np.ndarray) -> np.ndarray:
        """The forces tau (nv,) at one state with the controls u (nu,)."""
        m, actuators = self._mechanism, self._mechanism.actuators
        place = np.where(self._screws, q[m.q_address], 0.0)
        given = np.array(u, dtype=float)
        given[self._states] = act[self._places]
        length, rate = actuators.moment @ place, actuators.moment @ v
        force = actuators.gain * given + actuators.bias[:, 0] + actuators.bias[:, 1] * length
        tau = actuators.moment.T @ (force + actuators.bias[:, 2] * rate)
        tau -= self._damping * v + m.stiffness * (place - np.where(self._screws, m.spring_rest, 0.0))
        for (address, dof), stiffness, rest in zip(m.quaternions, m.ball_stiffness, m.ball_rest, strict=True):
            turned = log_quaternion(product(conjugate(rest), q[address : address + 4]))
            tau[dof : dof + 3] -= stiffness * turned
        tau = tau + tendon_forces(m, q, v) if m.tendons else tau
        return tau + exponential_joint_torques(m, q) if m.curves else tau

    def activation_rates(self, act: np.ndarray, u: np.ndarray) -> np.ndarray:
        """The rates (na,) of the activations."""
        rates, given = np.zeros(len(act)), u[self._states]
        constant = self._mechanism.actuators.time_constant[self._states]
        rates[self._places] = np.where(self._integrates, given, (given - act[self._places]) / constant)
        return rates

    def phrases(self) -> list[str]:
        """What is added, a phrase for each kind."""
        m = self._mechanism
        springs = m.stiffness != 0.0
        for (_, dof), stiffness in zip(m.quaternions, m.ball_stiffness, strict=True):
            springs[dof : dof + 3] = stiffness != 0.0
        curved = np.isin(np.arange(m.nv), [curve.dof for curve in m.curves])
        pulled = np.isin(np.arange(m.nv), [dof for tendon in m.tendons if tendon.acts for dof in tendon.dofs])
        kinds = {
            "springs": springs, "damping": self._damping != 0.0, "tendons": pulled, "exponential torques": curved,
        }  # fmt: skip
        found = [f"{kind} of {joints_with(m, on)}" for kind, on in kinds.items() if np.any(on)]
        names = [name or f"actuator {i}" for i, name in enumerate(m.actuators.names)]
        return [f"forces of the actuators {', '.join(names)}", *found] if names else found


def joints_with(mechanism: Mechanism, dofs: np.ndarray) -> str:
    """The names of the joints of some degrees of freedom, (nv,) bool."""
    pairs = zip(mechanism.joint_names, mechanism.joint_links, strict=True)
    return ", ".join(name or f"joint {j}" for j, (name, own) in enumerate(pairs) if np.any(dofs[own]))
