"""The high dive: the diver, the cost, and how turns are counted."""
