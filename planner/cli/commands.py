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
from typing import Any

import numpy as np

from planner.base.arguments import short_repr
from planner.base.data_files import check_file, read_table
from planner.base.errors import PlannerError
from planner.base.files import PLANS, check_confined, check_exists, confined, read_input
from planner.base.gl import fatal_error
from planner.cli import parser
from planner.cli.console import Console
from planner.cli.flags import value_of
from planner.model.robot_collections import PREFIX
from planner.problem.problem_parts import checked_durations, durations_or_default, stages_of, weights_of


def check_inputs(arguments: argparse.Namespace) -> None:
    """Raise PlannerError for an input that is not there, may not be read or has wrong keys or values.

    As far as it can be said before slow imports and without a model: what needs the model's names (joints, frames,
    limits by joint) and the parameters of a case are checked where the problem is built.
    """
    objective, durations = (getattr(arguments, name, None) for name in ("objective", "durations"))
    objective, durations = objective_of(objective), durations_of(durations)
    for name, what in (("problem", "the problem file"), ("model", "the model")):
        path = getattr(arguments, name, None)
        if isinstance(path, str) and path:
            _check_path(path, what)
            if name == "problem" and arguments.command != "sweep":  # which may add keys
                _check_problem_file(path, {"objective": objective, "durations": durations})
    for path in getattr(arguments, "paths", ()):  # of check
        check_confined(path, "the plan")
        check_exists(path, PLANS)
    plan = getattr(arguments, "plan", None)
    if isinstance(plan, str) and not os.path.exists(plan):
        from planner.problem.archive import opened  # local: a third of a second

        opened(Path(plan)).close()  # it says so, too, but for a plan within an archive of many


def _check_path(path: str, what: str) -> None:
    """Refuse a file that is not there or may not be read."""
    if not path.startswith(PREFIX):
        check_confined(path, what)
        if not os.path.exists(path):
            read_input(path, what)  # which says why it is not there


def _check_problem_file(path: str, instead: dict[str, Any]) -> None:
    """Refuse a problem file of a machine of one's own by its keys and values alone."""
    table = read_table(Path(path))
    if "case" in table:
        return
    table |= {name: value for name, value in instead.items() if value is not None}
    keys, parts, rules = (value_of("planner.cases.problem_file.keys", name) for name in ("KEYS", "TABLES", "VALUES"))
    check_file(table, keys, parts, rules, path)
    if isinstance(table.get("model"), str) and table["model"]:
        model = table["model"]
        _check_path(model if model.startswith(PREFIX) else str(Path(path).parent / model), "the model")
    _check_parts(table)


def _check_parts(table: dict[str, Any]) -> None:
    """Refuse values of a file that lie in tables, or that have to fit each other."""
    from planner.model.mjcf.attached import attachments  # these are local, because most commands check no file
    from planner.model.mjcf.obstacles import obstacles_of
    from planner.problem.costs.terms import checked_tolerance
    from planner.problem.tasks.goal import goal_of

    checked_tolerance(table.get("tolerance"))
    objective = weights_of(table["objective"]) if "objective" in table else {}
    checked_durations(durations_or_default(table.get("durations"), objective, 1.0), objective)  # 1 s: of any duration
    if "duration" in table and isinstance(table.get("dt"), (int, float)):
        stages_of(table["duration"], table["dt"])
    goals = table.get("goal")
    for k, goal in enumerate(goals if isinstance(goals, list) else [], 1):
        if isinstance(goal, dict):
            goal_of(goal, f"goal {k}")
    attachments(table.get("attach"))
    obstacles_of(table.get("obstacle"))


def objective_of(text: str | None) -> dict[str, float] | None:
    """Weights of criteria from "time" or from "effort=1,time=2"; None stays None."""
    if text is None:
        return None
    if "=" not in text:
        return weights_of(text.strip())
    weights: dict[str, float] = {}
    for word in text.split(","):
        name, _, value = word.partition("=")
        try:
            weights[name.strip()] = float(value)
        except ValueError:
            raise PlannerError(
                f"--objective has {short_repr(word)}, expected NAME=WEIGHT, e.g. effort=1,time=2."
            ) from None
    return weights_of(weights)


def durations_of(text: str | None) -> list[float] | None:
    """The shortest and the longest duration, s, from "0.5,3"; None stays None."""
    if text is None:
        return None
    try:
        shortest, longest = map(float, text.split(","))
    except ValueError:
        raise PlannerError(f"--durations is {short_repr(text)}, expected SHORTEST,LONGEST in s, e.g. 0.5,3.") from None
    return [shortest, longest]


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
