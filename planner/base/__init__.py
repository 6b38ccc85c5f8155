"""What everything else stands on: errors, argument checks, files, versions, measured values, MuJoCo and OpenGL."""
