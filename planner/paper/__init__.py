"""The paper beside us: its own methods as baselines, and a study for each of its parts."""

from planner.base.lazy import public_names

__getattr__, __dir__, __all__ = public_names(__name__)
