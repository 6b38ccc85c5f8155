"""Pictures and video of a machine in MuJoCo."""
