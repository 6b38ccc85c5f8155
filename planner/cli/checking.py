"""The command `check`: prove stored plans again and compare with the numbers stored beside them."""

from __future__ import annotations

import argparse

from planner.cli.allowed_imports import allowed_residuals
from planner.cli.console import Console, shown
from planner.sweeps.executors import executor_of
from planner.sweeps.regression import PlanComparison, check


def check_plans(arguments: argparse.Namespace, console: Console) -> int:
    """Prove stored plans again and print a table of the numbers that changed."""

    def show(one: PlanComparison) -> None:
        console.write_progress(f"{one.plan}: {'as stored' if one.passed else 'regressed'}")

    with executor_of(arguments.workers, arguments.scheduler) as executor:
        done = check(
            *arguments.paths, tolerance=arguments.tolerance, update=arguments.update, callback=show, executor=executor,
            residuals=allowed_residuals(arguments),
        )  # fmt: skip
    for one in done:
        if one.problem:
            console.write_result(f"{one.plan} is not compared: {one.problem}")
    rows = [
        (str(one.plan), f"{change.step} {change.name}".replace("_", " ").strip(),
         shown(change.stored), shown(change.now), shown(change.bound), change.word)
        for one in done for change in one.changes
    ]  # fmt: skip
    if rows:
        console.table(("plan", "measured", "stored", "now", "bound", ""), rows)
    bad = sum(not one.passed for one in done)
    moved = sum(bool(one.changes) for one in done if one.passed)
    counts = {"proved": len(done), "regressed": bad, "moved": moved, "as stored": len(done) - bad - moved}
    if arguments.update:
        counts["updated"] = sum(one.updated for one in done)
    console.write_result(f"plans {', '.join(f'{word}: {count}' for word, count in counts.items())}")
    plans = [
        {
            "plan": str(one.plan), "passed": one.passed, "problem": one.problem,
            "verdict": None if one.proof is None else one.proof.verdict,
            "changes": [change._asdict() for change in one.changes],
        }
        for one in done
    ]  # fmt: skip
    return console.finish("check", 1 if bad else 0, plans=plans)
