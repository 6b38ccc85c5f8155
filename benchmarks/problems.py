"""The problems, their targets and the judge: NumPy only, so that any peer's interpreter can import it.

The paper's case 4 (section 2.4): a mass on a pneumatic leg, x = (height y, its rate v, piston p), u = dp/dt.

    minimize  q_fin/2 (y(N) - Y)^2 + v(N)^2 + sum dt/2 (q p(n)^2 + r u(n)^2)      Eq. 8
    subject to  y+ = y + dt v,  v+ = v + dt (F(p - y)/m - g),  p+ = p + dt u       explicit Euler

The judge rolls out whatever controls a solver returns, in these equations and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# The environment of every measured process: libraries read it when they are imported.
SINGLE_THREAD = {
    "PLANNER_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1", "JAX_PLATFORMS": "cpu",
}  # fmt: skip

# A solver stops when its model promises less than this, or at its own tolerance below; 1e-10 of the costs here.
DECREASE = 1e-7
TOLERANCE = 1e-8
MAX_ITERATIONS = 1000

# Relative excess over the best true cost beyond which a solver did not finish, and between a solver's own cost
# and the judge's beyond which its states are not the rollout of its controls.
EARLY = 1e-4
DIFFERS = 1e-6


@dataclass(frozen=True)
class Hopper:
    """Numbers of one hop, in the paper's units (inch and second, forces per mass)."""

    height: float
    N: int = 50
    duration: float = 1.0
    stiffness: float = 100.0  # k/m
    gravity: float = 386.4
    smoothing: float = 0.1  # alpha
    piston_weight: float = 1000.0  # q
    flow_weight: float = 1.0  # r
    final_weight: float = 1000.0  # q_fin

    @property
    def dt(self) -> float:
        """Length of a stage, s."""
        return self.duration / self.N

    def spring(self, e: float) -> tuple[float, float]:
        """Force per mass of the C1 spring at a compression e, and its slope."""
        if e <= 0.0:
            return 0.0, 0.0
        if e < self.smoothing:
            return 0.5 * self.stiffness / self.smoothing * e * e, self.stiffness / self.smoothing * e
        return self.stiffness * (e - 0.5 * self.smoothing), self.stiffness


@dataclass(frozen=True)
class Target:
    """What our solver is held to."""

    ms: float
    cost: float


PROBLEMS = {"hopper_1": Hopper(1.0), "hopper_20": Hopper(20.0), "hopper_50": Hopper(50.0)}
TARGETS = {
    "hopper_1": Target(0.3, 841.34),
    "hopper_20": Target(0.15, 2016.15),
    "hopper_50": Target(1.5, 2755.0),
}


def judge(hopper: Hopper, us: np.ndarray) -> float:
    """True cost of controls us (N,): the states are what the controls make of them."""
    y = v = p = J = 0.0
    dt = hopper.dt
    for u in np.asarray(us, dtype=float).reshape(hopper.N).tolist():
        J += 0.5 * dt * (hopper.piston_weight * p * p + hopper.flow_weight * u * u)
        force, _ = hopper.spring(p - y)
        y, v, p = y + dt * v, v + dt * (force - hopper.gravity), p + dt * u
    return J + 0.5 * hopper.final_weight * (y - hopper.height) ** 2 + v * v


def remarks(converged: bool, own_cost: float, true_cost: float, best: float) -> list[str]:
    """What a reader must know before comparing a solver's time."""
    notes = []
    if not converged:
        notes.append("not converged")
    if not abs(own_cost - true_cost) <= DIFFERS * max(1.0, abs(true_cost)):
        notes.append(f"own cost {own_cost:.2f} is not its rollout's")
    if not true_cost <= best + EARLY * abs(best):
        notes.append("stops early")
    return notes
