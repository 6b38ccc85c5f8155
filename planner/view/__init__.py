"""Pictures, plots and pages of plans and proofs."""
