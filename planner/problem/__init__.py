"""The nouns: Problem, Plan, costs, limits, and how a machine is shown."""
