"""Contact: the laws of touching, between which shapes, and the shapes of a compiled model."""
