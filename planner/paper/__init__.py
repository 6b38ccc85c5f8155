"""The paper's own methods as baselines, and studies that compare its parts with our results."""

from planner.base.late_imports import public_names

__getattr__, __dir__, __all__ = public_names(__name__)
