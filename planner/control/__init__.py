"""Closed loop: model predictive control, its simulation in MuJoCo with model errors, and the verdict."""
