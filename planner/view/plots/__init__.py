"""Plots: a plan beside its replays (plots.png), what the proof measured (proof.png), and parts for pictures of a case.

The parts know neither plan nor proof: stick figures over a motion, paths in space, charts with bands of what is normal.
"""

from planner.view.plots.charts import draw_charts, plot_charts
from planner.view.plots.of_case import CASE_PICTURES, case_pictures, plot_case_picture
from planner.view.plots.paths import draw_paths, plot_paths
from planner.view.plots.plan import draw_plan, plot_plan
from planner.view.plots.proof import draw_proof, plot_proof
from planner.view.plots.stick_figures import draw_stick_figures, plot_stick_figures

__all__ = [
    "CASE_PICTURES",
    "case_pictures",
    "draw_charts",
    "draw_paths",
    "draw_plan",
    "draw_proof",
    "draw_stick_figures",
    "plot_case_picture",
    "plot_charts",
    "plot_paths",
    "plot_plan",
    "plot_proof",
    "plot_stick_figures",
]
