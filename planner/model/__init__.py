"""A machine as data: its mechanism (screws), its state space, its contacts, and its twin in MuJoCo."""
