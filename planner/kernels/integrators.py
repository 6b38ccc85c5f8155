"""What is known of each integrator: its form, which kernels compute, and the numbers of that form.

An explicit Runge-Kutta method is a row of KNOWN_INTEGRATORS and nothing else. Its stage i begins at the step's start
plus lengths[i-1] h times the rates of the stage before. The end is that start plus h times the weighted mean of all
stages' rates: those of the first and last weigh 1, the others `middle`. On rotations, a method of third or higher order
needs commutators as well (kernels.tree.step).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

INTEGRATORS = ("euler", "semi-implicit-euler", "rk4")
"""Of all dynamics: explicit Euler (the paper's), velocities first then positions with the new ones, classic
Runge-Kutta; the control is held over a stage. Rigid bodies have all of KNOWN_INTEGRATORS."""
EULER, SEMI_IMPLICIT_EULER, RUNGE_KUTTA, ROSENBROCK, LEAPFROG = range(5)
"""Forms of a step; the last two take damping implicitly (kernels.tree.rosenbrock) or as it is in the middle of the step
(kernels.tree.leapfrog)."""
MAX_STAGES = 4
SHARE, MIDDLE, TURNED, END_TURNED, LENGTHS = range(5)
"""Offsets in Integrator.numbers; the lengths are the last, with 0 for the first stage."""


class Integrator(NamedTuple):
    """One integrator.

    One that takes damping implicitly, in a form that does not, is that form with heavier armatures: of first order
    (M + h D) a = forces and v+ = v + h a, with D the damping, h the step (dynamics.rigid_body).
    """

    order: int | None  # of its error in the step; None where nobody knows
    form: int = RUNGE_KUTTA
    evaluations: int = 4  # of the dynamics in a step, for a budget of work; a factorization counts as one
    mujoco: str = ""  # MuJoCo's method that is the same; "" where it has none
    implicit: bool = False  # whether it takes damping implicitly that is too fast for its steps
    finer: str = "rk4"  # the one to take where this is too coarse; itself: shorter stages
    lengths: tuple[float, ...] = ()  # of the stages behind the first, shares of the step
    middle: float = 1.0  # weight of the rates between the first and the last, which weigh 1
    turned: tuple[float, float] = (0.0, 0.0)  # h^2 times it: of v1 x v2 in stage 3, and of v1 x v_last in the end

    @property
    def stages(self) -> int:
        """Evaluations of accelerations in a step."""
        return len(self.lengths) + 1

    @property
    def has_substeps(self) -> bool:
        """Whether a stage may have several steps."""
        return self.form in (RUNGE_KUTTA, ROSENBROCK, LEAPFROG)

    @property
    def weights(self) -> tuple[float, ...]:
        """(stages,) of their rates in the step, which sum to 1."""
        weights = np.full(self.stages, self.middle)
        weights[[0, -1]] = 1.0
        return tuple((weights / weights.sum()).tolist())

    @property
    def numbers(self) -> np.ndarray:
        """What kernels read, by the offsets above."""
        return np.array([self.weights[0], self.middle, *self.turned, 0.0, *self.lengths])


KNOWN_INTEGRATORS = {
    "euler": Integrator(1, EULER, 1),
    "semi-implicit-euler": Integrator(1, SEMI_IMPLICIT_EULER, 1, "EULER"),
    "rk4": Integrator(4, RUNGE_KUTTA, 4, "RK4", lengths=(0.5, 0.5, 1.0), middle=2.0, turned=(1.0 / 8.0, 1.0 / 12.0)),
    "leapfrog": Integrator(1, LEAPFROG, 1),  # of second order where there are no velocity products
    "rosenbrock": Integrator(2, ROSENBROCK, 4, implicit=True, finer="rosenbrock", lengths=(1.0,)),
    "implicitfast": Integrator(1, SEMI_IMPLICIT_EULER, 1, "IMPLICITFAST", implicit=True, finer="rosenbrock"),
}
