"""Environment of this process: its variables, available processors, versions of the packages that affect results."""

from __future__ import annotations

import functools
import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module

VARIABLE = "PLANNER_THREADS"
"""Environment variable: largest number of threads for several starts or rollouts. Results do not depend on it."""


@contextmanager
def variables_set(values: Mapping[str, str]) -> Iterator[None]:
    """Variables of the environment have these values; afterwards those from before, or none."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def available_processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processors() -> int:
    """Number of threads: the processors available to this process, at most PLANNER_THREADS."""
    here, asked = available_processors(), os.environ.get(VARIABLE, "")
    return min(here, max(1, int(asked))) if asked.isdecimal() else here


@functools.cache
def installed_versions() -> dict[str, str]:
    """Version by package name; "not installed" if missing."""
    from importlib import metadata  # local: slow, and few processes ask

    own = import_module("planner").__version__  # version of the running code; metadata may be of an older installation
    versions = {"python": platform.python_version(), "planner": own}
    for name in ("mujoco", "numpy", "numba", "scipy"):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
