"""Rigid bodies against Crocoddyl in one run: `python benchmarks/rigid_body.py --crocoddyl ITS_PYTHON`.

Single iterations from the same trajectory, whole solves, and how long a fresh process takes. Before a problem is timed
all sides' accelerations and costs on it are compared. Each solver is a process of one thread. They are asked in turn, a
few repetitions at a time, and only the asked one works. Peers that are not given are left out, and named.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import sys
import tempfile
from typing import Any

import numpy as np
from problems import SINGLE_THREAD
from rigid_body_problems import (
    BASELINE_RATIOS,
    COST_SLACK,
    INTEGRATORS,
    ITERATION_RATIOS,
    MECHANISMS,
    SOLVE_TARGETS,
    Problem,
    Target,
    iteration_problem,
    probes,
    solve_problem,
)
from rigid_body_start import NAME, start_lines
from rigid_body_table import finite, table
from serving import Answer, Worker

BURST = 5  # repetitions per turn
TURN = 2.0  # s, the longest a turn goes on
AGREES = 1e-9  # relative difference of accelerations and costs that is still rounding

# What Crocoddyl's and Pinocchio's wheels are compiled for. Numba needs the features too: the name alone keeps AVX.
BASELINE = {
    "NUMBA_CPU_NAME": "x86-64",
    "NUMBA_CPU_FEATURES": "+sse,+sse2,-sse3,-ssse3,-sse4.1,-sse4.2,-avx,-avx2,-avx512f,-fma,-fma4,-f16c,-xop",
}
PINS = "pip install crocoddyl==3.2.1 pin==4.0.0 libpinocchio==4.0.0"


def interleaved(
    workers: dict[str, Worker], do: str, repeats: int, seconds: float, **arguments: Any
) -> dict[str, Answer]:
    """Per solver its last answer with the times of all its turns; a failed one has "failed"."""
    rows: dict[str, Answer] = {}
    # The first turn warms caches up (and finds out how many iterations a solve may have): not counted.
    for name, worker in workers.items():
        rows[name] = {**worker.ask(do, repeats=1, seconds=TURN, **arguments), "times": []}
    asking = [name for name in workers if "failed" not in rows[name]]
    while asking:
        for name in list(asking):
            times = rows[name]["times"]
            answer = workers[name].ask(do, repeats=min(BURST, repeats - len(times)), seconds=TURN, **arguments)
            rows[name] = {**answer, "times": times + answer.get("times", [])}
            times = rows[name]["times"]
            if "failed" in answer or len(times) >= repeats or sum(times) >= seconds:
                asking.remove(name)
    return rows


def apart(a: Any, b: Any) -> float:
    """The largest difference relative to the largest number; infinite where one is not finite."""
    a, b = np.array(a, float), np.array(b, float)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return math.inf
    return float(np.abs(a - b).max() / max(np.abs(a).max(), 1e-300))


def loaded(workers: dict[str, Worker], problem: Problem) -> tuple[dict[str, Answer], list[Answer]]:
    """Give a problem to all; what each says, and a line of comparison for each but the first."""
    asked = probes(problem)
    answers = {name: worker.ask("load", problem=problem, probes=asked) for name, worker in workers.items()}
    reference, lines = answers["native"], []
    for name, answer in answers.items():
        line: Answer = {
            "kind": "check", "problem": problem["name"], "integrator": problem["integrator"], "solver": name,
        }  # fmt: skip
        if "failed" in answer:
            lines.append({**line, "agrees": False, "failed": answer["failed"]})
            continue
        if name == "native":
            continue
        if "failed" in reference:  # ours does not work yet: check at least what the peer says about itself
            reference = {"accelerations": answer.get("pinocchio", answer["accelerations"]), "cost": answer["cost"]}
        # Gravity first: at rest and without controls, Crocoddyl with another Pinocchio answers as if there were none.
        line["at_rest"] = apart(reference["accelerations"][0], answer["accelerations"][0])
        line["accelerations"] = apart(reference["accelerations"], answer["accelerations"])
        line["cost"] = apart(reference["cost"], answer["cost"])
        if "pinocchio" in answer:
            line["pinocchio"] = apart(answer["pinocchio"], answer["accelerations"])
        if answer.get("sample") is not None:
            line["sample"] = answer["sample"]
        line["agrees"] = all(
            line[key] <= AGREES for key in line.keys() & {"accelerations", "cost", "pinocchio", "sample"}
        )
        # A full step from the same trajectory: the same directions and the same rollout end at the same cost.
        if reference.get("step") == 1.0 and answer.get("stepped_cost") is not None:
            line["stepped_cost"] = apart(reference["stepped_cost"], answer["stepped_cost"])
        lines.append(line)
    return answers, lines


def iteration_lines(
    mechanism: str, integrator: str, answers: dict[str, Answer], rows: dict[str, Answer]
) -> list[Answer]:
    """One record per instruction set of ours."""
    peer = rows.get("crocoddyl", {"failed": "no Crocoddyl in this run"})
    lines = []
    for name in ("native", "baseline"):
        if name not in rows:
            continue
        target = ITERATION_RATIOS[mechanism, integrator] if name == "native" else BASELINE_RATIOS[mechanism]
        line: Answer = {
            "kind": "iteration", "problem": mechanism, "integrator": integrator, "isa": name, "target": target,
        }  # fmt: skip
        for side, row in (("ours", rows[name]), ("crocoddyl", peer)):
            if "failed" in row:
                line[f"{side}_failed"] = row["failed"]
                continue
            times = [1e6 * t for t in row["times"]]
            line |= {
                f"{side}_min_us": min(times), f"{side}_median_us": statistics.median(times),
                f"{side}_repeats": len(times),
            }  # fmt: skip
        if "parts" in peer:
            line["crocoddyl_parts_us"] = {part: 1e6 * min(times) for part, times in peer["parts"].items()}
        if "step" in answers[name]:
            line["step"] = answers[name]["step"]
        if "ours_min_us" in line and "crocoddyl_min_us" in line:
            line["ratio_min"] = line["crocoddyl_min_us"] / line["ours_min_us"]
            line["ratio_median"] = line["crocoddyl_median_us"] / line["ours_median_us"]
            line["met"] = line["ratio_min"] >= target
        lines.append(line)
    return lines


def solve_lines(problem: Problem, workers: dict[str, Worker], rows: dict[str, Answer]) -> list[Answer]:
    """One record per solver; ours are judged by Crocoddyl's rollout, the peers by ours."""
    target: Target = SOLVE_TARGETS[problem["name"], problem["integrator"]]
    ours = rows["native"].get("times")
    lines = []
    for name, row in rows.items():
        line: Answer = {
            "kind": "solve", "problem": problem["name"], "integrator": problem["integrator"], "solver": name,
        }  # fmt: skip
        if "failed" in row:
            lines.append({**line, "failed": row["failed"]})
            continue
        ms = [1e3 * t for t in row["times"]]
        judge = "native" if name in ("crocoddyl", "casadi") else "crocoddyl"
        judged = workers[judge].ask("judge", us=row["us"]).get("cost") if judge in workers else None
        line |= {
            "cost": row["cost"], "judged_cost": judged, "iterations": row["iterations"], "converged": row["converged"],
            "solves": len(ms), "min_ms": min(ms), "median_ms": statistics.median(ms),
            "ratio": min(ms) / (1e3 * min(ours)) if ours else None,
        }  # fmt: skip
        if name == "native":
            line |= {
                "target_ms": target.ms, "target_cost": target.cost, "met": min(ms) <= target.ms,
                "cost_met": row["cost"] <= target.cost * (1.0 + COST_SLACK),
            }  # fmt: skip
        lines.append(line)
    return lines


def started(arguments: argparse.Namespace, cache: str) -> tuple[dict[str, Worker], list[str]]:
    """The workers that are ready, ours first, and a sentence about each that is not."""
    wanted = {"native": (sys.executable, "planner_worker.py", {}, "planner")}
    if arguments.isa == "baseline":
        environment = {**BASELINE, "NUMBA_CACHE_DIR": cache}
        wanted["baseline"] = (sys.executable, "planner_worker.py", environment, "planner, plain x86-64")
    absent = []
    if arguments.crocoddyl:
        wanted["crocoddyl"] = (arguments.crocoddyl, "crocoddyl_worker.py", {}, "Crocoddyl")
    else:
        absent.append(f"Crocoddyl: {PINS}  (in an environment of its own: --crocoddyl ITS_PYTHON)")
    if arguments.casadi:
        wanted["casadi"] = (arguments.casadi, "casadi_worker.py", {}, "CasADi + fatrop")
    else:
        absent.append("CasADi + fatrop: pip install casadi  (--casadi ITS_PYTHON)")
    ready = {}
    for name, (python, script, environment, label) in wanted.items():
        worker = Worker(python, script, {**SINGLE_THREAD, **environment}, label)
        if "version" in worker.hello:
            ready[name] = worker
            continue
        worker.close()
        absent.append(f"{label}: {worker.hello.get('missing') or worker.hello.get('failed')}")
    if "native" not in ready:
        sys.exit(f"planner does not start: {'; '.join(absent)}")
    return ready, absent


def parsed() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description="Rigid bodies: single iterations and whole solves, ours beside peers.")
    for name, label in (("crocoddyl", "Crocoddyl"), ("casadi", "CasADi")):
        variable = f"{name.upper()}_PYTHON"
        parser.add_argument(
            f"--{name}", metavar="PYTHON", default=os.environ.get(variable),
            help=f"interpreter of an environment that has {label} (default: ${variable})",
        )  # fmt: skip
    parser.add_argument(
        "--isa", choices=("native", "baseline"), default="native",
        help="baseline: ours once more in a process that compiles for plain x86-64, as the peers' wheels are",
    )  # fmt: skip
    parser.add_argument("--part", choices=("iterations", "solves", "start"), help="only this part")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="only these mechanisms and problems")
    parser.add_argument("--repeats", type=int, default=40, help="repetitions per row and solver (40)")
    parser.add_argument("--seconds", type=float, default=20.0, help="longest time per row and solver (20)")
    parser.add_argument("--json", action="store_true", help="JSON lines only, no tables")
    arguments = parser.parse_args()
    if arguments.repeats < 1:
        parser.error("--repeats must be at least 1")
    names = {*MECHANISMS, *(name for name, _ in SOLVE_TARGETS)}
    for name in arguments.only or ():
        if name not in names:
            parser.error(f"--only {name}: expected some of {', '.join(sorted(names))}")
    return arguments


def run(arguments: argparse.Namespace, workers: dict[str, Worker]) -> list[Answer]:
    """All rows; each is printed as JSON as soon as it is there."""
    rows: list[Answer] = []

    def keep(lines: list[Answer]) -> None:
        for line in lines:
            rows.append(line)
            print(json.dumps(finite(line)), flush=True)

    def chosen(name: str, part: str) -> bool:
        return arguments.part in (None, part) and (not arguments.only or name in arguments.only)

    for mechanism in MECHANISMS:
        for integrator in INTEGRATORS:
            if chosen(mechanism, "iterations"):
                stepping = {name: worker for name, worker in workers.items() if name != "casadi"}
                answers, checks = loaded(stepping, iteration_problem(mechanism, integrator))
                keep(checks)
                times = interleaved(stepping, "iterate", arguments.repeats, arguments.seconds)
                keep(iteration_lines(mechanism, integrator, answers, times))
    for name, integrator in SOLVE_TARGETS:
        if chosen(name, "solves"):
            problem = solve_problem(name, integrator)
            planar = [joint["name"] for joint in problem["chain"]["joints"]] == ["shoulder", "elbow"]
            solving = {name: worker for name, worker in workers.items() if planar or name != "casadi"}
            keep(loaded(solving, problem)[1])
            keep(solve_lines(problem, solving, interleaved(solving, "solve", arguments.repeats, arguments.seconds)))
    if chosen(NAME, "start"):
        keep(start_lines())
    return rows


def isa_sentence(worker: Worker) -> tuple[bool, str]:
    """Whether the baseline process compiled what it should, by its assembly, and a sentence about it."""
    found = worker.ask("registers")
    if "failed" in found:
        return False, f"cannot be read ({found['failed']})"
    plain = found["kernels"] > 0 and not (found["zmm"] or found["ymm"] or found["fused"])
    return plain, (
        f"{'plain' if plain else 'NOT PLAIN'} x86-64: {found['kernels']} kernels use xmm {found['xmm']}, "
        f"ymm {found['ymm']}, zmm {found['zmm']} times, fused multiply-add {found['fused']} times"
    )


def main() -> None:
    """Run, print, and exit with 1 where the sides do not solve the same problem."""
    arguments = parsed()
    with tempfile.TemporaryDirectory() as cache:
        workers, absent = started(arguments, cache)
        hello = workers["native"].hello
        if not arguments.json:
            versions = ", ".join(f"{worker.label} {worker.hello['version']}" for worker in workers.values())
            print(f"{versions}; compiled for {hello['cpu']}, widest registers {hello['widest']}")
        rows = run(arguments, workers)
        plain, sentence = isa_sentence(workers["baseline"]) if "baseline" in workers else (True, "")
        for worker in workers.values():
            worker.close()
    if not arguments.json:
        print(table(rows))
        if sentence:
            print(f"\nbaseline: {sentence}")
        if absent:
            print("\nabsent\n" + "\n".join(absent))
    elif absent or sentence:
        print("\n".join([*absent, *[sentence] * bool(sentence)]), file=sys.stderr)
    sys.exit(0 if plain and all(line.get("agrees", True) for line in rows) else 1)


if __name__ == "__main__":
    main()
