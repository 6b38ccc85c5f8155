"""The proof: what an independent engine says of a plan. One file a step; `verdict` runs them and judges."""

from planner.proof.verdict import Proof, prove

__all__ = ["Proof", "prove"]
