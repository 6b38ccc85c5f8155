"""Clamped B-splines over uniform knot intervals, as one matrix of basis functions and derivatives at a time t.

    w(t) = D(t) P,   D(t) = (b(t), b'(t), b''(t))   by the amplitudes P, one row of P per basis function

An integrator of differential equations asks for it at one time after the other, so it is kept as polynomials.
"""

from __future__ import annotations

import math

import numpy as np

from planner.base.arguments import count, number

MOST_INTERVALS, HIGHEST_DEGREE = 1000, 9


class SplineBasis:
    """The basis functions of splines of one degree over uniform intervals.

    Args:
        duration: s.
        intervals: Uniform knot intervals.
        degree: Of the polynomials.
        orders: How many of (b, b', b'') are asked for at once, 1 to 3.

    Attributes:
        knots: (n + degree + 1,) s, the ends repeated.
        degree: Of the polynomials.
        size: n = intervals + degree basis functions.

    Raises:
        PlannerError: An argument out of range.
    """

    def __init__(self, duration: float, intervals: int, degree: int, orders: int = 1) -> None:
        from scipy.interpolate import BSpline

        self.duration = number("duration", duration, above=0.0)
        self.orders = count("orders", orders, most=3)
        self.intervals = count("intervals", intervals, most=MOST_INTERVALS)
        self.degree = count("degree", degree, least=self.orders, most=HIGHEST_DEGREE)
        self.size = self.intervals + self.degree
        breaks = np.linspace(0.0, self.duration, self.intervals + 1)
        self.knots = np.concatenate([np.zeros(degree), breaks, np.full(degree, self.duration)])
        unit = BSpline(self.knots, np.eye(self.size), degree)
        # Taylor's series about the left end of an interval, which is exact there: b^(k)(t) = sum b^(p+k) s^p / p!
        self._series = np.zeros((self.intervals, degree + 1, self.orders, self.size))
        for order in range(self.orders):
            for power in range(degree + 1 - order):
                self._series[:, power, order] = unit(breaks[:-1], nu=power + order) / math.factorial(power)
        self._series = self._series.reshape(self.intervals, degree + 1, -1)
        self._breaks, self._powers = breaks, np.arange(degree + 1)

    def at(self, t: float) -> np.ndarray:
        """D(t), (orders, n), at one time, s."""
        i = min(max(int(t * self.intervals / self.duration), 0), self.intervals - 1)
        local = (t - self._breaks[i]) ** self._powers
        return (local @ self._series[i]).reshape(self.orders, self.size)

    def matrix(self, t: np.ndarray, order: int = 0) -> np.ndarray:
        """Basis functions (M, n) at times (M,), or a derivative of them."""
        from scipy.interpolate import BSpline

        return BSpline(self.knots, np.eye(self.size), self.degree)(t, nu=order)
