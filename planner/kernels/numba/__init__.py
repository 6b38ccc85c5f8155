"""How kernels are compiled and cached, and the number types they compute with: lanes and dual numbers."""
