"""Plant a fault in a copy of the tree and see whether the fast tests notice.

    python benchmarks/planted_faults.py [NAME ...]

Each fault is a patch of one line: a sign, an index, a unit, a factor, a stage too early or too late, a dropped term.
The line is looked for in all of planner/, so a fault follows code that moves to another file. The tests named with it
run without the slow ones; a fault that they do not notice is a hole in the tests. Kernels are compiled anew for each
fault in them, so all take about half an hour. Exit code 1 if more than two are missed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
MISSED_ALLOWED = 2  # of the faults below; none is expected


class Fault(NamedTuple):
    """One wrong line, and the folders or files of tests that should notice it."""

    name: str
    kind: str
    right: str
    wrong: str
    tests: str


FAULTS = (
    Fault(
        "riccati-gradient",
        "sign",
        "weighted_rows(at(s, first), at(s, first), s, (M, first, width), nu, -1.0, columns)  # Eq. 34",
        "weighted_rows(at(s, first), at(s, first), s, (M, first, width), nu, 1.0, columns)  # Eq. 34",
        "tests/kernels/test_lq.py tests/solvers/test_slq.py",
    ),
    Fault(
        "costate-stage",
        "stage",
        "n * width, at(c, (n + 1) * width + first)",
        "n * width, at(c, n * width + first)",
        "tests/kernels/test_lq.py tests/dynamics/test_second_order.py",
    ),
    Fault(
        "gravcomp-derivative",
        "dropped term",
        "- dot(sw, cross(h, z)) - load(mass, i) * dot(sv, z))",
        "- dot(sw, cross(h, z)))",
        "tests/dynamics/test_gravity_compensation.py",
    ),
    Fault(
        "friction-rate",
        "sign",
        "x = inertia / loss * (a + load(value, o + RATE) * v)",
        "x = inertia / loss * (a - load(value, o + RATE) * v)",
        "tests/dynamics/test_friction.py",
    ),
    Fault(
        "hopper-rk4-weight",
        "factor",
        "y1 = y + w * (v + 2.0 * v2 + 2.0 * v3 + v4)",
        "y1 = y + w * (v + 2.0 * v2 + v3 + v4)",
        "tests/dynamics/test_hopper_dynamics.py",
    ),
    Fault(
        "hopper-tangent",
        "factor",
        "a4 = s4 * (p1 - (y + dt * v3))",
        "a4 = s4 * (p1 - (y + h * v3))",
        "tests/dynamics/test_hopper_dynamics.py",
    ),
    Fault(
        "tilt-derivative",
        "sign",
        "store(row, MAX_ROWS * j, -1.0 * dot(sw, normal))",
        "store(row, MAX_ROWS * j, dot(sw, normal))",
        "tests/kernels/test_residual_engine.py tests/solvers/test_constraint_engines.py",
    ),
    Fault(
        "position-derivative",
        "dropped term",
        "add(load3(ws, b + 3), cross(sw, c))\n        store3(row",
        "load3(ws, b + 3)\n        store3(row",
        "tests/kernels/test_residual_engine.py",
    ),
    Fault(
        "rosenbrock-second-stage",
        "factor",
        "store(behind, i, 2.0 * load(implicit, i) * load(a, i))",
        "store(behind, i, load(implicit, i) * load(a, i))",
        "tests/dynamics/test_rosenbrock.py",
    ),
    Fault(
        "link-velocity",
        "sign",
        "speeds = moving + np.cross(spin, places - origin)",
        "speeds = moving - np.cross(spin, places - origin)",
        "tests/dynamics",
    ),
    Fault(
        "momentum-axes",
        "index",
        'own = np.einsum("klji,klj->kli", R, spin)',
        'own = np.einsum("klij,klj->kli", R, spin)',
        "tests/dynamics",
    ),
    Fault(
        "energy-stage",
        "stage",
        "k = width + first + i",
        "k = first + i",
        "tests/problem",
    ),
    Fault(
        "multiplier-side",
        "sign",
        "penalties.lower - self.lower, self.upper - penalties.upper",
        "penalties.lower - self.lower, penalties.upper - self.upper",
        "tests/solvers tests/problem/test_limits.py",
    ),
    Fault(
        "warm-start-knot",
        "index",
        "xs[share == 1.0] = self.xs[n + 1][share == 1.0]",
        "xs[share == 1.0] = self.xs[n][share == 1.0]",
        "tests/solvers tests/problem",
    ),
    Fault(
        "ros-time",
        "unit",
        "round(float(t) * 1e9)",
        "round(float(t) * 1e6)",
        "tests/problem/test_export.py",
    ),
    Fault(
        "transition-order",
        "index",
        "F[n] @ phi, F[n] @ error",
        "phi @ F[n], F[n] @ error",
        "tests/proof",
    ),
    Fault(
        "parallel-axis",
        "dropped term",
        "body.mass * (d @ d * np.eye(3) - np.outer(d, d))",
        "body.mass * (d @ d * np.eye(3))",
        "tests/model/test_urdf_masses.py tests/model/test_urdf.py",
    ),
    Fault(
        "latency-part",
        "stage",
        "None if whole else np.array([left]))[0]",
        "None if whole else np.array([dt]))[0]",
        "tests/control",
    ),
    Fault(
        "quaternion-order",
        "index",
        "log_quaternion(product(conjugate(x_ref[..., i : i + 4]), x[..., i : i + 4]))",
        "log_quaternion(product(x[..., i : i + 4], conjugate(x_ref[..., i : i + 4])))",
        "tests/model/test_space.py",
    ),
    Fault(
        "final-cost",
        "factor",
        "return 0.5 * float(e @ self.Q[-1] @ e)",
        "return float(e @ self.Q[-1] @ e)",
        "tests/problem tests/solvers",
    ),
)


def patched(tree: Path, fault: Fault) -> Path:
    """Plant the fault; the file that it is in."""
    found = [path for path in sorted((tree / "planner").rglob("*.py")) if fault.right in path.read_text("utf-8")]
    if len(found) != 1 or found[0].read_text("utf-8").count(fault.right) != 1:
        raise SystemExit(f"{fault.name}: the line stands in {len(found)} files, expected once in one: {fault.right}")
    found[0].write_text(found[0].read_text("utf-8").replace(fault.right, fault.wrong), "utf-8")
    return found[0].relative_to(tree)


def noticed(fault: Fault, everything: bool) -> tuple[bool, Path, str]:
    """Whether a fast test fails with the fault; the file patched, and the first test that failed."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        names = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split(
            "\n"
        )
        for name in filter(None, names):
            if not name.startswith(("renders/", "docs/")) and (ROOT / name).is_file():
                (tree / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, tree / name)
        where = patched(tree, fault)
        tests = ["tests"] if everything else fault.tests.split()
        environment = os.environ | {"PYTHONPATH": str(tree), "NUMBA_CACHE_DIR": str(tree / ".numba")}
        if "kernels" not in where.parts:
            environment.pop("NUMBA_CACHE_DIR")  # the kernels are the same: use those that are compiled
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow", "-p", "no:cacheprovider", *tests]
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
        failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        return done.returncode == 1, where, failed[0].split(" - ")[0] if failed else ""


def main() -> int:
    """Plant the faults named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="which faults; default: all")
    parser.add_argument(
        "--all-tests", action="store_true", help="run all fast tests, not only those named with a fault"
    )
    parser.add_argument("--list", action="store_true", help="list the faults and check that their lines are there")
    arguments = parser.parse_args()
    chosen = [fault for fault in FAULTS if not arguments.names or fault.name in arguments.names]
    missed = 0
    for fault in chosen:
        began = time.monotonic()
        if arguments.list:
            lines = sum(path.read_text("utf-8").count(fault.right) for path in (ROOT / "planner").rglob("*.py"))
            count = "" if lines == 1 else f"stands {lines} times: "
            print(f"{fault.name:24} {fault.kind:12} {count}{fault.right.strip()}")
            continue
        found, where, test = noticed(fault, arguments.all_tests)
        missed += not found
        seconds = time.monotonic() - began
        print(f"{fault.name:24} {'noticed' if found else 'MISSED':8} {seconds:5.0f} s  {where}  {test}", flush=True)
    if not arguments.list:
        print(f"{len(chosen) - missed} of {len(chosen)} faults noticed by the fast tests")
    return int(missed > MISSED_ALLOWED)


if __name__ == "__main__":
    sys.exit(main())
