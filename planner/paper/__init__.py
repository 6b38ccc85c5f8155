"""The paper beside us: its own methods, and a study for each of its parts."""
