"""Costs, one file a family."""
