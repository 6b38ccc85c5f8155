"""The paper's own methods, as baselines."""
