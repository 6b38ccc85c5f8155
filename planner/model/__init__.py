"""Data of a machine: mechanism (screws), state space, contacts, and its MuJoCo model (Twin)."""
