"""Try `planner run` on machines by others, each with a problem file of four lines, and print what came of it.

    python benchmarks/robots.py --packages SITE_PACKAGES [--goals moderate] [--seed 3] [--only TEXT] [--json FILE]

The machines are files of pip packages that SITE_PACKAGES holds (robots_table.MACHINES); nothing of them is kept here,
and a package that is not there is left out. The problem files follow one rule (robots_problems). Every machine has a
child process of its own and 120 s. load: reading the files and building the problem, in a process that has imported the
package. plan: the solve. verdict: from the start of the command to its first line of verdict, imports and compiled
kernels that are read from the disk included; run twice after a change to the kernels. A verdict with "(physical)" has a
reason that lies in the machine or its file: a pose that falls over, equalities and ranges without a pose. peak: of the
joints that move by at least MOVES of their range, the largest peak speed beside that of a minimum-jerk motion of the
same displacement and duration. with gains: the largest error of the path in the machine's file with the plan's gains,
over its bound.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from robots_goals import SHARE, Goals  # noqa: E402 (beside this file)
from robots_problems import problem_text  # noqa: E402
from robots_table import KINDS, MACHINES, Machine  # noqa: E402

LIMIT = 120.0  # s for a machine
MOVES = 0.05  # of a range
MIN_JERK_PEAK = 1.875  # times displacement / duration
MOST_PEAK = 3.0  # times that of minimum jerk: more needs a reason
WITH_GAINS = "path_with_gains_over_its_bound"
PHYSICAL = (  # words of the reasons that lie in a machine or its file, and not in the planner
    "contradicts itself", "No plan stays at the goal", "does not balance by itself", "No duration lets the actuators",
    "overlap or lie flush at the start", "overlap by", "in the goal itself",
    "equalities and ranges of the file together leave", "The equalities of your file give", "has the inertia of",
)  # fmt: skip
VERDICT = re.compile(r"^(PASS|FAIL)\b")
CHILD = """
import sys, time
from planner.__main__ import main
code = main(["run", sys.argv[1], "--no-video", "--rollouts", "0", "--json", "--out", sys.argv[2]])
began = time.perf_counter()
if code != 2:
    from planner.cases.problem_file import load
    load(sys.argv[1])
print(f"@load {time.perf_counter() - began:.4f}", file=sys.stderr)
if code != 2:
    from robots import peak
    print(f"@peak {peak(sys.argv[2])}", file=sys.stderr)
sys.exit(code)
"""


@dataclass
class Row:
    """What came of one machine; times in s, None where it did not get so far."""

    package: str
    machine: str
    kind: str
    joints: int | None
    verdict: str  # PASS, FAIL, refused or "no verdict"
    message: str
    load: float | None = None
    plan: float | None = None
    verdict_seconds: float | None = None
    peak: float | None = None  # speed, times that of a minimum-jerk motion
    with_gains: float | None = None  # error of the path in the file, over its bound
    cure: str = ""  # the first that a FAIL names

    @property
    def is_physical(self) -> bool:
        """Whether what is said names a reason of the machine or its file, for which no plan passes."""
        return self.verdict != "PASS" and any(words in f"{self.message} {self.cure}" for words in PHYSICAL)


def tried(machine: Machine, packages: Path, limit: float = LIMIT, goals: Goals | None = None) -> Row:
    """Write the machine's problem file and run it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            text = problem_text(packages / machine.path, machine.kind, folder, goals)
        except Exception as error:  # a file that MuJoCo cannot read is a row, too
            return Row(*_words(machine), None, "no problem", _line(str(error)))
        (folder / "problem.toml").write_text(text)
        row = _run(machine, folder, limit)
        for place in (packages, folder):  # a table is to be the same everywhere
            row.message = row.message.replace(f"{place}/", "")
        return row


def _run(machine: Machine, folder: Path, limit: float) -> Row:
    places = os.pathsep.join((str(ROOT), str(ROOT / "benchmarks")))
    environment = os.environ | {"PYTHONPATH": places, "PYTHONWARNINGS": "ignore"}
    began = time.perf_counter()
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(folder / "problem.toml"), str(folder / "out")],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
    )  # fmt: skip
    lines: list[tuple[float, str]] = []
    assert child.stderr is not None
    assert child.stdout is not None
    reader = threading.Thread(
        target=lambda: lines.extend((time.perf_counter() - began, line.rstrip()) for line in child.stderr)
    )
    timer = threading.Timer(limit, child.kill)
    reader.start(), timer.start()
    output = child.stdout.read()
    child.wait()
    timer.cancel(), reader.join()
    child.stdout.close(), child.stderr.close()
    row = Row(*_words(machine), _joints(folder / "problem.toml"), "no verdict", "")
    verdicts = [(seconds, line) for seconds, line in lines if VERDICT.match(line)]
    row.load, row.peak = (_last_number(lines, mark) for mark in ("@load", "@peak"))
    row.verdict_seconds = verdicts[0][0] if verdicts else None
    try:
        document = json.loads(output)
    except json.JSONDecodeError:
        document = {}
    if "plan" not in document:
        said = [line.removeprefix("planner: ") for _, line in lines if line.startswith("planner: ")]
        if child.returncode == 2 and said:
            row.verdict, row.message, row.load = "refused", _line(said[-1]), None
        elif time.perf_counter() - began >= limit:
            falls = next((line for _, line in lines if "does not balance by itself" in line), "")
            row.message = f"none within {limit:g} s. {_line(falls)}".rstrip()
        else:
            row.message = _line(next((line for _, line in reversed(lines) if not line.startswith("@")), ""))
        return row
    plan, proof = document["plan"], document["proof"]
    figures = {} if proof is None else proof["your_file"].get("figures", {})
    row.with_gains = figures.get(WITH_GAINS, {}).get("value")
    row.plan = document["solve_seconds"]
    row.verdict = "FAIL" if proof is None else proof["verdict"]
    row.message = _line(plan["message"] if proof is None else proof["reason"])
    if row.verdict == "PASS" and not plan["success"]:
        row.verdict, row.message = "FAIL", _line(plan["message"])
    row.cure = next((_line(one["sentence"]) for one in document.get("cures", ())), "")
    return row


def peak(folder: str) -> float | None:
    """The largest peak speed over that of minimum jerk, of the joints of a plan in a folder that move by MOVES."""
    from planner import load_plan

    plan = load_plan(Path(folder) / "plan.npz")
    assert plan.problem is not None  # planned from a problem file
    mechanism = plan.problem.dynamics.mechanism
    way = np.abs(plan.space.difference(plan.xs[-1], plan.xs[0]))[: mechanism.nv]
    width = np.ptp(mechanism.joint_range, axis=1)
    moves = np.isfinite(width) & (way > 0.0) & (way >= MOVES * width)
    speeds = np.abs(plan.xs[:, mechanism.nq : mechanism.nq + mechanism.nv]).max(axis=0)
    return float((speeds[moves] * plan.t[-1] / (MIN_JERK_PEAK * way[moves])).max()) if moves.any() else None


def _last_number(lines: list[tuple[float, str]], mark: str) -> float | None:
    words = next((line.split()[1] for _, line in reversed(lines) if line.startswith(mark)), "None")
    return None if words == "None" else float(words)


def _words(machine: Machine) -> tuple[str, str, str]:
    kind = f"{machine.kind}, URDF" if machine.path.endswith(".urdf") else machine.kind
    return machine.package, machine.name, kind


def _joints(file: Path) -> int:
    """Number of positions that the goal has."""
    return file.read_text().partition("goal = ")[2].partition("\n")[0].count(",") + 1


def _line(text: str) -> str:
    return " ".join(text.split())


def _seconds(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def _cells(row: Row, most: int) -> list[str]:
    message = row.message if len(row.message) <= most else f"{row.message[: most - 3]}..."
    message += f" To pass: {row.cure}" if row.cure else ""
    verdict = f"{row.verdict} (physical)" if row.is_physical else row.verdict
    numbers = (row.load, row.plan, row.verdict_seconds, row.peak, row.with_gains)
    words = [row.package, row.machine, row.kind, str(row.joints or ""), verdict]
    return [*words, *map(_seconds, numbers), message.replace("|", "/")]


HEADS = ["package", "machine", "kind", "positions", "verdict", "load, s", "plan, s", "verdict, s", "peak", "with gains",
         "message"]  # fmt: skip


def markdown(rows: list[Row]) -> str:
    """The table for a page; of a PASS without the sentence."""
    body = [[*_cells(row, 160)[:-1], "" if row.verdict == "PASS" else _cells(row, 160)[-1]] for row in rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (HEADS, ["---"] * len(HEADS), *body))


def summary(rows: list[Row]) -> str:
    """How many passed, by kind, and the medians over arms that did."""
    passed = [row for row in rows if row.verdict == "PASS"]
    parts = []
    for kind in KINDS:
        of_kind = [row for row in rows if row.kind.startswith(kind)]
        parts += [f"{sum(row in passed for row in of_kind)} of {len(of_kind)} ({kind})"] if of_kind else []
    physical = sum(row.is_physical for row in rows)
    text = f"{len(passed)} of {len(rows)} PASS at the first try: {', '.join(parts)}"
    text += f"; {physical} cannot, for a reason of the machine or its file" if physical else ""
    arms = [row for row in passed if row.kind.startswith("arm")]
    for word, values in (
        ("load", [row.load for row in arms]),
        ("plan", [row.plan for row in arms]),
        ("verdict", [row.verdict_seconds for row in arms]),
    ):
        known = [value for value in values if value is not None]
        text += f"; median {word} of arms {statistics.median(known):.2f} s" if known else ""
    for word, values, most in (
        (f"peak speed at most {MOST_PEAK:g} times minimum jerk's", [row.peak for row in passed], MOST_PEAK),
        ("path with gains within its bound", [row.with_gains for row in passed], 1.0),
    ):
        known = [value for value in values if value is not None]
        text += f"; {word} in {sum(value <= most for value in known)} of {len(known)} PASSes" if known else ""
    return text


def main(arguments: list[str] | None = None) -> int:
    """Try the machines and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--packages", type=Path, default=Path(sysconfig.get_paths()["purelib"]),
                        help="site-packages folder with the packages (default: this interpreter's)")  # fmt: skip
    parser.add_argument("--only", default="", help="machines whose package, kind or path has this text")
    parser.add_argument("--goals", default="small", choices=list(SHARE), help="how far they are (default small)")
    parser.add_argument("--seed", type=int, help="draws the goals of a third of the machines anew")
    parser.add_argument("--limit", type=int, default=len(MACHINES), help="at most so many machines")
    parser.add_argument("--seconds", type=float, default=LIMIT, help=f"for each machine (default {LIMIT:g})")
    parser.add_argument("--json", type=Path, help="also write the rows into a file")
    parser.add_argument("--markdown", action="store_true", help="print the table of README and docs at the end")
    given = parser.parse_args(arguments)
    asked = [one for one in MACHINES if given.only in " ".join(one)]
    present = [one for one in asked if (given.packages / one.path).is_file()]
    print(f"{len(present)} of {len(asked)} machines are in {given.packages}", flush=True)
    rows: list[Row] = []
    for machine in present[: given.limit]:
        goals = Goals.of(given.goals, given.seed, machine.path)
        rows.append(tried(machine, given.packages, given.seconds, goals))
        print("  ".join(_cells(rows[-1], 300)), flush=True)
        if given.json:
            given.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))
    if given.markdown:
        print(markdown(rows))
    print(summary(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
