"""How long `planner run` takes with a machine: to the plan, from there to the verdict, and to all files.

`python benchmarks/runs.py [MACHINE or PROBLEM.toml ...]`: by default those of this project, and closed chains.
`python benchmarks/runs.py --processor` measures the least processor time of commands that have a target instead.
Bars: the verdict at most 2 s after the plan, all files within 40 s on two idle cores. Each run is a process of its own.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from planner.cases import CASES

CHAINS = sorted((Path(__file__).parent.parent / "examples" / "closed_chains").glob("*.toml"))
VERDICT, FILES = 2.0, 40.0  # s
PROCESSOR = {"solve two-link": 0.75, "run puma --no-video": 7.0, "run hopper": 18.0}  # s, at most


def spent() -> float:
    """Processor time of all child processes so far, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def measure(machine: str) -> tuple[float, float, float, float]:
    """Seconds to the plan, from it to the verdict, and to the end; and processor seconds of all that."""
    began, before, plan, verdict = time.monotonic(), spent(), 0.0, 0.0
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-u", "-m", "planner", "run", machine, "--out", folder]
        with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
            assert process.stdout is not None
            for line in process.stdout:
                if " iterations, cost " in line:
                    plan = time.monotonic() - began
                elif line.startswith(("before the perturbed simulations: ", "PASS", "FAIL")) and not verdict:
                    verdict = time.monotonic() - began
        return plan, verdict - plan, time.monotonic() - began, spent() - before


def measure_processor(runs: int = 3) -> None:
    """Print the least processor time of commands, their child processes included, beside what was asked.

    With bytecode, as an installed package has it, also where the environment asks for none.
    """
    print("| command | least processor time, s | asked, s |")
    print("|---|---:|---:|")
    bytecode = tempfile.TemporaryDirectory()
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPYCACHEPREFIX"] = bytecode.name
    for command, asked in PROCESSOR.items():
        taken = []
        for _ in range(runs + 1):  # the first one may compile kernels
            before = spent()
            with tempfile.TemporaryDirectory() as folder:
                words = [sys.executable, "-m", "planner", *command.split(), "--quiet"]
                subprocess.run(words, cwd=folder, env=environment, stdout=subprocess.DEVNULL, check=True)
            taken.append(spent() - before)
        print(f"| `planner {command}` | {min(taken[1:]):.2f} | {asked:g} |", flush=True)


def main() -> None:
    """Measure each and say which bars are met."""
    if "--processor" in sys.argv:
        measure_processor()
        return
    print("| machine | plan, s | verdict after it, s | all files, s | processor, s | load | bars |")
    print("|---|---:|---:|---:|---:|---:|---|")
    for machine in sys.argv[1:] or [*CASES, *map(str, CHAINS)]:
        plan, verdict, files, used = measure(machine)
        met = "met" if verdict <= VERDICT and files <= FILES else "not met"
        cells = f"{plan:.1f} | {verdict:.1f} | {files:.1f} | {used:.1f} | {os.getloadavg()[0]:.1f} | {met}"
        print(f"| {Path(machine).stem} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
