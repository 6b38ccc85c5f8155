"""problem.toml: a machine of one's own as a Problem; see problem_file.build for the format."""

from planner.base.late_imports import public_names

__getattr__, __dir__, __all__ = public_names(__name__)
