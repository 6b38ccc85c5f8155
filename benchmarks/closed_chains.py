"""Closed chains: an iteration beside that of the open tree, and beside Crocoddyl's constrained forward dynamics.

python benchmarks/closed_chains.py [--crocoddyl ITS_PYTHON]

Ratios of minima of processor time in one run, one thread, 100 stages of RK4. The open tree is the same machine without
its equalities, from the same controls. Beside Crocoddyl: an arm of seven joints whose hand is pinned to the world, a
contact in three directions (DifferentialActionModelContactFwdDynamics) with the same pull back. Both sides linearize,
sweep and roll out; Crocoddyl tries one step, we four.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from problems import SINGLE_THREAD
from serving import Worker

MAX_OF_OPEN, MIN_OF_PEER = 2.0, 4.0
N, DT, ROUNDS, REPEATS = 100, 0.01, 10, 10
EXAMPLES = Path(__file__).parents[1] / "examples" / "closed_chains"
PINS = "pip install crocoddyl==3.2.1 pin==4.0.0 libpinocchio==4.0.0"


def arm() -> str:
    """Seven joints about changing axes, and a hand that is pinned where it is at home."""
    axes = ("0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0", "1 0 0")
    body, end = "", ""
    for k, axis in enumerate(axes):
        body += f"""<body name="l{k}" pos="{0.02 if k else 0} 0.01 {0.2 if k else 0.1}">
          <joint name="j{k}" axis="{axis}"/>
          <inertial pos=".01 .02 .1" mass="{3.0 - 0.3 * k}" diaginertia=".02 .03 .01"/>"""
        end += "</body>"
    motors = "".join(f'<motor joint="j{k}"/>' for k in range(7))
    return f"""<mujoco><worldbody>{body}{end}</worldbody><equality><connect name="pin" body1="l6" anchor="0 0 .1"/>
        </equality><actuator>{motors}</actuator></mujoco>"""


def shortest(calls: dict[str, Callable[[], float]]) -> dict[str, float]:
    """Least time of calls that return theirs, ms; they are called in turn."""
    best = dict.fromkeys(calls, math.inf)
    for _ in range(ROUNDS * REPEATS):
        for name, call in calls.items():
            best[name] = min(best[name], 1e3 * call())
    return best


def engine_of(mechanism: Any, x0: np.ndarray, u: np.ndarray) -> Any:
    """An engine after its first sweep, from constant controls, of a cost that weighs all states and controls."""
    from planner import Problem, RigidBodyDynamics, TrackingCost
    from planner.solvers.engine import acquire_engine

    dynamics = RigidBodyDynamics(mechanism, DT)
    weights = {"effort": 1e-3, "position": 1.0, "velocity": 0.1, "final_position": 10.0, "final_velocity": 1.0}
    cost = TrackingCost.joints(dynamics, x0, N, **weights)
    problem = Problem(dynamics, cost, x0, us=np.tile(u, (N, 1)))
    engine = acquire_engine(problem)
    engine.start_from_controls(problem.x0, problem.first_guess)
    engine.compute_direction(0.0, True)
    return engine


def iteration(engine: Any) -> Callable[[], float]:
    """Linearize along the trajectory of the first controls, sweep, and four steps of the line search; in s."""
    w, dynamics, memory = engine._w, engine._dynamics, engine._memory
    x0, us = w.xs[0].copy(), w.us.copy()

    def once() -> float:
        engine.start_from_controls(x0, us)  # an open tree falls apart: the search's trajectory is none to go on from
        began = time.process_time()
        dynamics.linearize_nominal(w, memory)
        engine.compute_direction(0.0, False)
        dynamics.search(w, memory, 0, True, math.inf, -1.0)
        return time.process_time() - began

    return once


def beside_open() -> bool:
    """Our examples beside their open trees."""
    from planner import Mechanism
    from planner.dynamics import assembled
    from planner.dynamics.quasi_static import quasi_static_controls

    fine = True
    for path in sorted(EXAMPLES.glob("*.xml")):
        closed = Mechanism.from_mjcf(path)
        x0 = assembled(closed, closed.home)
        u = quasi_static_controls(closed, x0)
        machines = {"closed": closed, "open": replace(closed, loops=(), polynomial_couplings=())}
        times = shortest({name: iteration(engine_of(m, x0, u)) for name, m in machines.items()})
        ratio = times["closed"] / times["open"]
        fine &= ratio <= MAX_OF_OPEN
        print(f"{path.stem}: {times['closed']:.3g} ms closed, {times['open']:.3g} ms open, {ratio:.2f} times "
              f"(at most {MAX_OF_OPEN:g})")  # fmt: skip
    return fine


def beside_crocoddyl(python: str) -> bool:
    """A pinned arm beside Crocoddyl."""
    from planner import Mechanism
    from planner.dynamics import assembled
    from planner.dynamics.quasi_static import quasi_static_controls
    from planner.model.couplings import BAUMGARTE_RATE

    m, rng = Mechanism.from_mjcf(arm()), np.random.default_rng(0)
    x0 = assembled(m, m.home + np.append(0.2 * rng.normal(size=7), np.zeros(7)))
    u, probe = quasi_static_controls(m, x0), rng.normal(size=7)
    engine = engine_of(m, x0, u)
    ours = engine._dynamics.rates(x0[None], probe[None])[0, 7:]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(arm().split("<equality>")[0] + "</mujoco>", encoding="utf-8")
        place = [float(x) for x in (engine._dynamics.mechanism.loops[0].frames[1][:3, 3])]
        worker = Worker(python, "closed_chains_crocoddyl.py", SINGLE_THREAD, "Crocoddyl")
        theirs = worker.ask("load", model=str(path), x0=x0.tolist(), u=u.tolist(), probe=probe.tolist(), N=N, dt=DT,
                            rate=BAUMGARTE_RATE, place=place)  # fmt: skip
        if "failed" in theirs:
            print(f"Crocoddyl: {theirs['failed']}")
            return False
        apart = np.abs(ours - theirs["acceleration"]).max() / np.abs(ours).max()
        best = [math.inf, math.inf]
        for _ in range(ROUNDS):
            best[0] = min(best[0], shortest({"ours": iteration(engine)})["ours"])
            best[1] = min(best[1], 1e3 * min(worker.ask("iterate", repeats=REPEATS, seconds=5.0)["times"]))
    print(f"pinned arm: {best[0]:.3g} ms ours, {best[1]:.3g} ms Crocoddyl's, {best[1] / best[0]:.1f} times faster (at "
          f"least {MIN_OF_PEER:g}); accelerations agree to {apart:.1e}")  # fmt: skip
    return bool(best[1] >= MIN_OF_PEER * best[0] and apart < 1e-8)


def main() -> int:
    """Exit code 1 where a bound is missed."""
    parser = argparse.ArgumentParser(description="Closed chains: iterations beside open trees and Crocoddyl.")
    parser.add_argument("--crocoddyl", metavar="PYTHON", help=f"a Python with {PINS}")
    given = parser.parse_args()
    fine = beside_open()
    if given.crocoddyl is None:
        print(f"Crocoddyl left out: --crocoddyl PYTHON, of an environment with {PINS}")
    else:
        fine &= beside_crocoddyl(given.crocoddyl)
    return 0 if fine else 1


if __name__ == "__main__":
    os.environ.update(SINGLE_THREAD)
    sys.exit(main())
