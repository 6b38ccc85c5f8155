"""Many problems, many plans."""
