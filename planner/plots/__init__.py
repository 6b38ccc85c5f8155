"""Plots: a plan beside its replays (plots.png), and what the proof measured (proof.png)."""

from planner.plots.plan import draw_plan, plot_plan
from planner.plots.proof import draw_proof, plot_proof

__all__ = ["draw_plan", "draw_proof", "plot_plan", "plot_proof"]
