"""The case high-dive: the problem, the flight (cost and count of turns) and the diver."""
