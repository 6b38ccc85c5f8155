"""f, L and phi of a Problem whose cost changes on the way, for Eq. 1 to 4 and 7: the human step's (section 2.3).

The state is z = (x, t): with time a state the methods of adjoint.py need no more. The costs of stages, which hold the
factor dt, are divided by it and interpolated between knots:

    L(x, u, t) = ((1 - s) l_n(x, u) + s l_n+1(x, u)) / dt        n + s = t / dt

No control moves time, so the costate of time adds nothing to the gradient: it is left zero.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from planner.base.errors import PlannerError
from planner.control.window_parts import at_stages, parts_of
from planner.kernels.numba.lanes import padded
from planner.paper.methods.adjoint import ContinuousDynamics, Partials
from planner.problem.costs.least_squares import ResidualCost
from planner.problem.costs.terms import SumCost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.problem import Problem
from planner.solvers.engine import acquire_engine
from planner.solvers.engine.compiled import CompiledEngine


class TimedProblem:
    """A System (see adjoint.py) of a Problem with a TrackingCost and compiled residuals, which may change on the way.

    Raises:
        PlannerError: Terms of another kind, or states with quaternions.
    """

    orders = 1  # the control alone is the input, without derivatives

    def __init__(self, problem: Problem) -> None:
        self.f, self._dt, self._N = ContinuousDynamics(problem.dynamics), problem.dynamics.dt, problem.N
        self.nx, self.inputs = self.f.nx, self.f.nu
        self.nz, self.z0 = self.nx + 1, np.append(problem.x0, 0.0)
        self._engines = [_engine(problem, n) for n in range(problem.N)]
        zero = np.zeros((1, self.inputs, self.nx))  # no gains: a start that checks nothing, which thousands are
        self._held = np.zeros((2, self.nx)), np.zeros((1, self.inputs)), zero
        self._end = _one_stage(problem, problem.N - 1, at_end=True)

    def _costs(self, z: np.ndarray, u: np.ndarray) -> list[tuple[CompiledEngine, float, float]]:
        """The engines of both stages about a time, with their shares over dt and their costs at x, u."""
        at = min(z[-1] / self._dt, self._N - 1.0)
        n = min(int(at), self._N - 2) if self._N > 1 else 0
        found = []
        for engine, share in ((self._engines[n], n + 1.0 - at), (self._engines[min(n + 1, self._N - 1)], at - n)):
            self._held[1][0] = u
            found.append((engine, share / self._dt, engine.start_from_trajectory(z[:-1], self._held)))
        return found

    def rates(self, z: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, float]:
        """dz/dt (nz,) and L."""
        return np.append(self.f(z[:-1], w), 1.0), sum(share * cost for _, share, cost in self._costs(z, w))

    def partials(self, z: np.ndarray, w: np.ndarray) -> Partials:
        """Derivatives of both, those by time left zero."""
        L_z, L_w = np.zeros(self.nz), np.zeros(self.inputs)
        f_z, f_w = np.zeros((self.nz, self.nz)), np.zeros((self.nz, self.inputs))
        first = padded(self.inputs)
        f_z[:-1, :-1], f_w[:-1] = self.f.partials(z[:-1], w)
        for engine, share, _ in self._costs(z, w):
            engine.compute_direction(0.0, relinearize=True)
            by = engine.cost_arrays()["l"]  # (L_u | L_x), each padded, then those of the end
            L_w += share * by[: self.inputs]
            L_z[:-1] += share * by[first : first + self.nx]
        return Partials(f_z, f_w, L_z, L_w)

    def final(self, z: np.ndarray, w: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Phi, and its derivatives by z (nz,) and by u, which are zero."""
        xs, us = np.stack([z[:-1], z[:-1]]), np.zeros((1, self.inputs))
        phi_z = sum(term.quadratize(xs, us).q[1] for term in self._end)
        return sum(term.final_cost(z[:-1]) for term in self._end), np.append(phi_z, 0.0), np.zeros(len(w))


def _engine(problem: Problem, n: int) -> CompiledEngine:
    """An engine of stage n alone, whose end costs nothing."""
    cost, us = SumCost(*_one_stage(problem, n, at_end=False)), np.zeros((1, problem.dynamics.nu))
    engine = acquire_engine(Problem(problem.dynamics, cost, problem.x0, us))
    if not isinstance(engine, CompiledEngine):
        raise PlannerError(f"the dynamics is a {type(problem.dynamics).__name__}, expected compiled ones.")
    if n == 0:
        engine.start_from_controls(problem.x0, us)  # which compiles what is not
    return engine


def _one_stage(problem: Problem, n: int, at_end: bool) -> list[TrackingCost | ResidualCost]:
    """The cost of stage n without that of the next knot, or the other way round."""
    tracking, residuals, python = parts_of(problem)
    if python:
        raise PlannerError(f"the cost has a {type(python[0]).__name__}, expected a TrackingCost and compiled terms.")
    keep = np.array([not at_end, at_end], dtype=float)
    alone = TrackingCost(
        keep[:, None, None] * tracking.Q[n : n + 2], tracking.R[n : n + 1],
        tracking.x_ref[n : n + 2], tracking.u_ref[n : n + 1],
    )  # fmt: skip
    parts: list[TrackingCost | ResidualCost] = [alone]
    for term in residuals:
        arrays = at_stages(term.residual_arrays_for(problem.N), slice(n, n + 2))
        parts.append(ResidualCost(term.mechanism, replace(arrays, weight=keep * arrays.weight), 1))
    return parts
