"""Versions of this package and of the packages that its numbers depend on, for the files it writes."""

from __future__ import annotations

import functools
import platform
from importlib import import_module, metadata


@functools.cache
def installed_versions() -> dict[str, str]:
    """Versions by name, "not installed" where a package is missing."""
    own = import_module("planner").__version__  # of the code that runs, whatever an older installation says
    versions = {"python": platform.python_version(), "planner": own}
    for name in ("mujoco", "numpy", "numba", "scipy"):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
