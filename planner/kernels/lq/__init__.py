"""The LQ subproblem for kernels: memory, quadratic costs, backward sweeps, line search."""
