"""The environment of this process: processors that it may use, versions of the packages that its numbers depend on."""

from __future__ import annotations

import functools
import os
import platform
from importlib import import_module, metadata

VARIABLE = "PLANNER_THREADS"
"""Variable of the environment: the most threads that several starts or rollouts run on. Results do not depend on it."""


def processors() -> int:
    """How many threads to run: one a processor that this process may use, and no more than PLANNER_THREADS."""
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    asked = os.environ.get(VARIABLE, "")
    return min(here, max(1, int(asked))) if asked.isdecimal() else here


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
