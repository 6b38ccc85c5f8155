"""What a controller does when it has no plan: stand still. And the control that keeps a state.

    u = what carries the weight at q, less M(q) qd / TIME,      within the bounds of the problem

so that every speed dies out within TIME where motors reach all joints, and as far as they reach it elsewhere. A machine
that is no mechanism keeps the last control of its plan.
"""

from __future__ import annotations

import numpy as np

from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import mass_matrix
from planner.dynamics.quasi_static import equilibrium, quasi_static_controls
from planner.model.space import space_of
from planner.problem.problem import Problem

TIME = 0.1  # s, in which a speed falls to a third
KEEPS = 1e-3  # of the drift without it: what a control may leave that is said to keep a state
_NEWTON = 3
_KEPT = 1e-9  # in each coordinate's unit, of one stage


class FallbackControl:
    """The control that holds a machine where it is."""

    def __init__(self, problem: Problem) -> None:
        self._problem, self._inverse = problem, np.zeros((0, 0))
        dynamics = problem.dynamics
        self._mechanism = dynamics.mechanism if isinstance(dynamics, RigidBodyDynamics) else None
        if self._mechanism is not None and not getattr(dynamics, "prescribed", ()):
            actuators = self._mechanism.actuators
            self._inverse = np.linalg.pinv((actuators.gain[:, None] * actuators.moment).T)

    @property
    def known(self) -> bool:
        """Whether gravity compensation and damping are known of the machine."""
        return bool(self._inverse.size)

    def __call__(self, x: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
        """The control (nu,) at a state x (nx,), before bounds; `otherwise` for a machine that is no mechanism."""
        m = self._mechanism
        if m is None or not self.known:
            return otherwise
        qd, actuators = x[m.nq : m.nq + m.nv], m.actuators
        servo = actuators.moment.T @ (actuators.bias[:, 2] * (actuators.moment @ qd))
        damping = mass_matrix(m, x[: m.nq]) @ qd / TIME
        return quasi_static_controls(m, x, contacts=False) - self._inverse @ (damping + servo)


def equilibrium_control(problem: Problem, x: np.ndarray, u: np.ndarray) -> np.ndarray | None:
    """The control (nu,) that keeps a state x (nx,), sought from u; None where there is none within the bounds."""
    dynamics, space = problem.dynamics, space_of(problem.dynamics)
    first = space.difference(dynamics.step(x[None], np.zeros((1, dynamics.nu)))[0], x)
    _, u = equilibrium(dynamics, x, u, iterations=_NEWTON, tolerance=_KEPT)
    if problem.bounds is not None:
        u = problem.bounds.clip(-1, u, x)
    left = space.difference(dynamics.step(x[None], u[None])[0], x)
    kept = np.isfinite(left).all() and np.abs(left).max() <= KEEPS * np.abs(first).max() + 1e-9
    return u if kept else None
