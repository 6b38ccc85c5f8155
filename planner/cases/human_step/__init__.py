"""The case human-step: the problem, the person, the normal gait, the cost, the robot, measures and pictures."""
