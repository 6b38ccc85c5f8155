"""Basis functions at one time are scipy's, and so are their derivatives."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from planner import PlannerError
from planner.paper.methods.spline_basis import SplineBasis


@pytest.mark.parametrize(("intervals", "degree"), [(1, 3), (4, 3), (12, 5), (7, 6)])
def test_the_basis_is_scipys(intervals, degree):
    basis = SplineBasis(2.5, intervals, degree, orders=3)
    unit = BSpline(basis.knots, np.eye(basis.size), degree)
    for t in np.linspace(0.0, 2.5, 23):
        scipys = np.stack([unit(t, nu=order) for order in range(3)])
        assert np.allclose(basis.at(t), scipys, rtol=1e-9, atol=1e-9 * np.abs(scipys).max())


def test_basis_functions_add_up_to_one():
    basis = SplineBasis(1.0, 5, 4)
    assert np.allclose([basis.at(t).sum() for t in np.linspace(0.0, 1.0, 11)], 1.0)
    assert np.allclose(basis.matrix(np.linspace(0.0, 1.0, 11)).sum(axis=1), 1.0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"duration": 0.0}, "duration is 0"), ({"intervals": 0}, "intervals is 0"), ({"degree": 10}, "degree is 10"),
     ({"orders": 4}, "orders is 4")],
)  # fmt: skip
def test_wrong_knots_are_refused_in_one_sentence(changes, words):
    with pytest.raises(PlannerError, match=words):
        SplineBasis(**({"duration": 1.0, "intervals": 4, "degree": 5} | changes))
