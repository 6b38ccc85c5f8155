"""Stances: which feet a problem's phases or gait ask to stand and to swing, and how much of that a motion keeps.

Phases are a reference, from which the solver moves touch-downs where that is cheaper. A motion that keeps less than
BOUND of one has ignored it: so does a jump that stays on the ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from planner.model.capabilities import capabilities_of
from planner.problem.touch_downs import standing

BOUND = 50.0  # %, of the time of a stance


class Stance(NamedTuple):
    """What is asked of feet at some times."""

    name: str  # "phase 2", "swings of left_foot"
    spans: tuple[tuple[float, float], ...]  # s, begin and end of each time
    stand: tuple[str, ...]  # names of bodies
    swing: tuple[str, ...]

    def __str__(self) -> str:
        parts = (("stands", "stand", self.stand), ("swings", "swing", self.swing))
        told = [f"{', '.join(feet)} {one if len(feet) == 1 else more}" for one, more, feet in parts if feet]
        return f"{self.name}, in which {' and '.join(told)}"


def stances_of_phases(
    names: list[str], spans: list[tuple[float, float]], stand: list[tuple[str, ...]]
) -> tuple[Stance, ...]:  # fmt: skip
    """Those of phases, one after another, of feet with these names."""
    return tuple(
        Stance(f"phase {k}", (span,), down, tuple(name for name in names if name not in down))
        for k, (span, down) in enumerate(zip(spans, stand, strict=True), 1)
    )


def stances_of_swings(names: list[str], swings: list[list[tuple[float, float]]]) -> tuple[Stance, ...]:
    """Those of a gait: of each foot its swings, s. Between them others may bear what it could."""
    return tuple(Stance(f"swings of {name}", tuple(own), (), (name,)) for name, own in zip(names, swings, strict=True))


def kept_shares(stances: Sequence[Stance], dynamics: Any, t: np.ndarray, xs: np.ndarray) -> list[float]:
    """In which share of its time each stance is kept by states xs (M, nx) at times t (M,), %.

    It is where all feet are in the air that are to swing, and a foot bears load of those that are to stand: of many
    feet some may carry next to nothing. Those in which no time lies are kept.
    """
    mechanism = capabilities_of(dynamics).mechanism
    if not stances or mechanism is None:
        return [100.0] * len(stances)
    if not np.isfinite(xs).all():
        return [0.0] * len(stances)
    shares, bears = list[float](), standing(mechanism, xs)
    for one in stances:
        at, kept = np.zeros(len(t), dtype=bool), np.ones(len(t), dtype=bool)
        for begin, end in one.spans:
            at |= (t > begin) & (t < end)
        for name in bears.keys() & {*one.swing}:
            kept &= ~bears[name]
        if down := bears.keys() & {*one.stand}:
            kept &= np.any([bears[name] for name in down], axis=0)
        shares.append(100.0 * float(kept[at].mean()) if at.any() else 100.0)
    return shares


def least_kept(stances: Sequence[Stance], dynamics: Any, t: np.ndarray, xs: np.ndarray) -> tuple[Stance, float]:
    """The one of some stances that is kept least, and in which share of its time; arguments as in kept_shares()."""
    shares = kept_shares(stances, dynamics, t, xs)
    worst = int(np.argmin(shares))
    return stances[worst], shares[worst]
