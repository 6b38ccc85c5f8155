"""URDF files: read as a tree of links and joints, and written as the MJCF that a plan keeps."""
