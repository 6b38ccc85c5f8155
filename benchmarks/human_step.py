"""The human step against its targets: `python benchmarks/human_step.py`, some minutes on one core.

Each row is a target of the study that the case was first solved in, and what this run measures, with the study's cost
(cost="study") and the default person. A row is a line of JSON with --json; --write PAGE puts the table between the two
comments of that name in a page. Solves are timed warm, the least of several.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

from human_step_measures import Bench, Row  # noqa: E402 (one thread, before NumPy)

BEGIN, END = "<!-- table: benchmarks/human_step.py -->", "<!-- end of table -->"


def sections(bench: Bench) -> list[Callable[[], Iterator[Row]]]:
    """What is measured, in the order of the table."""
    return [bench.dynamics, bench.swing, bench.legs_apart, bench.cycle, bench.cycles, bench.periodic, bench.steps,
            bench.updates, bench.replays, bench.perturbed, bench.smoothing, bench.times]  # fmt: skip


def table(rows: list[Row]) -> str:
    """Markdown."""
    lines = ["| check | target | measured | |", "|---|---|---|---|"]
    lines += [f"| {row.check} | {row.target} | {row.measured} | {'met' if row.met else '**missed**'} |" for row in rows]
    return "\n".join(lines)


def main() -> None:
    """Measure all rows."""
    parser = argparse.ArgumentParser(description="The human step against its targets.")
    parser.add_argument("--json", action="store_true", help="one JSON object per row, no table")
    parser.add_argument("--write", type=Path, metavar="PAGE", help="put the table into a page")
    parser.add_argument("--only", nargs="*", default=[], metavar="PART", help="some parts: dynamics, swing, cycle, ...")
    arguments = parser.parse_args()
    rows = []
    for section in sections(Bench()):
        if arguments.only and section.__name__ not in arguments.only:
            continue
        for row in section():
            rows.append(row)
            if arguments.json:
                print(json.dumps(row._asdict()), flush=True)
            else:
                print(f"{'met   ' if row.met else 'MISSED'}  {row.check}: {row.measured} ({row.target})", flush=True)
    if not arguments.json:
        print("\n" + table(rows))
    if arguments.write is not None:
        before, rest = arguments.write.read_text(encoding="utf-8").split(BEGIN)
        after = rest.split(END)[1]
        arguments.write.write_text(f"{before}{BEGIN}\n{table(rows)}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
