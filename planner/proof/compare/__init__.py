"""Step 1 of a proof: the plan's model and MuJoCo's, term by term and contact by contact."""
