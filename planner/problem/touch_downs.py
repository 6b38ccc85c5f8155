"""Touch-downs: when feet of a plan begin to bear load, and the rule by which the gains wait for them.

A foot lands early or late where the ground is not as high as planned. Gains of the wrong phase then act on it, so the
stage n of u = us[n] + K[n] (x - x_ref) is not the clock's around a touch-down that is planned for the stage n_e:

    early   from when all its feet, seen in the air before, bear load, n = n_e until the clock is there
    late    from when the clock is there, n = n_e until a foot bears load, at most WINDOW

with x_ref = xs[n_e] moved on, or back, at its own velocity until now: the reference goes on smoothly before and after
an impact at another time (reference spreading: Rijnen, Saccon, Nijmeijer, 2015). The stage never goes back, and far
from touch-downs it is the clock's.

A touch-down is of a limb that was in the air and then stands for a while. A shank that rubs beside its foot is none,
nor is a foot that bounces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from planner.dynamics.contacts import contact_forces
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.capabilities import capabilities_of, roots
from planner.model.mechanism import Mechanism
from planner.model.space import space_of

BEARS = 0.02  # of the weight of the machine: a foot under less does not stand, as foot switches are set
WINDOW = 0.04  # s, longest wait, and earliest touch-down
BRIEF = 0.03  # s: a foot in the air for less bounces, one that stands for less brushes the ground
TOGETHER = 0.03  # s: feet that land within it, as those of a trot, are one touch-down
_ROUNDING = 1e-6  # of a stage


class TouchDown(NamedTuple):
    """Feet that begin to bear load together."""

    stage: int  # the first at whose start they do
    feet: tuple[str, ...]  # names of bodies
    earliest: int  # stage from which they may
    latest: int  # stage until which they are waited for
    # Stage from which they are looked for in the air, the middle of their swing: a foot that lifts off late stands too.
    watched: int = 0

    def to_dict(self) -> dict[str, Any]:
        """As JSON values: the list touch_downs of a plan's file."""
        return {**self._asdict(), "feet": list(self.feet)}

    @classmethod
    def from_dict(cls, table: dict[str, Any]) -> TouchDown:
        """Of such values."""
        return cls(
            int(table["stage"]), tuple(table["feet"]), *(int(table[name]) for name in ("earliest", "latest", "watched"))
        )


def touch_downs_of(dynamics: Any, xs: np.ndarray) -> tuple[TouchDown, ...]:
    """The touch-downs of a motion xs (N+1, nx); none for dynamics without feet of standing()."""
    return _joined(landings(dynamics, xs), max(round(TOGETHER / dynamics.dt), 1))


def landings(dynamics: Any, xs: np.ndarray) -> list[TouchDown]:
    """The same, each of one foot."""
    mechanism = capabilities_of(dynamics).mechanism
    if mechanism is None or not mechanism.contacts or not np.isfinite(xs).all():
        return []
    window, brief = (max(round(seconds / dynamics.dt), 1) for seconds in (WINDOW, BRIEF))
    found, loads = [], _loads(mechanism, xs)
    for link, bears in loads.items():
        own = chain_of(mechanism.parent, link)
        limb = np.logical_or.reduce(
            [other for k, other in loads.items() if k in own or link in chain_of(mechanism.parent, k)]
        )
        limb = _without_brief(_without_brief(limb, False, brief), True, brief)
        for n in np.flatnonzero(limb[1:-1] & ~limb[:-2] & bears[1:-1]) + 1:
            before, after = np.flatnonzero(limb[:n]), np.flatnonzero(~limb[n:])
            airborne = n if not len(before) else n - 1 - before[-1]  # stages
            stands = after[0] if len(after) else len(xs)
            watched, latest = n - (airborne + 1) // 2, n + min(window, (stands + 1) // 2)
            foot, earliest = mechanism.body_of(link), max(watched, n - window)
            found.append(TouchDown(int(n), (foot,), int(earliest), int(latest), int(watched)))
    return sorted(found)


def _without_brief(signal: np.ndarray, value: bool, brief: int) -> np.ndarray:
    """A signal (N,) bool without runs of a value that are shorter than `brief`, but at its ends."""
    edges = np.flatnonzero(np.diff(signal)) + 1
    result = signal.copy()
    for first, end in pairwise(edges.tolist()):
        if signal[first] == value and end - first < brief:
            result[first:end] = not value
    return result


def standing(mechanism: Mechanism, xs: np.ndarray) -> dict[str, np.ndarray]:
    """Whether each foot bears load at states xs (N, nx), (N,) bool by the name of its body.

    Feet are bodies of machines with actuators, where they meet planes that do not move.
    """
    return {mechanism.body_of(link): bears for link, bears in _loads(mechanism, xs).items()}


def _loads(mechanism: Mechanism, xs: np.ndarray) -> dict[int, np.ndarray]:
    """The same by the link of the foot."""
    forces = contact_forces(mechanism, xs[:, : mechanism.nq], xs[:, mechanism.velocities]).forces
    root, driven = roots(mechanism), mechanism.directly_actuated
    found: dict[int, np.ndarray] = {}
    for k, one in enumerate(mechanism.contacts):
        tree = root == root[one.link]
        belt = one.plane.slide >= 0 or np.any(one.plane.velocity)
        if mechanism.body_of(one.link) and driven[tree].any() and not belt:
            found[one.link] = found.get(one.link, 0.0) + forces[:, k] @ one.plane.normal
    gravity = float(np.linalg.norm(mechanism.gravity))
    weights = {link: gravity * float(mechanism.mass[root == root[link]].sum()) for link in found}
    return {link: pressed > BEARS * weights[link] for link, pressed in found.items()}


def _joined(single: Sequence[TouchDown], together: int) -> tuple[TouchDown, ...]:
    """Touch-downs in order, those at most so many stages apart as one."""
    joined: list[TouchDown] = []
    for one in single:
        last = joined[-1] if joined else None
        if last is not None and one.stage - last.stage <= together and one.feet[0] not in last.feet:
            begins = (max(last.earliest, one.earliest), one.latest, max(last.watched, one.watched))
            joined[-1] = TouchDown(one.stage, (*last.feet, *one.feet), *begins)
        else:
            joined.append(one)
    return tuple(joined)


class StageRule:
    """Which touch-down gives the stage, as time goes on; one for each run."""

    def __init__(self, touch_downs: Sequence[TouchDown]) -> None:
        self._touch_downs, self._next, self._early = touch_downs, 0, False
        self._airborne: set[str] = set()  # feet of the next one that were seen in the air

    def __call__(self, clock: float, bears: Callable[[str], bool]) -> TouchDown | None:
        """The touch-down whose stage acts; None where it is the clock's.

        Args:
            clock: Time in stages; it does not go back.
            bears: Whether a foot bears load now, by its name; asked around touch-downs alone.
        """
        clock += _ROUNDING
        while self._next < len(self._touch_downs):
            one = self._touch_downs[self._next]
            if clock < one.watched:
                return None
            if clock < one.stage:
                # The plan's own feet begin to bear load within the stage before: that is not early.
                if not self._early and clock < one.stage - 1:
                    down = [foot for foot in one.feet if bears(foot)]
                    self._early = len(down) == len(one.feet) and self._airborne.issuperset(down)
                    self._early &= clock >= one.earliest
                    self._airborne.update(foot for foot in one.feet if foot not in down)
                return one if self._early else None
            if not self._early and clock < one.latest and not any(map(bears, one.feet)):
                return one
            self._next, self._early, self._airborne = self._next + 1, False, set()
        return None


def reference(dynamics: Any, x: np.ndarray, seconds: float) -> np.ndarray:
    """A state (nx,) moved on by so many seconds at its own velocity."""
    space, mechanism = space_of(dynamics), capabilities_of(dynamics).mechanism
    assert mechanism is not None  # it has touch-downs
    displacement = np.zeros(space.ndx)
    displacement[: mechanism.nv] = seconds * x[mechanism.velocities]
    return space.integrate(x, displacement)


def feet_of(touch_downs: Sequence[TouchDown]) -> tuple[str, ...]:
    """Names of all feet that touch down."""
    return tuple(dict.fromkeys(foot for one in touch_downs for foot in one.feet))


def near_touch_downs(touch_downs: Sequence[TouchDown], N: int) -> np.ndarray:
    """(N,) bool, the stages in which a rule may differ from the clock."""
    near = np.zeros(N, dtype=bool)
    for one in touch_downs:
        near[one.watched : one.latest + 1] = True
    return near
