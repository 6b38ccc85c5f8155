"""The paper's hopper for kernels."""
