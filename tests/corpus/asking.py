"""Problems as users ask them, and the register of right plans."""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import planner
from planner import FrameCost, Limits, Mechanism, Plan, Problem, RigidBodyDynamics, TrackingCost
from planner.dynamics.algorithms import mass_matrix
from planner.dynamics.quasi_static import quasi_static_controls

Rng = np.random.Generator
MEMBERS: dict[str, Callable[[Rng], Plan]] = {}


def member(name: str, *arguments: Any, **options: Any) -> Callable:
    """A member of the corpus: a function of a generator that makes a plan, with arguments of its own."""

    def add(make: Callable) -> Callable:
        MEMBERS[name] = partial(_called, make, arguments, options)
        return make

    return add


def _called(make: Callable, arguments: tuple, options: dict, rng: Rng) -> Plan:
    return make(rng, *arguments, **options)


def plan_of(name: str, seed: int) -> Plan:
    """The plan of a member; the same seed draws the same machine, whatever other members there are."""
    return MEMBERS[name](np.random.default_rng([seed, *name.encode()]))


def reach(
    text: str | Mechanism, goal: Any, *, start: Any = None, duration: float = 1.0, N: int = 100,
    integrator: str = "rk4", effort: float = 1.0, final: float = 1e4, prescribed: tuple[str, ...] = (),
    guess: Any = None, running: float = 0.0, limits: Limits | None = None, tolerance: Any = None,
    plain: bool = False, contacts: Any = "model", more: Callable | None = None,
) -> Problem:  # fmt: skip
    """From rest to rest: goal (nv,) or state (nx,). Efforts and speeds are weighed in the machine's own scale."""
    m = text if isinstance(text, Mechanism) else Mechanism.from_mjcf(text, contacts=contacts)
    dynamics = RigidBodyDynamics(m, duration / N, integrator, prescribed)
    x0, xg = (state(m, x) for x in (start, goal))
    way = np.maximum(np.abs(m.space.difference(xg, x0))[: m.nv], 0.1 if plain else 1e-3)
    way = np.maximum(way, 0.1 * way.max())
    inertia = np.diag(mass_matrix(m, x0[: m.nq]))
    typical = np.maximum(np.abs(m.actuators.moment * m.actuators.gain[:, None]), 1e-12)  # (nu, nv) force per control
    moved = np.abs(m.actuators.moment) > 0
    needed = inertia * way / duration**2 * 8.0
    scale = np.array([np.max(needed[on] / typical[a, on], initial=1e-12) for a, on in enumerate(moved)])
    scale = np.concatenate([scale, np.repeat(np.max(way) / duration**2 * 8.0, dynamics.nu - m.nu)])
    weights = effort * (np.ones(dynamics.nu) if plain else 1.0 / scale**2) / duration
    rate = way / duration
    cost = TrackingCost.joints(
        dynamics, xg, N, effort=weights, final_position=final * (1.0 if plain else 1.0 / way**2),
        final_velocity=final * (0.1 if plain else 0.1 / rate**2), velocity=running / rate**2 / duration,
    )  # fmt: skip
    whole = cost if more is None else cost + more(dynamics)
    if guess is None and not prescribed and not m.na:  # what holds the start, as far as the motors can
        guess = quasi_static_controls(m, x0)
    us = None if guess is None else np.broadcast_to(guess, (N, dynamics.nu)).copy()
    return Problem(dynamics, whole, x0, us=us, horizon=N, limits=limits, tolerance=tolerance)


def state(m: Mechanism, x: Any) -> np.ndarray:
    """(nx,) of a state, of positions (nv,) as a move from home, or of None for home."""
    if x is None:
        return m.home.copy()
    x = np.asarray(x, dtype=float)
    return x.copy() if len(x) == m.space.nx and m.space.nx != m.nv else m.space.integrate(
        m.home, np.concatenate([x, np.zeros(m.space.ndx - len(x))])
    )  # fmt: skip


def turned(rng: Rng, joints: int, most: float = 1.2) -> np.ndarray:
    """Angles of 0.3 to `most` either way."""
    return rng.uniform(0.3, most, joints) * rng.choice([-1.0, 1.0], joints)


def again(plan: Plan) -> Plan:
    """The plan saved and loaded."""
    with tempfile.TemporaryDirectory() as folder:
        return planner.load_plan(plan.save(Path(folder) / "plan.npz"))


def placed(m: Mechanism, start: np.ndarray, final: float = 1e3, **target: Any) -> Problem:
    """A hand that is to be somewhere, at rest."""
    dynamics = RigidBodyDynamics(m, 0.01)
    still = TrackingCost.joints(dynamics, m.home, 100, effort=0.001, final_velocity=10.0)
    there = FrameCost(dynamics, "hand", **target, **{f"final_{name}_weight": final for name in target})
    return Problem(dynamics, still + there, start, us=np.tile(quasi_static_controls(m, start), (100, 1)))
