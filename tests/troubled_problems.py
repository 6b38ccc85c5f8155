"""A hopper whose building goes wrong at some heights: processes import it by its name."""

import os
import signal
import sys
import threading
import time
from pathlib import Path

import numpy as np

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
        if how == "exit":
            sys.exit(5)
        if how == "interrupt":
            raise KeyboardInterrupt
        if how == "memory":
            raise MemoryError("4 GB")
        if how == "recursion":
            troubled(height, how, bad)
        if how == "garbage":
            return np.full(3, np.nan)
        if how == "thread":
            threading.Thread(target=time.sleep, args=(600,), name="left").start()
        if how == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
    return planner.cases.hopper(height=height, horizon=50)


def slow(height=20.0):
    """The hopper, after a while."""
    time.sleep(0.3)
    return planner.cases.hopper(height=height, horizon=50)


def mortal(height=20.0, deaths=(), folder=""):
    """The hopper, over few stages; at the heights of `deaths` its process is killed, the first time."""
    mark = Path(folder) / f"{height:.17g}"
    if height in deaths and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return planner.cases.hopper(height=height, horizon=20)
