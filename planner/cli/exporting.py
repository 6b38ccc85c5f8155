"""The command `export`: write a stored plan for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from planner.base.errors import PlannerError
from planner.cli.allowed_imports import load_allowed
from planner.cli.console import Console
from planner.problem.export.joint_trajectory import left_out
from planner.problem.export.sampled import sampled

FORMATS = {"csv": ".csv", "json": ".json", "yaml": ".yaml", "keyframes": ".keys.xml"}
"""Ending of the file of each form."""


def export_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Write a stored plan as a table, as a joint trajectory or as keyframes."""
    form, rate = arguments.to, arguments.rate
    if arguments.only is not None and form != "csv":
        raise PlannerError(f"--only is for --to csv, expected none with --to {form}.")
    plan = load_allowed(arguments.plan, arguments)
    out = Path(arguments.plan).with_suffix(FORMATS[form]) if arguments.out is None else Path(arguments.out)
    if form in ("json", "yaml") and not (out.suffix == ".json" if form == "json" else out.suffix in (".yaml", ".yml")):
        raise PlannerError(f"cannot write {form} to {out}: expected a name ending in {FORMATS[form]}.")
    rows = len(sampled(plan, rate).t) - (arguments.only == "controls")
    missing: tuple[str, ...] = ()
    if form == "csv":
        plan.to_csv(out, rate, arguments.only)
    elif form == "keyframes":
        plan.to_keyframes(out, rate)
    else:
        plan.to_joint_trajectory(out, rate)
        missing = left_out(plan)
    if missing:
        console.write_result(f"left out, since the message has hinges and slides alone: {', '.join(missing)}")
    console.write_result(
        f"{out}: {rows} {'keyframes' if form == 'keyframes' else 'rows' if form == 'csv' else 'points'}"
    )
    return console.finish("export", 0, file=str(out), form=form, samples=rows, left_out=list(missing))
