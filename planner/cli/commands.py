"""Run one command: what is wrong with the input is one sentence and exit code 2, an error of the planner itself 70."""

from __future__ import annotations

import argparse
import gc
import importlib
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.base.files import confined
from planner.base.gl import fatal_error
from planner.cli import parser
from planner.cli.checking import check_inputs
from planner.cli.console import Console

INTERNAL = 70  # EX_SOFTWARE of sysexits.h
TRACEBACK = "PLANNER_TRACEBACK"
"""Variable of the environment: set to anything, where an error of the planner itself was raised is printed."""


def command(words: list[str]) -> int:
    """Run the command of a command line; returns the exit code."""
    # A kill ends like an exception, so that hidden folders are removed.
    for kill in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(kill, lambda number, _: sys.exit(128 + number))
    console = Console(as_json="--json" in words, quiet="--quiet" in words, verbose="--verbose" in words)
    with np.errstate(all="ignore"):  # a sentence says what is wrong
        return _run(words, console)


def _function(name: str) -> Callable[[argparse.Namespace, Console], int]:
    file, function = parser.COMMANDS[name][0].split(".")
    found = getattr(importlib.import_module(f"planner.cli.{file}"), function)
    if not gc.isenabled():  # by __main__
        gc.freeze()
        gc.enable()
    return found


def _run(words: list[str], console: Console) -> int:
    began = time.time()
    try:
        arguments = parser.parse(words)
        if arguments.version:
            from planner.base.environment import installed_versions  # local: 0.1 s

            versions = {"planner": "", **installed_versions()}  # planner first
            console.write_result("  ".join(f"{name} {version}" for name, version in versions.items()))
            return 0
        if arguments.command is None:
            parser.build(()).print_help()
            return 0
        with confined(arguments.confine):
            check_inputs(arguments)
            code = _function(arguments.command)(arguments, console)
        if arguments.command != "warmup":
            _compile_the_rest(console, began)
        if console.lost:
            console.write_error(f"the results could not be printed: {console.lost}.")
            return 2
        return code
    except PlannerError as error:
        return _refuse(console, str(error), 2)
    except MemoryError:
        return _refuse(console, "there is not enough memory for this problem, expected a shorter horizon.", 2)
    except fatal_error() as error:
        said = short_repr(str(error))
        return _refuse(console, f"MuJoCo cannot go on ({said}), expected more memory, or a smaller model.", 2)
    except KeyboardInterrupt:
        return _refuse(console, "interrupted; nothing was written.", 130)
    except Exception as error:
        if os.environ.get(TRACEBACK):
            for line in traceback.format_exc().splitlines():
                console.write_error(line)
        kind = f"{type(error).__name__}: {short_repr(str(error))}"
        how = f"please report it, with the command and what {TRACEBACK}=1 makes it print"
        return _refuse(console, f"this is an error of the planner itself ({kind}); {how}.", INTERNAL)


def _compile_the_rest(console: Console, began: float) -> None:
    """In the background, where somebody at a terminal has waited for a part of the core: other machines need more."""
    jit = sys.modules.get("planner.kernels.numba.jit")
    if not console.live or console.quiet or jit is None or not jit.cache_is_shared():
        return
    root = str(Path(__file__).parents[2])
    with suppress(OSError):  # what was asked for is done: nothing of this may make it fail
        if not any(kernel.stat().st_mtime > began for kernel in jit.cache_directory().glob("*.nbc")):
            return
        subprocess.Popen(
            ["nice", "-n", "19", sys.executable, "-m", "planner", "warmup", "--quiet"],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH", "")]))},
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        console.write_progress("what other machines need is compiled in the background, as by planner warmup")


def _refuse(console: Console, sentence: str, code: int) -> int:
    console.write_error(sentence)
    console.document({"error": sentence, "exit_code": code})
    return code
