"""The integrators' names, and the codes that kernels know them by."""

from __future__ import annotations

INTEGRATORS = ("euler", "semi-implicit-euler", "rk4")
"""explicit Euler (the paper's), velocities first then positions with the new ones, classic Runge-Kutta; the
control is held over a stage."""
TREE_INTEGRATORS = (*INTEGRATORS, "rosenbrock")
"""And, of rigid bodies alone, a method of second order that takes damping implicitly (kernels.tree.rosenbrock)."""
EULER, SEMI_IMPLICIT_EULER, RK4, ROSENBROCK = range(len(TREE_INTEGRATORS))
