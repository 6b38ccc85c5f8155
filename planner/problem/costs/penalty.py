"""PenaltyCost: least squares of heights, distances, gaps and velocities of a machine over the stages.

    J = sum_n dt weight_n 1/2 r_n^2  over the stages,  + final_weight 1/2 r_N^2 at the end

for each term of problem.costs.penalty_terms, r its residual. Gauss-Newton Hessian J'J. Heights and gaps
are n'p - level; distances |d| - radii, with d from the nearest point of one line to that of the other. Since those
are nearest, that they move along the lines does not change |d| to first order: the derivative is that of two fixed
points, which share the motion of the ends. Velocities are d'(V_1 - V_2), with the velocities V of points that are
fixed to their links.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import LONGEST_HORIZON, count, shown
from planner.base.errors import PlannerError
from planner.dynamics.contacts import ramp
from planner.dynamics.kinematics import jacobian_derivatives, points_of
from planner.kernels.tree.penalty_table import HEIGHT, PARALLEL, TINY, VELOCITY
from planner.model.coordinates import Coordinate
from planner.model.mechanism import Frame
from planner.problem.costs.penalty_measures import PenaltyArrays, measures_of, resampled
from planner.problem.costs.terms import Quadratic, Term
from planner.problem.costs.tracking import mechanism_and_step
from planner.problem.costs.wanted import Wanted


class PenaltyCost(Term):
    """Penalties of heights, distances, gaps and velocities; one term of a cost: TrackingCost(...) + PenaltyCost(...).

    With RigidBodyDynamics and one TrackingCost in the sum it is part of the compiled solver.

    Args:
        machine: RigidBodyDynamics or a Mechanism.
        horizon: N, number of stages.
        terms: Height, Distance, Gap and Velocity.
        dt: s; that of the dynamics by default.

    Attributes:
        names: (T,) of the terms, for a reader.

    Raises:
        PlannerError: No such frame or contact, something per stage of another length than N+1, or what is no term.
    """

    def __init__(self, machine: Any, horizon: int, terms: Sequence[Any], dt: float | None = None) -> None:
        self.mechanism, dt = mechanism_and_step(machine, dt)
        self.N = count("horizon", horizon, most=LONGEST_HORIZON)
        self.space = self.mechanism.space
        self.nx, self.ndx = self.space.nx, self.space.ndx
        if not isinstance(terms, Sequence):
            raise PlannerError(f"terms is {shown(terms)}, expected a list of Height, Distance, Gap and Velocity.")
        self.names = tuple(str(term) for term in terms)
        # (T,) whether a term asks something of the end; without a final weight of its own it only goes on until there
        self._asked = [getattr(term, "final_weight", None) is not None for term in terms]
        self.measures = measures_of(self.mechanism, self.N, terms, dt)

    def values(self, xs: np.ndarray) -> np.ndarray:
        """(N+1, T) m or m/s, the values of the terms along xs (N+1, nx), also where they are off."""
        fast = self._fast
        places, J = self._places(xs, moving=bool(fast.size))
        velocities = self._velocities(xs, J) if fast.size else places
        values = np.empty((len(xs), len(self.names)))
        for t in range(len(self.names)):
            values[:, t] = _measured(self.measures, t, velocities if t in fast else places).value
        return values

    def wanted(self, _: Sequence[Coordinate]) -> tuple[Wanted, ...]:
        """The terms with a final weight of their own."""
        weighed = np.flatnonzero(np.logical_and(self._asked, self.measures.weight[:, -1] > 0.0))
        units = ["m/s" if kind == VELOCITY else "m" for kind in self.measures.kind]
        return tuple(Wanted(self.names[t], units[t], partial(self._missed, t)) for t in weighed.tolist())

    def _missed(self, t: int, xs: np.ndarray) -> np.ndarray:
        return np.abs(self._at_end(xs)[t])

    def final_cost(self, x: np.ndarray) -> float:
        """The part of the value that the end x (nx,) has."""
        return 0.5 * float(self.measures.weight[:, -1] @ self._at_end(x[None])[:, 0] ** 2)

    def _at_end(self, xs: np.ndarray) -> np.ndarray:
        """(T, K) residuals of states (K, nx), each as the end."""
        last, m = copy(self), self.measures
        last.measures = replace(m, world=m.world[:, -1:], bound=m.bound[:, -1:], weight=m.weight[:, -1:])
        return _ramped(last.measures, last.values(xs).T)[0]

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        if not np.isfinite(xs).all():  # a candidate that ran away: there is no pose
            return float("inf")
        residuals, _ = _ramped(self.measures, self.values(xs).T)
        return 0.5 * float(np.sum(self.measures.weight * residuals**2))

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Gradient and Gauss-Newton Hessian; nothing of the control."""
        (N, nu), m, fast = us.shape, self.measures, self._fast
        model = Quadratic(
            np.zeros((N + 1, self.ndx, self.ndx)), np.zeros((N + 1, self.ndx)), np.zeros((N, nu, nu)), np.zeros((N, nu))
        )
        places, J = self._places(xs, moving=True)
        velocities = self._velocities(xs, J) if fast.size else places
        by_state = np.concatenate([self._turning(xs), J], axis=3) if fast.size else J
        measured = [_measured(m, t, velocities if t in fast else places) for t in range(len(self.names))]
        residuals, slopes = _ramped(m, np.array([one.value for one in measured]).reshape(-1, N + 1))
        for t, one in enumerate(measured):
            moves = by_state if t in fast else J
            row = np.zeros((N + 1, moves.shape[3]))  # the derivative of the value
            for point, factor in zip(one.points, one.factors, strict=True):
                row += factor[:, None] * np.einsum("na,nai->ni", one.direction, moves[:, point])
            row *= slopes[t][:, None]  # of the residual
            weighted, n = m.weight[t][:, None] * row, moves.shape[3]
            model.q[:, :n] += weighted * residuals[t][:, None]
            model.Q[:, :n, :n] += weighted[:, :, None] * row[:, None]
        return model

    def resampled(self, parts: int, ratio: float) -> PenaltyCost:
        """The same over stages divided into parts, with the weights on the way multiplied by ratio."""
        cost = copy(self)
        cost.N, cost.measures = parts * self.N, resampled(self.measures, parts, ratio)
        return cost

    def _places(self, xs: np.ndarray, moving: bool) -> tuple[np.ndarray, np.ndarray]:
        """Places (N+1, P, 3) of the points, and their derivatives (N+1, P, 3, nv)."""
        m = self.measures
        places, J = points_of(self.mechanism, xs[:, : self.mechanism.nq], m.link, m.offset, moving=moving)
        return m.share[:, None] * places + np.swapaxes(m.world, 0, 1), m.share[:, None, None] * J if moving else J

    @property
    def _fast(self) -> np.ndarray:
        """The terms that are velocities."""
        return np.flatnonzero(self.measures.kind == VELOCITY)

    def _velocities(self, xs: np.ndarray, J: np.ndarray) -> np.ndarray:
        """(N+1, P, 3) m/s of the points, by their Jacobians."""
        nq = self.mechanism.nq
        return np.einsum("npai,ni->npa", J, xs[:, nq : nq + self.mechanism.nv])

    def _turning(self, xs: np.ndarray) -> np.ndarray:
        """Derivatives (N+1, P, 3, nv) of the velocities by the configuration, of points that velocities are of."""
        m, nq, nv = self.measures, self.mechanism.nq, self.mechanism.nv
        D = np.zeros((len(xs), len(m.link), 3, nv))
        for p in np.unique(m.ends[self._fast, :2]):
            T = np.eye(4)
            T[:3, 3] = m.offset[p]
            by_q = jacobian_derivatives(self.mechanism, xs[:, :nq], Frame(int(m.link[p]), T))[:, :3]
            D[:, p] = m.share[p] * np.einsum("najk,nj->nak", by_q, xs[:, nq : nq + nv])
        return D


class _Measured(NamedTuple):
    """A term's value (N+1,), and its derivative: the direction (N+1, 3) times each point's factor (N+1,)."""

    value: np.ndarray
    direction: np.ndarray
    points: tuple[int, ...]
    factors: tuple[np.ndarray, ...]


def _measured(m: PenaltyArrays, t: int, places: np.ndarray) -> _Measured:
    """Term t for points at places (N+1, P, 3), or of a velocity for points that move so."""
    i, j, k, l = (int(end) for end in m.ends[t])
    n, ones = m.normal[t], np.ones(len(places))
    if m.kind[t] == HEIGHT:
        return _Measured(places[:, i] @ n - m.level[t], np.tile(n, (len(places), 1)), (i,), (ones,))
    if m.kind[t] == VELOCITY:
        return _Measured((places[:, i] - places[:, j]) @ n, np.tile(n, (len(places), 1)), (i, j), (ones, -ones))
    d, s, u = nearest(places[:, i], places[:, j], places[:, k], places[:, l])
    length = np.sqrt(np.sum(d * d, axis=-1) + TINY)
    return _Measured(length - m.level[t], d / length[:, None], (i, j, k, l), (1.0 - s, s, u - 1.0, -u))


def _ramped(m: PenaltyArrays, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (T, N+1) times the tolerance, and their derivatives by the values (T, N+1)."""
    side, a = m.side[:, None], m.ramp[:, None]
    e = np.where(side == 0.0, 1.0, side) * (values - m.bound)
    residual, slope = ramp(e, a)
    return np.where(side == 0.0, e, residual), np.where(side == 0.0, 1.0, side * slope)


def nearest(
    a0: np.ndarray, a1: np.ndarray, b0: np.ndarray, b1: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns d (..., 3) from the nearest point of b to that of a, and where: a0 + s (a1 - a0), b0 + u (b1 - b0).

    The nearest points of the whole lines, then each in turn put back onto its segment: exact, since the squared
    distance is convex in (s, u) (Ericson, Real-Time Collision Detection, section 5.1.9). The ends (..., 3) of a segment
    may be the same.
    """
    v, w, r = a1 - a0, b1 - b0, a0 - b0
    vv, ww, vw = (np.sum(x * y, axis=-1) for x, y in ((v, v), (w, w), (v, w)))
    vr, wr = np.sum(v * r, axis=-1), np.sum(w * r, axis=-1)
    pull = PARALLEL * vv * ww
    s = np.clip((vw * wr - vr * ww + 0.5 * pull) / (vv * ww - vw * vw + pull + TINY), 0.0, 1.0)
    u = np.clip((vw * s + wr) / (ww + TINY), 0.0, 1.0)
    s = np.clip((vw * u - vr) / (vv + TINY), 0.0, 1.0)
    return r + s[..., None] * v - u[..., None] * w, s, u
