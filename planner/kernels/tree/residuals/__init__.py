"""Residuals of a machine as kernels: what is placed, what is measured there, and the cost of it."""
