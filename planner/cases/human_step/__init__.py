"""The human step: who walks, the model, its cost, the robot, and what it came to."""
