"""A hopper whose building goes wrong at some heights: processes import it by its name."""

import os
import signal
import time
from pathlib import Path

import planner


def troubled(height=20.0, how="", bad=3, once=""):
    """The hopper; at the bad height it raises, hangs, or kills its process, with `once` (a file) only one time."""
    if height == bad and not (once and Path(once).exists()):
        if once:
            Path(once).touch()
        if how == "raise":
            raise ZeroDivisionError("no such machine")
        if how == "hang":
            time.sleep(600)
        if how == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
    return planner.cases.hopper(height=height, horizon=50)


def slow(height=20.0):
    """The hopper, after a while."""
    time.sleep(0.3)
    return planner.cases.hopper(height=height, horizon=50)
