"""Discrete dynamics x(n+1) = f(x(n), u(n)) (Eq. 10) of machines, and their algorithms: rnea, mass_matrix ..."""

from planner.base.late_imports import public_names

__getattr__, __dir__, __all__ = public_names(__name__)
