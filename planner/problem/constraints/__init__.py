"""Hard constraints: what a plan keeps of terms of the library and of functions of its maker's."""
