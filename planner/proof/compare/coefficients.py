"""Coefficients of a contact, a stop or the hopper's ground in MuJoCo and in the plan, and by what they are judged.

Of the hopper, forces are per mass of the machine, in/s^2, lengths in inches, as in the paper. The plan's leg has no
foot; MuJoCo's foot penetrates its ground a little. So the foot's height is solved for zero vertical acceleration.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from planner.base.gl import load_mujoco
from planner.base.measured import Measurement
from planner.dynamics.hopper import HopperDynamics
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.simulation import set_state

BOUND = 1.0  # %
INERTIA_BOUND = 5.0  # %: impedances are read up to 1e-3, where it is 0.1 % of A over MuJoCo's estimate of A
_NOTHING = 1e-6  # relative to the significant size: a smaller coefficient counts as zero


class Coefficient(NamedTuple):
    """One coefficient of one pair, in MuJoCo and in the plan."""

    kind: str
    pair: str
    theirs: float
    ours: float
    error: float  # relative
    sentence: str = ""  # replaces the default sentence

    def __str__(self) -> str:
        return self.sentence or (
            f"{self.kind.replace('_', ' ')} of {self.pair} is {self.theirs:.4g}, the plan has {self.ours:.4g}"
        )


def compared(kind: str, pair: str, theirs: float, ours: float, matters: float) -> Coefficient:
    """A coefficient's difference relative to the plan's, or to MuJoCo's where the plan has none.

    `matters` is a significant size: below a millionth of it, a coefficient counts as zero.
    """
    least = _NOTHING * matters
    scale = abs(ours) if abs(ours) > least else max(abs(theirs), least)
    return Coefficient(kind, pair, theirs, ours, abs(theirs - ours) / scale if np.isfinite(theirs) else np.inf)


def measured_of(found: list[Coefficient], seed: int, unreached: list[str] | None = None) -> tuple[Measurement, ...]:
    """One value per kind, the largest difference in %, whose note names the pair."""
    measured, pairs = [], {}
    for one in found:
        pairs.setdefault(one.kind, set()).add(one.pair)
    for kind, names in pairs.items():
        worst = max((one for one in found if one.kind == kind), key=lambda one: np.nan_to_num(one.error, nan=np.inf))
        error = 100.0 * float(np.nan_to_num(worst.error, nan=np.inf))
        bound = INERTIA_BOUND if kind == "contact_inertia" else BOUND
        note = f"largest of {len(names)}, at {worst.pair}" if error <= bound else str(worst)
        note += f", at seeded states outside the ramps (seed {seed}), relative to the plan's"
        measured.append(Measurement(f"{kind}_error", error, "%", bound, note))
    if unreached:
        note = f"not compared, since no state that was tried brings them together: {', '.join(unreached)}"
        measured.append(Measurement("contacts_not_reached", float(len(unreached)), "", None, note))
    return tuple(measured)


def surface_difference(kind: str, name: str, begins: float, depth: float, blunt: float = 0.0) -> Coefficient:
    """Depth at which MuJoCo's force begins, below the plan's surface, relative to `depth`."""
    error = max(abs(begins) - blunt, 0.0) / depth
    sentence = f"{name} begins {abs(begins):.3g} {'later' if begins > 0.0 else 'earlier'} than in the plan"
    return Coefficient(kind, name, begins, 0.0, error if np.isfinite(begins) else np.inf, sentence)


def missing(name: str, sentence: str) -> Coefficient:
    """A contact that the model lacks."""
    return Coefficient("contact_stiffness", name, 0.0, np.inf, 1.0, sentence)


STATES = 3
_HALVINGS = 60
_OF_REST = 0.02
_DEEPEST = 0.5  # Largest penetration of the foot, relative to the leg's compression


def hopper_ground(dynamics: HopperDynamics, compiled: CompiledTwin, seed: int) -> Iterator[Coefficient]:
    """The coefficients of the hopper's leg on the ground, at seeded states."""
    rng, name = np.random.default_rng(seed), "the leg on the ground"
    k, smooth = dynamics.stiffness, dynamics.smoothing
    for _ in range(STATES):
        # Outside the smoothing, and of the size of the static compression, gravity / k.
        height, c = rng.uniform(0.0, 20.0), max(smooth, _OF_REST * dynamics.gravity / k) * rng.uniform(2.0, 20.0)
        speed = -c * np.sqrt(k)

        def both(compression: float, rate: float, height: float = height) -> tuple[float, float]:
            x = np.array([height, rate, height + compression])
            ours = float(dynamics.rates(x[None], np.zeros((1, 1)))[0, 1]) + dynamics.gravity
            return ours, _ground_force(compiled, x, compression)

        held, deeper, closing = both(c, 0.0), both(2.0 * c, 0.0), both(c, speed)
        K = [(two - one) / c for one, two in zip(held, deeper, strict=True)]
        B = [(moved - one) / -speed for one, moved in zip(held, closing, strict=True)]
        begins = [float(c - np.divide(one, slope)) for one, slope in zip(held, K, strict=True)]  # NaN: no force
        yield compared("contact_stiffness", name, K[1], K[0], k)
        # The compression at which the force begins; a damping of 0 except for the foot's own inertia.
        yield compared("contact_surface", name, c - begins[1], c - begins[0], c)
        yield compared("contact_damping", name, B[1], B[0], 1e3 * np.sqrt(k))


def _ground_force(compiled: CompiledTwin, x: np.ndarray, compression: float) -> float:
    """Normal force on the foot per mass at zero foot acceleration; NaN where no height gives it."""
    mujoco, model = load_mujoco(), compiled.model
    data, w = mujoco.MjData(model), compiled.twin.sim_of(x)
    w[model.nq + 1] = w[model.nq]  # zero foot velocity

    def rises(sunk: float) -> bool:
        at = w.copy()
        at[1] += sunk  # a longer leg lowers the foot
        set_state(model, data, at)
        mujoco.mj_forward(model, data)
        return bool(data.qacc[0] - data.qacc[1] > 0.0)

    least, most = 0.0, _DEEPEST * compression
    if not rises(most):
        return np.nan
    for _ in range(_HALVINGS):
        middle = 0.5 * (least + most)
        least, most = (least, middle) if rises(middle) else (middle, most)
    rises(most)
    return _normal_force(model, data) / float(model.body_subtreemass[0])


def _normal_force(model: Any, data: Any) -> float:
    wrench, total = np.empty(6), 0.0
    for c in range(data.ncon):
        load_mujoco().mj_contactForce(model, data, c, wrench)
        total += float(wrench[0])
    return total
