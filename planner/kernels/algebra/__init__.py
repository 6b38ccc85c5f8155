"""Small algebra for kernels: three-vectors, quaternions, matrix products, the ramp."""
