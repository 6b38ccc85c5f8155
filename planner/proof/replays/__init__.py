"""Run plans in MuJoCo: compiled models, controls and gains, contacts, ranges reached."""
