"""Plots: a plan beside its replays (plots.png), a proof (proof.png), and parts for pictures of a case.

The parts know neither plan nor proof: stick figures over a motion, paths in space, charts with bands of normal values.
"""

from planner.view.plots.case_pictures import CASE_PICTURES, case_pictures, draw_case_picture, draw_charts, draw_loop
from planner.view.plots.plan import draw_plan
from planner.view.plots.proof import draw_proof
from planner.view.plots.stick_figures import draw_paths, draw_stick_figures
from planner.view.plots.style import save

__all__ = [
    "CASE_PICTURES", "case_pictures", "draw_case_picture", "draw_charts", "draw_loop", "draw_paths", "draw_plan",
    "draw_proof", "draw_stick_figures", "save",
]  # fmt: skip
