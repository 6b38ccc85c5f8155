"""Step 5 of a proof: seeded perturbations, rollouts, and the word they lead to."""
