"""The proof: what an independent engine says of a plan. One file a step; `verdict` runs them and judges."""

from planner.base.lazy import public_names

__getattr__, __dir__, __all__ = public_names(__name__)
