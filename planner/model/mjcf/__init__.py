"""MJCF files: bounded, read, edited or refused."""
