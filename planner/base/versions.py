"""Versions of this package and of what its numbers depend on, for the files it writes."""

from __future__ import annotations

import functools
import platform
from importlib import metadata


@functools.cache
def installed_versions() -> dict[str, str]:
    """Versions of this package and of what its numbers depend on."""
    names = {
        "planner": "slq-planner",
        "mujoco": "mujoco",
        "numpy": "numpy",
        "numba": "numba",
        "scipy": "scipy",
    }
    versions = {"python": platform.python_version()}
    for name, distribution in names.items():
        try:
            versions[name] = metadata.version(distribution)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
