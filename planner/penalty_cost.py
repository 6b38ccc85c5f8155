"""PenaltyCost: what points, distances and gaps of a machine should be, as least squares over the stages.

    J = sum_n dt weight_n 1/2 r_n^2  over the stages,  + final_weight 1/2 r_N^2 at the end

for each term of planner.penalty_terms, r its residual. The Hessian is that of Gauss and Newton, J'J. Heights and gaps
are n'p - level; distances |d| - radii, with d from the nearest point of one line to that of the other. Since those
are nearest, that they move along the lines does not change |d| to first order: the derivative is that of two fixed
points, which share the motion of the ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np

from planner.arguments import LONGEST_HORIZON, count, shown
from planner.cost import Quadratic, Term, mechanism_of
from planner.errors import PlannerError
from planner.kernels.penalty_table import HEIGHT, PARALLEL, TINY
from planner.penalty_measures import Measures, measures_of, spaced
from planner.rigid_body import points_of


class PenaltyCost(Term):
    """Penalties of heights, distances and gaps; one term of a cost: TrackingCost(...) + PenaltyCost(...).

    With RigidBodyDynamics and one TrackingCost in the sum it is part of the compiled solver.

    Args:
        machine: RigidBodyDynamics or a Mechanism.
        horizon: N, number of stages.
        terms: Height, Distance and Gap.
        dt: s; that of the dynamics by default.

    Attributes:
        names: (T,) of the terms, for a reader.

    Raises:
        PlannerError: No such frame or contact, something per stage of another length than N+1, or what is no term.
    """

    def __init__(self, machine: Any, horizon: int, terms: Sequence[Any], dt: float | None = None) -> None:
        self.mechanism, dt = mechanism_of(machine, dt)
        self.N = count("horizon", horizon, most=LONGEST_HORIZON)
        self.space = self.mechanism.space
        self.nx, self.ndx = self.space.nx, self.space.ndx
        if not isinstance(terms, Sequence):
            raise PlannerError(f"terms is {shown(terms)}, expected a list of Height, Distance and Gap.")
        self.names = tuple(str(term) for term in terms)
        self.measures = measures_of(self.mechanism, self.N, terms, dt)

    def values(self, xs: np.ndarray) -> np.ndarray:
        """(N+1, T) m, what the terms measure along xs (N+1, nx), also where they are off."""
        places, _ = self._places(xs, moving=False)
        values = np.empty((len(xs), len(self.names)))
        for t in range(len(self.names)):
            values[:, t] = _measured(self.measures, t, places).value
        return values

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        if not np.isfinite(xs).all():  # a candidate that ran away: there is no pose
            return float("inf")
        residuals, _ = _ramped(self.measures, self.values(xs).T)
        return 0.5 * float(np.sum(self.measures.weight * residuals**2))

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """Gradient and Gauss-Newton Hessian; nothing of the control."""
        (N, nu), nv, m = us.shape, self.mechanism.nv, self.measures
        model = Quadratic(
            np.zeros((N + 1, self.ndx, self.ndx)), np.zeros((N + 1, self.ndx)), np.zeros((N, nu, nu)), np.zeros((N, nu))
        )
        places, J = self._places(xs, moving=True)
        measured = [_measured(m, t, places) for t in range(len(self.names))]
        residuals, slopes = _ramped(m, np.array([one.value for one in measured]).reshape(-1, N + 1))
        for t, one in enumerate(measured):
            row = np.zeros((N + 1, nv))  # the derivative of the value
            for point, factor in zip(one.points, one.factors, strict=True):
                row += factor[:, None] * np.einsum("na,nai->ni", one.direction, J[:, point])
            row *= slopes[t][:, None]  # of the residual
            weighted = m.weight[t][:, None] * row
            model.q[:, :nv] += weighted * residuals[t][:, None]
            model.Q[:, :nv, :nv] += weighted[:, :, None] * row[:, None]
        return model

    def spaced(self, ratio: float, parts: int = 1) -> PenaltyCost:
        """The same over stages divided into parts, with the weights on the way multiplied by ratio."""
        cost = copy(self)
        cost.N, cost.measures = parts * self.N, spaced(self.measures, ratio, parts)
        return cost

    def _places(self, xs: np.ndarray, moving: bool) -> tuple[np.ndarray, np.ndarray]:
        """(N+1, P, 3) of the points, and their derivatives (N+1, P, 3, nv)."""
        m = self.measures
        places, J = points_of(self.mechanism, xs[:, : self.mechanism.nq], m.link, m.offset, moving=moving)
        return m.share[:, None] * places + np.swapaxes(m.world, 0, 1), m.share[:, None, None] * J if moving else J


class _Measured(NamedTuple):
    """A term's value (N+1,), and its derivative: the direction (N+1, 3) times each point's factor (N+1,)."""

    value: np.ndarray
    direction: np.ndarray
    points: tuple[int, ...]
    factors: tuple[np.ndarray, ...]


def _measured(m: Measures, t: int, places: np.ndarray) -> _Measured:
    """Term t for points at places (N+1, P, 3)."""
    if m.kind[t] == HEIGHT:
        point, n = int(m.ends[t, 0]), m.normal[t]
        K = len(places)
        return _Measured(places[:, point] @ n - m.level[t], np.tile(n, (K, 1)), (point,), (np.ones(K),))
    i, j, k, l = (int(end) for end in m.ends[t])
    d, s, u = nearest(places[:, i], places[:, j], places[:, k], places[:, l])
    length = np.sqrt(np.sum(d * d, axis=-1) + TINY)
    return _Measured(length - m.level[t], d / length[:, None], (i, j, k, l), (1.0 - s, s, u - 1.0, -u))


def _ramped(m: Measures, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (T, N+1) times the tolerance, and their derivatives by the values (T, N+1)."""
    side, a = m.side[:, None], m.ramp[:, None]
    e = np.where(side == 0.0, 1.0, side) * (values - m.bound)
    slope = np.clip(e / a, 0.0, 1.0)
    residual = slope * (e - 0.5 * a * slope)
    return np.where(side == 0.0, e, residual), np.where(side == 0.0, 1.0, side * slope)


def nearest(
    a0: np.ndarray, a1: np.ndarray, b0: np.ndarray, b1: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns d (..., 3) from the nearest point of b to that of a, and where: a0 + s (a1 - a0), b0 + u (b1 - b0).

    The nearest points of the whole lines, then each in turn put back onto its segment: exact, since the squared
    distance is convex in (s, u) (Ericson, Real-Time Collision Detection, section 5.1.9).

    Args:
        a0: (..., 3) one end of the first.
        a1: (..., 3) the other, which may be the same.
        b0: (..., 3).
        b1: (..., 3).
    """
    v, w, r = a1 - a0, b1 - b0, a0 - b0
    vv, ww, vw = (np.sum(x * y, axis=-1) for x, y in ((v, v), (w, w), (v, w)))
    vr, wr = np.sum(v * r, axis=-1), np.sum(w * r, axis=-1)
    pull = PARALLEL * vv * ww
    s = np.clip((vw * wr - vr * ww + 0.5 * pull) / (vv * ww - vw * vw + pull + TINY), 0.0, 1.0)
    u = np.clip((vw * s + wr) / (ww + TINY), 0.0, 1.0)
    s = np.clip((vw * u - vr) / (vv + TINY), 0.0, 1.0)
    return r + s[..., None] * v - u[..., None] * w, s, u
