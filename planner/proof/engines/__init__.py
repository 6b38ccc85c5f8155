"""Other engines than MuJoCo: their parser, their dynamics and SciPy's integrator repeat a plan. One file an engine."""

from planner.base.late_imports import public_names

ENGINES = ("pinocchio", "drake")

__getattr__, __dir__, __all__ = public_names(__name__)
