"""The command `sweep`: plan a case or a problem file at many parameters, into one folder."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from planner.base.arguments import count
from planner.base.errors import PlannerError
from planner.cli.console import Console
from planner.cli.flags import PROBLEM_FILE
from planner.cli.solving import absolute, durations_of, flags_of_case, limits_of, name_of, objective_of
from planner.sweeps.executors import executor_of
from planner.sweeps.store import read_head
from planner.sweeps.sweeping import sweep
from planner.view.report.sweep_page import NAME

INTERRUPTED = 130


def sweep_case(arguments: argparse.Namespace, console: Console) -> int:
    """Plan a case or a problem file at every point of a grid."""
    out = Path(arguments.out or f"renders/sweep-{name_of(arguments)}")
    try:
        return _swept(arguments, out, console)
    except KeyboardInterrupt:  # a second time, while processes ended or tables were written
        if read_head(out) is None:
            raise
        console.write_error(
            f"interrupted; what is done is in {out}, and --resume goes on with it and writes its tables."
        )
        return INTERRUPTED


def _swept(arguments: argparse.Namespace, out: Path, console: Console) -> int:
    if arguments.rank != "cost":
        raise PlannerError("--rank is for one problem, expected a sweep without it: its starts are ranked by cost.")
    name = name_of(arguments)
    local = arguments.scheduler is None  # sweep() starts processes of its own, which load the problem's kernels first
    with executor_of(None if local else arguments.workers, arguments.scheduler) as executor:
        done = sweep(
            Path(arguments.problem) if arguments.case == PROBLEM_FILE else arguments.case, arguments.set,
            out=out, executor=executor, workers=arguments.workers, fixed=_fixed(arguments),
            prove={"rollouts": count("rollouts", arguments.rollouts, minimum=0)} if arguments.prove else False,
            continued=arguments.along, timeout=arguments.timeout, resume=arguments.resume,
            objective=objective_of(arguments.objective), durations=durations_of(arguments.durations),
            limits=limits_of(arguments), progress=console.progress(f"planning {name}"), **_options(arguments),
        )  # fmt: skip
    page = done.folder / NAME
    console.table(("status", "tasks"), [(status, str(tasks)) for status, tasks in done.statuses.items()])
    console.write_result(str(page))
    if done.interrupted:
        console.write_error(
            f"interrupted; {done.finished} of {len(done.grid)} are done, and --resume goes on with them."
        )
    converged = done.statuses.get("CONVERGED", 0)
    code = INTERRUPTED if done.interrupted else 0 if converged == len(done.grid) else 1
    facts = {"tasks": len(done.grid), "finished": done.finished, "statuses": done.statuses, "folder": str(out)}
    return console.finish("sweep", code, **facts)


def _fixed(arguments: argparse.Namespace) -> dict[str, Any]:
    """Flags of the case that are the same for all tasks."""
    folder = absolute(getattr(arguments, "package_path", None))
    return flags_of_case(arguments) | ({} if folder is None else {"package_path": folder})


def _options(arguments: argparse.Namespace) -> dict[str, Any]:
    names = ("update", "line_search", "hessian", "max_iterations", "starts", "seed")
    return {name: getattr(arguments, name) for name in names}
