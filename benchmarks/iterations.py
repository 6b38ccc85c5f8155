"""Iterations with limits and constraints beside those without: `python benchmarks/iterations.py [--robots FOLDER]`.

The target is MAX_RATIO times as many, or MAX_ITERATIONS in all. Torques and speeds of the two-link arm are bounded by
shares of the largest ones of its free plan, from the case's own first guess, from the straight line of states and from
random starts. With the site-packages that have example-robot-data, a Panda goes from one end of its ranges to the other
within its limits. Counts depend on rounding, so a little on the processor.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import planner
from planner import Limits

TASKS = Path(__file__).parents[1] / "examples" / "tasks"
FILES = ("reach_within_limits", "swing_up", "reach_upright_cup", "around_a_post", "through_a_window")
SHARES = (0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95)
STARTS = 40
MAX_RATIO, MAX_ITERATIONS = 2.5, 30


def limit(free: planner.Plan) -> float:
    """The largest number of iterations that meets the target, beside a free plan."""
    return max(MAX_RATIO * free.nit, MAX_ITERATIONS)


def line(name: str, free: planner.Plan, held: planner.Plan) -> None:
    """One row."""
    met = held.success and held.nit <= limit(free)
    print(
        f"{name:44s}{free.nit:6d}{held.nit:8d}  {held.status.name:14s}{held.cost:12.6g}  {'met' if met else 'missed'}"
    )


def from_random_starts(problem: planner.Problem, torques: np.ndarray, most: float, share: float) -> None:
    """One row of many solves."""
    limited = replace(problem, limits=Limits(control=(-share * torques, share * torques)))
    starts = planner.solve(limited, starts=STARTS, seed=1, max_iterations=1000).starts
    counts = np.array([start.iterations for start in starts])
    within = int(np.sum(counts <= most))
    print(
        f"two-link, torques at {share:g}, {STARTS} random starts: median {np.median(counts):g}, most {counts.max()}, "
        f"{within} within {most:g}"
    )


def panda(folder: Path) -> planner.Problem:
    """From a twentieth of its ranges to nineteen, within its torques, ranges and speeds."""
    model = folder / "cmeel.prefix/share/example-robot-data/robots/panda_description/urdf/panda.urdf"
    mechanism = planner.Mechanism.from_urdf(model)
    lower, upper = mechanism.joint_range[:7].T
    start, goal = 0.95 * lower + 0.05 * upper, 0.05 * lower + 0.95 * upper
    ends = (
        ", ".join(f"{name} = {q:.4f}" for name, q in zip(mechanism.joint_names, end, strict=False))
        for end in (start, goal)
    )
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "panda.toml"
        lines = [f"{key} = {{ {end} }}" for key, end in zip(("start", "goal"), ends, strict=True)]
        file.write_text("\n".join([f'model = "{model}"', *lines, "duration = 2.6", "dt = 0.02"]), encoding="utf-8")
        return planner.load_problem(file)


def main() -> None:
    """One row a problem."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", metavar="SITE_PACKAGES", type=Path, help="folder that has example-robot-data")
    robots = parser.parse_args().robots
    print(f"{'':44s}{'free':>6s}{'held':>8s}  {'status':14s}{'cost':>12s}  target")
    for name in FILES:
        problem = planner.load_problem(TASKS / f"{name}.toml")
        line(name, planner.solve(replace(problem, limits=None, constraints=())), planner.solve(problem))
    if robots is not None:
        problem = panda(robots)
        line("a Panda from end to end", planner.solve(replace(problem, limits=None)), planner.solve(problem))
    problem = planner.cases.two_link(horizon=100)
    guesses: tuple[dict[str, Any], ...] = ({}, {"states": "line"})
    for guess in guesses:
        free = planner.solve(problem, **guess)
        torques, speeds = np.abs(free.us).max(axis=0), np.abs(free.xs[:, 2:]).max(axis=0)
        for share in SHARES:
            bounded = {"torque": Limits(control=(-share * torques, share * torques))}
            names = problem.dynamics.mechanism.joint_names
            bounded["speed"] = Limits(velocity=dict(zip(names, share * speeds, strict=True)))
            for kind, limits in bounded.items():
                held = planner.solve(replace(problem, limits=limits), **guess)
                line(f"two-link, {kind}s at {share:g}{', from a line' if guess else ''}", free, held)
    free = planner.solve(problem)
    for share in SHARES:
        from_random_starts(problem, np.abs(free.us).max(axis=0), limit(free), share)


if __name__ == "__main__":
    main()
