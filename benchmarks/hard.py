"""Hard problems from random starts: the share solved within the goal, and the median time, with and without relaxation.

    python benchmarks/hard.py [--starts 20] [--only cart-1] [--seed 7]

Half of the starts are the same at each run, the others are drawn anew from a seed that is printed. A start is a smooth
random change of zero controls with the size of their limits. A solve counts where it converges within the goal's
tolerance; one that does not counts ten times the longest solve of its row. Processor time, one thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import planner
from planner.solvers.multistart import smooth

POLE = """<body pos="{at}"><joint name="pole{i}" axis="0 1 0" damping="0.01"/>
<geom type="capsule" size="0.02" mass="0.2" fromto="0 0 0 0 0 -0.5"/>"""
PENALTY = 10.0  # times the longest solve, for one that is not solved
DT = 0.02


def swing_up(
    poles: int, limit: float, duration: float, driven: str = "slider", rail: float = np.inf
) -> planner.Problem:
    """Poles in series on a cart, or without one where the first or the last pole is driven, from hanging to upright."""
    cart = driven == "slider"
    text = "".join(POLE.format(i=i, at="0 0 -0.5" if i else "0 0 0") for i in range(poles)) + poles * "</body>"
    if cart:
        joint = '<joint name="slider" type="slide" axis="1 0 0" damping="0.05"/><geom size="0.1" mass="1"/>'
        text = f"<body>{joint}{text}</body>"
    flag = '<flag contact="disable"/>'
    motor = f'<actuator><motor joint="{driven}"/></actuator>'
    machine = planner.Mechanism.from_mjcf(
        f"<mujoco><option>{flag}</option><worldbody>{text}</worldbody>{motor}</mujoco>"
    )
    N, n = round(duration / DT), poles + cart
    goal = np.zeros(2 * n)
    goal[int(cart)] = np.pi
    weights = {"final_position": 1e4, "final_velocity": 1e3, "effort": 1.0 / limit**2}
    cost = planner.TrackingCost.joints(machine, goal, N, dt=DT, **weights)
    ranges = {"slider": (-rail, rail)} if np.isfinite(rail) else None
    limits = planner.Limits(control=limit, position=ranges)
    return planner.Problem(planner.RigidBodyDynamics(machine, DT, "rk4"), cost, np.zeros(2 * n), limits=limits)


PROBLEMS: dict[str, Callable[[], planner.Problem]] = {
    "pendulum, 0.25 N m, 4 s": lambda: swing_up(1, 0.25, 4.0, "pole0"),
    "pendulum, 0.15 N m, 5 s": lambda: swing_up(1, 0.15, 5.0, "pole0"),
    "pendulum, 0.10 N m, 7 s": lambda: swing_up(1, 0.10, 7.0, "pole0"),
    "cart-1, 5 N, 2.5 s": lambda: swing_up(1, 5.0, 2.5),
    "cart-1, 3 N, 4 s, rail": lambda: swing_up(1, 3.0, 4.0, rail=0.4),
    "cart-2, 20 N, 2 s": lambda: swing_up(2, 20.0, 2.0),
    "cart-2, 12 N, 3 s, rail": lambda: swing_up(2, 12.0, 3.0, rail=0.6),
    "cart-3, 40 N, 2.5 s": lambda: swing_up(3, 40.0, 2.5),
    "acrobot, 1 N m, 4 s": lambda: swing_up(2, 1.0, 4.0, "pole1"),
    "pendubot, 1 N m, 4 s": lambda: swing_up(2, 1.0, 4.0, "pole0"),
}


def main() -> None:
    """One line per problem and way."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument("--only", default="")
    parser.add_argument("--seed", type=int, default=None)
    options = parser.parse_args()
    drawn = int(np.random.SeedSequence(options.seed).entropy) % 2**32  # pyright: ignore[reportArgumentType]
    print(f"{options.starts} starts, half of them of seed {drawn}")
    for name, build in PROBLEMS.items():
        if name.startswith(options.only):
            problem = build()
            planner.solve(problem, max_iterations=1)  # compiled
            for way, homotopy in (("direct", False), ("relaxed", True)):
                _measure(f"{name}, {way}", problem, homotopy, options.starts, drawn)


def _measure(name: str, problem: planner.Problem, homotopy: bool, starts: int, drawn: int) -> None:
    """Solve from all starts and print."""
    assert problem.bounds is not None
    settings, seconds, solved = planner.SolverOptions(homotopy=homotopy), list[float](), list[bool]()
    durations = 0
    for k in range(starts):
        rng = np.random.default_rng([k % 2 * drawn, k])
        us = problem.bounds.upper * smooth(rng, (problem.N, problem.dynamics.nu))
        began = time.process_time()
        plan = planner.solve(replace(problem, us=us), settings)
        seconds.append(time.process_time() - began)
        solved.append(plan.success and not plan.missed_goals)
        durations += "duration" in plan.options.get("relaxation", {})
    worst = PENALTY * max(seconds)
    median = np.median([one if ok else worst for one, ok in zip(seconds, solved, strict=True)])
    print(
        f"{name}: {sum(solved)} of {starts} solved, {durations} name a longer duration that passes, "
        f"median penalized time {median:.2f} s", flush=True,
    )  # fmt: skip


if __name__ == "__main__":
    main()
