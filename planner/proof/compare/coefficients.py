"""Coefficients of a contact or a stop in MuJoCo and in the plan, and what their largest differences are judged by."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.base.measured import Measurement

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
