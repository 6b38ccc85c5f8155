"""Tasks: goals as people say them, of frames and joints at times, and paths to follow."""
