"""The proof: independent verification of a plan by MuJoCo. One file per step; `prove_plan` runs them all."""

from planner.base.late_imports import public_names

__getattr__, __dir__, __all__ = public_names(__name__)
