"""How many processors this process may use."""

from __future__ import annotations

import os

VARIABLE = "PLANNER_THREADS"
"""Variable of the environment: the most threads that several starts or rollouts run on. Results do not depend on it."""


def processors() -> int:
    """How many threads to run: one a processor that this process may use, and no more than PLANNER_THREADS."""
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    asked = os.environ.get(VARIABLE, "")
    return min(here, max(1, int(asked))) if asked.isdecimal() else here
