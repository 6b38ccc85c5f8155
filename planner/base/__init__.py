"""Errors, argument checks, files, JSON, versions, measured values, loading of MuJoCo and OpenGL."""
