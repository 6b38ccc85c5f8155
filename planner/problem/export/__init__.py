"""A plan for other programs: tables, ROS 2 joint trajectories, MuJoCo keyframes. One file a form.

All of them are made from sampled(): the plan at its knots, or at any rate.
"""
