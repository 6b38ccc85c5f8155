"""Hard problems from random starts: the share solved within the goal and the median penalized time, beside peers.

    python benchmarks/hard.py [--starts 20] [--only cart] [--seed 7] [--peer PYTHON] [--json FILE]

The problems are those of hard_problems.py. Half of the starts are the same at each run, the others are drawn anew from
a seed that is printed. A start is a smooth random change of the first controls. All solvers have the same cost, start
and stop. A start is solved where the controls, within their bounds, bring our rollout to the goal within its tolerance
and within the bounds of the states, in at most LIMIT seconds of processor time (one thread); one that is not counts
PENALTY times LIMIT. The peers, from the environment of PYTHON (see README.md), are Crocoddyl's BoxFDDP (FDDP without
bounds; it knows no bounds of states) and the CSQP of mim_solvers.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from pathlib import Path
from typing import Any

import numpy as np
from hard_problems import OWN, STATED
from problems import SINGLE_THREAD
from serving import Worker

LIMIT = 10.0  # s
PENALTY = 10.0
PEERS = {"fddp": "Crocoddyl", "csqp": "mim_solvers"}


def main() -> None:
    """One line per problem and solver, then the sums."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--only", default="", help="problems whose names begin with this")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--peer", help="Python that has Crocoddyl and mim_solvers")
    parser.add_argument("--solvers", nargs="+", choices=PEERS, default=list(PEERS), help="of that environment")
    parser.add_argument("--json", type=Path, help="file for one row per problem and solver")
    options = parser.parse_args()
    drawn = int(np.random.SeedSequence(options.seed).entropy) % 2**32  # pyright: ignore[reportArgumentType]
    print(f"{options.starts} starts, half of them of seed {drawn}")
    workers = {"ours": _worker(sys.executable, "ours")}
    if options.peer:
        workers |= {name: _worker(options.peer, name) for name in options.solvers}
    rows = []
    for name in [*STATED, *OWN]:
        if name.startswith(options.only):
            for row in measured(name, workers, options.starts, drawn, options.peer):
                rows.append(row)
                times = f"median {row['median']:8.3f} s, of the solved {row['median_solved']:8.3f} s"
                counts = f"{row['solved']:3d} of {row['starts']}"
                print(f"{name:40s} {row['solver']:6s} {counts}, {times}  {row['ended']}", flush=True)
    summary(rows)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def _worker(python: str, solver: str) -> Worker:
    worker = Worker(python, "hard_worker.py", SINGLE_THREAD, solver, solver)
    if "version" not in worker.hello:
        sys.exit(f"{solver}: {worker.hello}")
    return worker


def measured(name: str, workers: dict[str, Worker], starts: int, drawn: int, python: str) -> list[dict[str, Any]]:
    """One row a solver."""
    stated = STATED[name]() if name in STATED else None
    known = ["ours"] if stated is None else [one for one in workers if one != "fddp" or stated["states"] is None]
    for one in known:
        answer = workers[one].ask("load", stated=stated, name=name)
        if "failed" in answer:
            sys.exit(f"{name}, {one}: {answer['failed']}")
    found: dict[str, list[dict[str, Any]]] = {one: [] for one in known}
    for k in range(starts):
        seed = [k % 2 * drawn, k]
        us = None if stated is None else first_controls(stated, seed)
        for one in known:
            answer = workers[one].ask("solve", us=us, seed=seed, limit=LIMIT)
            if "failed" in answer and one != "ours":  # an exception of CSQP's threads ends its process or comes later
                workers[one].close()
                workers[one] = _worker(python, one)
                workers[one].ask("load", stated=stated, name=name)
            if "us" in answer:
                answer["solved"] = workers["ours"].ask("judge", us=answer.pop("us"))["solved"]
            found[one].append(answer)
    return [_row(name, one, answers) for one, answers in found.items()]


def first_controls(stated: dict[str, Any], seed: list[int]) -> list[list[float]]:
    """Controls (N, nu) of a random start, within their bounds."""
    from planner.solvers.multistart import smooth

    us, limits = np.array(stated["us"]), np.array(stated["limits"])
    us = us + np.array(stated["random"]) * smooth(np.random.default_rng(seed), us.shape)
    return np.clip(us, -limits, limits).tolist()


def _row(name: str, solver: str, answers: list[dict[str, Any]]) -> dict[str, Any]:
    solved = [bool(one.get("solved")) and one["seconds"] <= LIMIT for one in answers]
    times = [one["seconds"] if good else PENALTY * LIMIT for one, good in zip(answers, solved, strict=True)]
    good = [one for one, kept in zip(times, solved, strict=True) if kept]
    ended = [str(one.get("ended", one.get("failed"))) for one in answers]
    return {
        "problem": name, "solver": solver, "starts": len(answers), "solved": sum(solved),
        "median": statistics.median(times), "median_solved": statistics.median(good) if good else float("nan"),
        "slowest": max(float(one.get("seconds", np.inf)) for one in answers),
        "ended": ", ".join(f"{ended.count(one)} {one}" for one in dict.fromkeys(ended)),
    }  # fmt: skip


def summary(rows: list[dict[str, Any]]) -> None:
    """Shares of all starts, and medians over the problems that the peers state, too."""
    for solver in dict.fromkeys(row["solver"] for row in rows):
        own = [row for row in rows if row["solver"] == solver]
        others = {row["problem"] for row in own}
        same = [row for row in rows if row["solver"] == "ours" and row["problem"] in others]
        share = sum(row["solved"] for row in own) / sum(row["starts"] for row in own)
        line = f"{solver}: {len(own)} problems, {100 * share:.1f} % of the starts solved"
        if solver != "ours":
            ours = sum(row["solved"] for row in same) / sum(row["starts"] for row in same)
            ratios = [mine["median"] / theirs["median"] for mine, theirs in zip(same, own, strict=True)]
            line += f" (ours there {100 * ours:.1f} %), our median penalized time is {statistics.median(ratios):.3f}"
            line += " of theirs (median of the problems)"
        print(line)


if __name__ == "__main__":
    main()
