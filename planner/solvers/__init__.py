"""Solvers: SLQ and what is built on it."""
