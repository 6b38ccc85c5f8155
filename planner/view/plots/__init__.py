"""Plots: a plan beside its replays (plots.png), a proof (proof.png), and parts for pictures of a case."""
