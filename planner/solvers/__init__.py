"""Solvers: SLQ, and its extensions to constraints, periodic trajectories and free final time."""
