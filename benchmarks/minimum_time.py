"""The least time of a seven-joint arm within torques and speeds, beside toppra: `python benchmarks/minimum_time.py`.

    pip install toppra     # into this environment, or name the site-packages of another by --toppra

The arm is examples/tasks/arm.xml without damping, which toppra's torque limits do not know. toppra takes the straight
line in joint space, with our inverse dynamics; ours is planned twice by solve_for(..., "time") with 60 stages, the
model's torques and ranges and the speeds below: free of any path, and on that line, as a constraint of the distances
across it. One JSON line: durations, seconds of the processor (ours the best of three), and what each duration took.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import planner
from planner.cases.problem_file import load

ARM = Path(__file__).parent.parent / "examples" / "tasks" / "arm.xml"
START = [0.0, 0.3, 0.0, 1.5, 0.0, 1.2, 0.0]
GOAL = [1.2, 0.8, 0.4, 0.6, -0.5, 0.4, 0.8]
SPEEDS = [2.0, 2.0, 2.5, 2.5, 3.0, 3.0, 3.0]  # rad/s
BETWEEN = (0.4, 2.0)  # s
STAGES, REPEATS, GRID = 60, 3, 201
OFF = 1e-3  # rad, off the line


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--toppra", help="site-packages that have it")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "arm.xml"
        model.write_text(re.sub(r' damping="[\d.]+"', "", ARM.read_text(encoding="utf-8")), encoding="utf-8")
        mechanism = planner.Mechanism.from_mjcf(model)
        problem = asked(Path(folder), mechanism)
    line: dict[str, Any] = {
        "kind": "minimum time",
        "ours": ours(problem),
        "ours_on_the_line": ours(on_the_line(problem)),
    }
    line["toppra"] = theirs(mechanism, options.toppra)
    if "duration" in line["toppra"]:
        for name in ("ours", "ours_on_the_line"):
            line[f"{name}_over_toppra"] = line[name]["duration"] / line["toppra"]["duration"]
    print(json.dumps(line))


def asked(folder: Path, mechanism: planner.Mechanism) -> planner.Problem:
    """The arm from start to goal within its torques, ranges and the speeds."""
    speeds = ", ".join(f"{name} = {speed}" for name, speed in zip(mechanism.joint_names, SPEEDS, strict=True))
    path = folder / "arm.toml"
    path.write_text(
        f'model = "arm.xml"\nstart = {START}\ngoal = {GOAL}\nduration = 1.2\ndt = {1.2 / STAGES!r}\n'
        f'integrator = "semi-implicit-euler"\n[limits]\nvelocity = {{ {speeds} }}\n'
    )
    return load(path).problem


def on_the_line(problem: planner.Problem) -> planner.Problem:
    """The same on the straight line in joint space: what is across it stays 0."""
    start, way = np.array(START), np.subtract(GOAL, START)
    across = np.linalg.svd(way[None])[2][1:]  # (6, 7)
    by_x = np.hstack([across, np.zeros((6, 7))])
    kept = planner.Constraint(
        lambda xs: (xs[:, :7] - start) @ across.T, equal=np.zeros(6), tolerance=OFF, name="line", unit="rad",
        derivatives=lambda xs: np.broadcast_to(by_x, (len(xs), 6, 14)),
    )  # fmt: skip
    return replace(problem, constraints=[*problem.constraints, kept])


def ours(problem: planner.Problem) -> dict[str, Any]:
    """The least duration of a problem."""
    seconds = []
    for _ in range(REPEATS + 1):  # the first compiles
        tried: list[Any] = []
        began = time.process_time()
        plan = planner.solve_for(problem, "time", durations=BETWEEN, callback=tried.append)
        seconds.append(time.process_time() - began)
    found = {"duration": float(plan.t[-1]), "status": plan.status.name, "seconds": min(seconds[1:])}
    found["tried"] = [[round(one.duration, 4), one.iterations, one.status.name] for one in tried]
    return found


def theirs(mechanism: planner.Mechanism, folder: str | None) -> dict[str, Any]:
    """The least duration along the straight line."""
    if folder:
        sys.path.append(folder)  # behind our own NumPy
    try:
        import toppra
        from toppra import algorithm, constraint
    except ImportError:
        return {"failed": "toppra is not installed"}
    toppra.setup_logging("ERROR")
    most, speeds = np.array([80.0, 80.0, 40.0, 40.0, 12.0, 12.0, 12.0]), np.array(SPEEDS)

    def torque(*motion: np.ndarray) -> np.ndarray:
        return planner.dynamics.rnea(mechanism, *(np.asarray(part, float)[None] for part in motion))[0]

    limits = [
        constraint.JointVelocityConstraint(np.c_[-speeds, speeds]),
        constraint.JointTorqueConstraint(torque, np.c_[-most, most], np.zeros(7)),
    ]
    began = time.process_time()
    way = toppra.SplineInterpolator([0.0, 1.0], np.array([START, GOAL]))
    grid = np.linspace(0.0, 1.0, GRID)
    motion = algorithm.TOPPRA(limits, way, gridpoints=grid, solver_wrapper="seidel").compute_trajectory(0.0, 0.0)
    return {"duration": float(motion.duration), "seconds": time.process_time() - began}


if __name__ == "__main__":
    main()
