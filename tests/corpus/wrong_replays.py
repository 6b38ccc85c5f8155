"""Wrong plans: through what was taken out of their model, and must not be taken out of every replay."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

import planner
from corpus.planting import Plan, Rng, member
from corpus.replays import Beside, N, carried, coupled, fingers, loaded, lying, own_python, reach, siblings, walled
from planner import Mechanism, Problem, RigidBodyDynamics, TrackingCost

SIBLINGS = 12


def into(kind: Callable[..., Beside], *arguments: Any) -> Callable[[Rng], Plan]:
    """A plan that meets what is beside the machine."""

    def make(rng: Rng) -> Plan:
        drawn = kind(rng, *arguments)
        return reach(drawn.text, drawn.into, **drawn.options)

    return make


def rubbed(rng: Rng) -> Plan:
    """Friction of a third of the largest torque that the plan asks for, which own dynamics leave out."""
    state = rng.bit_generator.state
    plain = walled(rng)
    torque = float(np.abs(own_python(plain, plain.away, contacts="off").us).max())
    rng.bit_generator.state = state
    rubbing = walled(rng, joint=f'frictionloss="{0.3 * torque:.6g}"')
    return own_python(rubbing, rubbing.away, contacts="off", ignore=("frictionloss",))


def through(rng: Rng) -> Plan:
    kind = walled(rng)
    return own_python(kind, kind.into, contacts=str(rng.choice(["off", "avoid"])))


def laid_back(rng: Rng) -> Plan:
    """Lifted out of what it lies in, and laid back into it."""
    kind = lying(rng, -9e-4, -2e-4)
    mechanism = Mechanism.from_mjcf(kind.text, contacts="off")
    way = np.zeros((N + 1, 2))
    way[:, 0] = rng.uniform(0.05, 0.2) * np.sin(np.pi * np.arange(N + 1) / N) ** 2
    u = np.full((N, 1), 9.81 * float(mechanism.mass.sum()))
    Q, R = np.tile(np.diag([1e4, 1.0]), (N + 1, 1, 1)), np.tile(np.diag([1e-3]), (N, 1, 1))
    dynamics = RigidBodyDynamics(mechanism, 1.0 / N)
    return planner.solve(Problem(dynamics, TrackingCost(Q, R, way, u), way[0], us=u))


for _name, _make in {
    "own Python through a wall of its twin's file": through,
    "own Python without its file's friction": rubbed,
    "into a table that it lies on": into(lying, 0.0, 1e-4),
    "into a table within the margin of its shapes": into(lying, 0.0, 4e-3, 'margin="0.005"'),
    "deeper into a table that it penetrates": into(lying, -9e-4, -1e-5),
    "from deep inside a table": lambda rng: reach((kind := lying(rng, -9e-3, -2e-3)).text, kind.away, **kind.options),
    "out of a table and back into it": laid_back,
    "closed fingers that cross": into(fingers),
    "a prescribed cart through a wall": into(carried),
    "a payload through a wall": into(loaded),
    "an equality that is soft in the file": into(partial(coupled, soft='solref="0.1 1"')),
}.items():
    siblings(member, _name, _make, SIBLINGS)
