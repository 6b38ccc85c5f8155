"""The problems of hard.py, named before anything was tuned to them. NumPy only; plain JSON for every solver.

    minimize  1/2 |x(N) - x_ref|^2_final + 1/2 hand |p(x(N)) - place|^2 + sum over n of dt/2 |u(n)|^2_effort
    subject to  x(n+1) = a step of semi-implicit Euler,  lower <= u <= upper,  |x| <= bounds (infinite for none)

p is the place of the last joint's frame. Every joint has a motor for each solver: one that is not driven has the bounds
0 and 0, since Crocoddyl has no compiled actuation that leaves out any joint but the first.

OWN are problems that only this package can state as they are: clearances between shapes, contacts that nobody gives it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mechanisms
import numpy as np
from mechanisms import Chain

Problem = dict[str, Any]
TASKS = Path(__file__).parents[1] / "examples" / "tasks"
STOP = 1e-7  # a solver stops when its model promises less than this
CSQP_TOLERANCE = 1e-4  # of the residual of the optimality conditions, at which CSQP stops
OWN_CHANGE = 0.1  # of the controls' limits: the random changes of the problems that only this package states


def poles(count: int, cart: bool = True) -> Chain:
    """Poles of 0.2 kg and 0.5 m in series that hang from a cart of 1 kg, or from a fixed hinge."""
    mass, length = 0.2, 0.5
    across = mass * length**2 / 12.0
    body = {"R": np.eye(3).tolist(), "armature": 0.0}
    joints = []
    if cart:
        inertia = (1e-2 * np.eye(3)).tolist()
        place = {"name": "cart", "parent": 0, "type": "PX", "p": [0.0] * 3}
        joints.append({**body, **place, "mass": 1.0, "com": [0.0] * 3, "inertia": inertia})
    for i in range(count):
        rod = {
            "mass": mass,
            "com": [0.0, 0.0, -0.5 * length],
            "inertia": np.diag([across, across, 1e-3 * across]).tolist(),
        }
        place = [0.0, 0.0, -length if i else 0.0]
        joints.append({**body, "name": f"pole{i}", "parent": i + cart, "type": "RY", "p": place, **rod})
    return {"gravity": [0.0, 0.0, -mechanisms.GRAVITY], "joints": joints}


def _stated(
    chain: Chain, N: int, dt: float, goal: Any, limits: Any, *, effort: float = 1.0, q0: Any = None, final: float = 1e4,
    tolerance: float = 0.02, states: Any = None, place: Any = None, guess: Any = None, sizes: Any = None,
    change: float = 1.0,
) -> Problem:  # fmt: skip
    """A problem from rest to rest.

    Args:
        goal: Angles (n,) of the hinges at the end, after a free base's place.
        limits: Bound (n,) of each motor, 0 for none there; infinite for none.
        effort: Weight of the squared controls, relative to 1 / sizes^2.
        tolerance: Of the goal, in rad or m; ten times that for rates.
        states: Bound (2n,) of each state's size.
        place: Goal of the last joint's frame in the world, in place of the angles'.
        guess: First controls (n,).
        sizes: (n,) of the controls; the limits by default.
        change: Size of the random changes of the first controls, relative to `sizes`: a rollout must not run away.
    """
    free = chain["joints"][0]["type"] == "FF"
    n = len(chain["joints"]) + 5 * free
    joints = len(mechanisms.motorized(chain))
    limits = np.broadcast_to(np.asarray(limits, float), (joints,))
    sizes = np.broadcast_to(np.asarray(limits if sizes is None else sizes, float), (joints,))
    weights = np.ones(2 * n)
    weights[: 6 * free] = 0.0
    weights[n : n + 6 * free] = 0.0
    if place is not None:
        weights[:n] = 0.0
    x0, x_ref = np.zeros(2 * n + free), np.zeros(2 * n + free)
    if free:
        x0[3] = x_ref[3] = 1.0
    x0[n + free - joints : n + free] = 0.0 if q0 is None else q0
    x_ref[n + free - joints : n + free] = goal
    tolerances = np.where(np.arange(2 * n) < n, tolerance, 10.0 * tolerance)
    weights[n:] *= 0.1
    guess = np.zeros(joints) if guess is None else guess
    return {
        "chain": chain, "motors": mechanisms.motorized(chain), "N": N, "dt": dt, "x0": x0.tolist(),
        "x_ref": x_ref.tolist(), "final": (final * weights).tolist(),
        "effort": (effort / np.maximum(sizes, 1e-3 * sizes.max()) ** 2).tolist(),
        "tolerances": np.where(weights > 0.0, tolerances, np.inf).tolist(), "limits": limits.tolist(),
        "states": None if states is None else np.broadcast_to(states, (2 * n,)).tolist(),
        "place": None if place is None else list(place), "hand": final, "tolerance": tolerance,
        "us": np.tile(guess, (N, 1)).tolist(), "random": (change * sizes).tolist(),
    }  # fmt: skip


def _pendulum(limit: float, duration: float) -> Problem:
    return _stated(poles(1, cart=False), round(duration / 0.02), 0.02, [np.pi], [limit])


def _cart(count: int, limit: float, duration: float, rail: float = np.inf) -> Problem:
    goal = np.zeros(count + 1)
    goal[1] = np.pi
    states = None if np.isinf(rail) else [rail, *[np.inf] * (2 * count + 1)]
    return _stated(poles(count), round(duration / 0.02), 0.02, goal, [limit, *[0.0] * count], states=states)


def _two_rods(limits: list[float], duration: float) -> Problem:
    hanging = [-0.5 * np.pi, 0.0]
    return _stated(mechanisms.two_rods(), round(duration / 0.02), 0.02, [0.5 * np.pi, 0.0], limits, q0=hanging)


def _arm(
    chain: Chain, goal: Any, torques: list[float], duration: float = 1.0, bounded: bool = False, **more: Any
) -> Problem:
    """From the zero posture, held. Torques scale the effort and the random changes; where `bounded` they are limits."""
    common = {"effort": 1e-2, "sizes": torques, "change": 0.1, "final": 1e3, "guess": mechanisms.holding(chain)}
    return _stated(chain, round(duration / 0.01), 0.01, goal, torques if bounded else np.inf, **common, **more)


def _humanoid(reach: float, limit: float, duration: float = 1.0) -> Problem:
    goal, common = reach * np.sin(1.0 + np.arange(28)), {"effort": 1e-2, "sizes": 10.0, "change": 0.1, "final": 1e3}
    return _stated(mechanisms.humanoid(), round(duration / 0.01), 0.01, goal, limit, **common)


_FAR7 = [2.5, 1.8, -2.5, 2.0, 2.5, -1.8, 2.0]
_NEAR7 = [1.0, 0.8, -1.0, 0.8, 1.0, -0.8, 1.0]
_FAR6 = [2.0, 1.5, -2.0, 1.5, 1.5, -1.5]
_LINK = [0.0] * 7
_SPEED7 = [*[np.inf] * 7, *[3.0] * 7]
_PLACE = [0.5, 0.3, 0.4]
# N m: more than holds the goal, less than the largest torques of the free plans
_TORQUES6 = [10.0, 80.0, 12.0, 1.0, 1.0, 1.0]
_WEAK7 = [1.0, 25.0, 3.0, 60.0, 3.0, 20.0, 2.0]
_TORQUES7 = [3.0, 30.0, 6.0, 90.0, 4.0, 30.0, 2.5]
_TORQUES24 = [
    2.5, 4.0, 140.0, 8.0, 130.0, 15.0, 2.0, 2.5, 12.0, 9.0, 5.0, 6.0, 2.0, 9.0, 3.0, 18.0, 5.5, 25.0, 6.0, 31.0, 5.0,
    3.5, 6.0, 8.5,
]  # fmt: skip

TASK_NAMES = ("around_a_post", "through_a_window", "two_arms", "reach_within_limits", "humanoid_reach", "swing_up")
MOVING_NAMES = ("monopod-jump", "monopod-forward", "box-push", "quadrotor-flip", "satellite-grasp")

STATED: dict[str, Callable[[], Problem]] = {
    "pendulum, 0.25 N m, 3 s": lambda: _pendulum(0.25, 3.0),
    "pendulum, 0.15 N m, 5 s": lambda: _pendulum(0.15, 5.0),
    "pendulum, 0.08 N m, 8 s": lambda: _pendulum(0.08, 8.0),
    "cart and pole, 10 N, 2 s": lambda: _cart(1, 10.0, 2.0),
    "cart and pole, 5 N, 3 s": lambda: _cart(1, 5.0, 3.0),
    "cart and pole, 2 N, 6 s": lambda: _cart(1, 2.0, 6.0),
    "cart and pole, 5 N, 4 s, rail 0.4 m": lambda: _cart(1, 5.0, 4.0, 0.4),
    "cart and 2 poles, 30 N, 2 s": lambda: _cart(2, 30.0, 2.0),
    "cart and 2 poles, 15 N, 3 s": lambda: _cart(2, 15.0, 3.0),
    "cart and 2 poles, 20 N, 4 s, rail 0.6 m": lambda: _cart(2, 20.0, 4.0, 0.6),
    "cart and 3 poles, 60 N, 2.5 s": lambda: _cart(3, 60.0, 2.5),
    "cart and 3 poles, 40 N, 3.5 s": lambda: _cart(3, 40.0, 3.5),
    "acrobot, 10 N m, 4 s": lambda: _two_rods([0.0, 10.0], 4.0),
    "acrobot, 5 N m, 5 s": lambda: _two_rods([0.0, 5.0], 5.0),
    "acrobot, 3 N m, 8 s": lambda: _two_rods([0.0, 3.0], 8.0),
    "pendubot, 15 N m, 3 s": lambda: _two_rods([15.0, 0.0], 3.0),
    "pendubot, 5 N m, 5 s": lambda: _two_rods([5.0, 0.0], 5.0),
    "two links, 5 and 2 N m, 3 s": lambda: _two_rods([5.0, 2.0], 3.0),
    "two links, 3 and 1 N m, 5 s": lambda: _two_rods([3.0, 1.0], 5.0),
    "6 joints, far": lambda: _arm(mechanisms.puma(), _FAR6, _TORQUES6, 1.5),
    "6 joints, far, torques": lambda: _arm(mechanisms.puma(), _FAR6, _TORQUES6, 1.5, True),
    "7 joints, near, torques": lambda: _arm(mechanisms.arm7(), _NEAR7, _WEAK7, 1.0, True),
    "7 joints, far": lambda: _arm(mechanisms.arm7(), _FAR7, _TORQUES7),
    "7 joints, far, torques": lambda: _arm(mechanisms.arm7(), _FAR7, _TORQUES7, 2.0, True),
    "7 joints, far, speeds": lambda: _arm(mechanisms.arm7(), _FAR7, _TORQUES7, 2.0, states=_SPEED7),
    "7 joints, far, both": lambda: _arm(mechanisms.arm7(), _FAR7, _TORQUES7, 2.0, True, states=_SPEED7),
    "7 joints, hand to a place": lambda: _arm(mechanisms.arm7(), _LINK, _TORQUES7, place=_PLACE),
    "7 joints, hand to a place, torques": lambda: _arm(mechanisms.arm7(), _LINK, _TORQUES7, 1.0, True, place=_PLACE),
    "tree of 24, torques": lambda: _arm(mechanisms.tree24(), np.full(24, 0.8), _TORQUES24, 1.0, True),
    "humanoid in flight, near": lambda: _humanoid(0.4, np.inf),
    "humanoid in flight, far": lambda: _humanoid(1.2, np.inf),
    "humanoid in flight, far, torques": lambda: _humanoid(1.2, 10.0),
}


MOVING = Path(__file__).parent / "moving"


def _file(path: Path) -> Any:
    import planner

    return planner.load_problem(path)


def _hopper(height: float) -> Any:
    import planner

    return planner.cases.hopper(height=height)


# Problems that only this package can state as they are: clearances between shapes, and contacts that nobody gives it.
OWN: dict[str, Callable[[], Any]] = {
    **{f"task {name}": lambda name=name: _file(TASKS / f"{name}.toml") for name in TASK_NAMES},
    **{f"moving {name}": lambda name=name: _file(MOVING / f"{name}.toml") for name in MOVING_NAMES},
    **{f"hopper, {height} in": lambda height=height: _hopper(height) for height in (20.0, 40.0, 60.0)},
}
