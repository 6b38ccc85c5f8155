"""Run plans in MuJoCo: compiled models, controls and gains, what touches, what is reached."""
