"""Versions of this package and of the packages that its numbers depend on, for the files it writes."""

from __future__ import annotations

import functools
import platform
from importlib import metadata


@functools.cache
def installed_versions() -> dict[str, str]:
    """Versions by name, "not installed" where a package is missing."""
    versions = {"python": platform.python_version()}
    for name in ("planner", "mujoco", "numpy", "numba", "scipy"):
        try:
            versions[name] = metadata.version("slq-planner" if name == "planner" else name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
