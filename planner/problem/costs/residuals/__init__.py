"""Residuals of a machine in NumPy: terms as arrays over the stages, and the readable twins of the kernels' kinds."""
