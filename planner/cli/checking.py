"""The command `check`: prove stored plans again and compare with the numbers stored beside them."""

from __future__ import annotations

import argparse
from collections import Counter

from planner.cli.allowed_imports import allowed_residuals
from planner.cli.console import Console, shown
from planner.sweeps.executors import executor_of
from planner.sweeps.regression import check


def check_plans(arguments: argparse.Namespace, console: Console) -> int:
    """Prove stored plans again and print a table of the numbers that changed."""
    with executor_of(arguments.workers, arguments.scheduler) as executor:
        done = check(
            *arguments.paths, tolerance=arguments.tolerance, update=arguments.update, model=arguments.model,
            callback=lambda one: console.write_progress(f"{one.plan}: {one.word}"), executor=executor,
            residuals=allowed_residuals(arguments),
        )  # fmt: skip
    for one in done:
        console.write_result(one.line)
    rows = [
        (str(one.plan), f"{change.step} {change.name}".replace("_", " ").strip(),
         shown(change.stored), shown(change.now), shown(change.bound), change.word)
        for one in done for change in one.changes
    ]  # fmt: skip
    if rows:
        console.table(("plan", "measured", "stored", "now", "bound", ""), rows)
    counts = Counter(one.word for one in done)
    console.write_result(f"plans checked: {len(done)}, {', '.join(f'{word}: {counts[word]}' for word in counts)}")
    plans = [
        {
            "plan": str(one.plan), "passed": one.passed, "word": one.word, "problem": one.problem,
            "model": None if one.model is None else {"state": one.model.state, "details": list(one.model.details)},
            "stated": list(one.stated),
            "verdict": None if one.proof is None else one.proof.verdict,
            "changes": [change._asdict() for change in one.changes],
        }
        for one in done
    ]  # fmt: skip
    return console.finish("check", int(not all(one.passed for one in done)), plans=plans)
