"""Trees of rigid bodies for kernels: recursions, forces, derivatives, one iteration."""
