"""Controllers in the loop: the times of prepare and feedback, their own Python, and Crocoddyl's one iteration beside.

    python benchmarks/loop.py [--crocoddyl PYTHON] [--no-table] [--deadlines] [--shown [NAME ...]]
                              [--packages SITE_PACKAGES]

`prepare` plans once with one iteration: the plan before is rolled out from the predicted state with its gains and its
step, then linearized and swept. `feedback` answers the measurement. What prepare takes beside its kernels is counted
within the same calls: the compiled calls are timed, and what is left of the whole is Python's.
Crocoddyl has one iteration, from a trajectory: derivatives, sweep and one rollout. One core each, by turns in one run,
medians and minima: on a computer that does other things, too, minima tell more.

--deadlines counts the calls of seven joints that are over their period: with motors at 500 Hz, with servos at 200 Hz.

--shown drives the machines that docs/loop.md shows, all or by name, with figures of each (loop_shown).
"""

from __future__ import annotations

import argparse
import os
import re
import tempfile
import time
from pathlib import Path
from typing import Any

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402
from loop_shown import SHOWN, drive  # noqa: E402
from planner_worker import posed  # noqa: E402
from rigid_body_problems import EULER, cart_pole_problem, iteration_problem, probes  # noqa: E402
from serving import Worker  # noqa: E402

import planner  # noqa: E402
from planner.dynamics import rigid_body  # noqa: E402
from planner.solvers.engine import compiled, protocol  # noqa: E402

REPEATS, ROUNDS = 60, 5
SIZES = {"2r": 50, "cart-pole": 50, "arm7": 50, "humanoid": 40}
# Where a plan's compiled calls are looked up.
CALLED: list[tuple[Any, str]] = [
    (rigid_body.tree_search, "search_step"), (rigid_body.tree_linearize, "linearize_structured"),
    (compiled, "gradients"), (protocol, "load_tracked"), (protocol, "store_tracked"),
]  # fmt: skip


def problem_of(name: str) -> dict[str, Any]:
    """The problem of an iteration, as JSON, over so many stages."""
    N = SIZES[name]
    if name == "cart-pole":
        return cart_pole_problem(N)
    problem = iteration_problem(name, EULER)
    return problem | {"N": N, "us": problem["us"][:N]}


def controller_of(problem: dict[str, Any]) -> planner.Controller:
    """Our controller of it, begun with a plan of a few iterations."""
    own = posed(problem)
    return planner.Controller(own, plan=planner.solve(own, max_iterations=20))


def call_times(controller: planner.Controller, repeats: int, rng: np.random.Generator, kernels: Any) -> np.ndarray:
    """Seconds (repeats, 3) of prepare, of feedback and of the kernels in prepare, one stage apart.

    The machine moves in the plan's own dynamics with a little noise.
    """
    dynamics, times = controller.problem.dynamics, np.empty((repeats, 3))
    controller.reset()
    x, space = controller.problem.x0, controller.plan.space
    for k in range(repeats):
        kernels.seconds = 0.0
        began = time.perf_counter()
        controller.prepare(k * dynamics.dt)
        prepared, inside = time.perf_counter(), kernels.seconds
        u = controller.feedback(x)
        times[k] = prepared - began, time.perf_counter() - prepared, inside
        x = space.integrate(dynamics.step(x[None], u[None])[0], 1e-4 * rng.standard_normal(space.ndx))
    if controller.failures:
        print(f"  {controller.failures} solves failed: {controller.events[0]}")
    return times


class Kernels:
    """The compiled calls of an engine's plan, which it counts the seconds of while a controller is called."""

    def __init__(self, controller: planner.Controller) -> None:
        self.seconds, engine = 0.0, controller._replanner.engine
        engine._riccati = self._timed(engine._riccati)  # type: ignore[attr-defined]

    def _timed(self, kernel: Any) -> Any:
        def call(*arguments: Any) -> Any:
            began = time.perf_counter()
            done = kernel(*arguments)
            self.seconds += time.perf_counter() - began
            return done

        return call

    def __enter__(self) -> Kernels:
        """Count from here on."""
        self._before = [(module, name, getattr(module, name)) for module, name in CALLED]
        for module, name, kernel in self._before:
            setattr(module, name, self._timed(kernel))
        return self

    def __exit__(self, *_: object) -> None:
        """Count no more."""
        for module, name, kernel in self._before:
            setattr(module, name, kernel)


def compare(python: str) -> None:
    """The table of calls, what they take beside their kernels, and Crocoddyl."""
    worker = Worker(python, "crocoddyl_worker.py", {"OMP_NUM_THREADS": "1"}, "Crocoddyl") if python else None
    if worker is not None:
        print(f"Crocoddyl {worker.hello.get('version', worker.hello)}")
    print("           stages prepare us (least)    99 %  feedback (least)  beside kernels  Crocoddyl (least)   ratio")
    rng = np.random.default_rng(0)
    for name in SIZES:
        problem = problem_of(name)
        controller = controller_of(problem)
        known = False
        if worker is not None:
            known = "failed" not in worker.ask("load", problem=problem, probes=probes(problem))
        calls, counted, theirs, kernels = [], [], [], Kernels(controller)
        for _ in range(ROUNDS):
            calls.append(call_times(controller, REPEATS, rng, kernels)[:, :2])
            with kernels:
                counted.append(call_times(controller, REPEATS, rng, kernels))
            if known:
                theirs += worker.ask("iterate", repeats=REPEATS, seconds=5.0)["times"]  # type: ignore[union-attr]
        (prepared, answered), (whole, _answers, inside) = (1e6 * np.concatenate(rows).T for rows in (calls, counted))
        other, beside = 1e6 * np.array(theirs) if theirs else np.array([np.nan]), whole - inside
        print(
            f"{name:10}{SIZES[name]:7}{np.median(prepared):9.0f} ({prepared.min():6.0f})"
            f"{np.percentile(prepared, 99):8.0f}{np.median(answered):11.0f} ({answered.min():4.0f})"
            f"{np.median(beside):10.0f} ({beside.min():3.0f}){np.median(other):12.0f} ({other.min():6.0f})"
            f"{np.median(other) / np.median(prepared):8.1f} ({other.min() / prepared.min():.1f})"
        )
    if worker is not None:
        worker.close()


SERVO = '<position name="{0}" joint="{0}" kp="{1:.0f}" kv="{2:.0f}" ctrlrange="-3 3" forcerange="-{3} {3}"/>'
CALLS, LONG = 1000, 25  # calls of a loop; stages of its plans


def arm(servos: bool, dt: float) -> planner.Controller:
    """The arm of examples/tasks with its motors, or with servos as stiff as 50 N m per rad and N m of torque."""
    text = (Path(__file__).parents[1] / "examples" / "tasks" / "arm.xml").read_text(encoding="utf-8")
    if servos:
        text = re.sub(
            r'<motor name="(\w+)" joint="\w+" ctrlrange="-\d+ (\d+)"/>',
            lambda m: SERVO.format(m[1], 50.0 * float(m[2]), 2.5 * float(m[2]), m[2]), text,
        )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "arm.xml").write_text(text, encoding="utf-8")
        words = f'model = "arm.xml"\nstart = "home"\ngoal = {{ waist = 0.8, elbow = 1.0 }}\nduration = 1.0\ndt = {dt}\n'
        (Path(folder) / "arm.toml").write_text(words, encoding="utf-8")
        problem = planner.load_problem(Path(folder) / "arm.toml")
    return planner.Controller(problem, LONG, plan=planner.solve(problem))


def deadlines() -> None:
    """Overruns of loops in their own dynamics: wall and processor time."""
    for name, servos, rate in (("motors", False, 500.0), ("servos", True, 200.0)):
        c = arm(servos, 1.0 / rate)
        c.simulated = True  # it then measures processor time
        model, x, times = c._model.dynamics, c.problem.x0, np.empty((CALLS, 2))
        for k in range(CALLS):
            u = c(k / rate, x)
            times[k] = c.seconds, c.processor_seconds
            x = model.step(x[None], u[None])[0]
        (wall, processor), most = times.T, 1e3 / rate
        print(
            f"7 joints, {name}, {rate:.0f} Hz, {LONG} stages, {model.integrator} x {model.substeps}: period {most:g} ms"
        )
        for clock, spent in (("wall", wall), ("processor", processor)):
            print(
                f"  {clock}: median {1e3 * np.median(spent):.2f} ms, 99 % {1e3 * np.percentile(spent, 99):.2f}, "
                f"most {1e3 * spent.max():.2f}, over the period {100 * np.mean(spent > 1 / rate):.1f} %"
            )


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--crocoddyl", help="an interpreter that has Crocoddyl")
    arguments.add_argument("--no-table", action="store_true", help="without the table of times")
    arguments.add_argument("--deadlines", action="store_true", help="count overruns")
    arguments.add_argument("--shown", nargs="*", metavar="NAME", help=f"drive machines: {', '.join(SHOWN)}; or all")
    arguments.add_argument("--starts", type=int, default=100, help="of the acrobot, at random")
    arguments.add_argument("--packages", type=Path, help="site-packages with dm_control, for the walker")
    asked = arguments.parse_args()
    unknown = sorted(set(asked.shown or ()) - set(SHOWN))
    if unknown:
        arguments.error(f"--shown names {', '.join(unknown)}, expected some of: {', '.join(SHOWN)}")
    if not asked.no_table:
        compare(asked.crocoddyl or "")
    if asked.deadlines:
        deadlines()
    if asked.shown is not None:
        drive(asked.shown or list(SHOWN), asked.starts, asked.packages)
