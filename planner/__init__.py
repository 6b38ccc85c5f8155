"""Plan a robot's motion, then prove the plan in a simulator that had no part in making it.

problem = planner.cases.hopper(height=20.0)
plan = planner.solve(problem)
proof = planner.prove(plan)
planner.render_video(proof.replay, "hopper.mp4")
"""

from planner.base.late_imports import public_names

__version__ = "0.3.0.dev0"

__getattr__, __dir__, __all__ = public_names(__name__)
