"""Penalty terms as arrays over stages, for NumPy and kernels alike: names looked up, bounds and weights per stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import choice, shown
from planner.base.errors import PlannerError
from planner.kernels.tree.penalty_table import DISTANCE, VELOCITY
from planner.model.contact.laws import Contact
from planner.model.mechanism import Frame, Mechanism
from planner.problem.costs.penalty_terms import Distance, Gap, Height, Penalty, Point, Segment, Velocity

_SIDES = {"least": -1.0, "most": 1.0, "target": 0.0}


@dataclass(frozen=True, eq=False)
class PenaltyArrays:
    """T terms over P points as arrays, which kernels take too. The tolerances are in the weights."""

    link: np.ndarray  # (P,) that carries a point, -1 for the world
    offset: np.ndarray  # (P, 3) in the link's frame
    share: np.ndarray  # (P,)
    world: np.ndarray  # (P, N+1, 3)
    kind: np.ndarray  # (T,) HEIGHT, DISTANCE or VELOCITY
    # (T, 4) points: of a height its own first, of a velocity that relative to which it is then; of a distance start and
    # end of a, start and end of b.
    ends: np.ndarray
    normal: np.ndarray  # (T, 3) of heights and velocities
    level: np.ndarray  # (T,) what is taken from n'p or |d|
    side: np.ndarray  # (T,) +1 for most, -1 for least, 0 for a target
    ramp: np.ndarray  # (T,)
    bound: np.ndarray  # (T, N+1), 0 where a term is off
    weight: np.ndarray  # (T, N+1), 0 where a term is off

    def __post_init__(self) -> None:
        for value in vars(self).values():
            value.flags.writeable = False


def resampled(measures: PenaltyArrays, parts: int, ratio: float) -> PenaltyArrays:
    """The terms for stages divided into parts, whose weights are multiplied by ratio; the end stays as it is."""
    bound, weight = (np.repeat(part[:, :-1], parts, axis=1) for part in (measures.bound, measures.weight))
    world = np.repeat(measures.world[:, :-1], parts, axis=1)
    return replace(
        measures, bound=np.column_stack([bound, measures.bound[:, -1:]]),
        weight=np.column_stack([ratio * weight, measures.weight[:, -1:]]),
        world=np.concatenate([world, measures.world[:, -1:]], axis=1),
    )  # fmt: skip


def joined(parts: Sequence[PenaltyArrays]) -> PenaltyArrays:
    """The terms of several, of the same mechanism and horizon, as one."""
    together = {name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])}
    first = np.cumsum([0, *(len(part.link) for part in parts[:-1])])
    together["ends"] = np.concatenate([part.ends + k for part, k in zip(parts, first, strict=True)])
    return PenaltyArrays(**together)


class _Place(NamedTuple):
    """A point of a link, as PenaltyArrays has it."""

    link: int
    offset: np.ndarray  # (3,)
    share: float
    world: np.ndarray  # (N+1, 3)


class _Points:
    """The points of all terms, each one once."""

    def __init__(self, mechanism: Mechanism, N: int) -> None:
        self._mechanism, self._N = mechanism, N
        self._rows: dict[tuple[Any, ...], int] = {}
        self.places: list[_Place] = []

    def row(self, point: Point, name: str) -> int:
        """Where a point is; it is added the first time."""
        frame = Frame(-1, np.eye(4)) if point.frame is None else point.frame
        if isinstance(frame, str):
            known = [*self._mechanism.sites, *filter(None, self._mechanism.body_names)]
            frame = self._mechanism.frame(choice(f"{name}'s frame", frame, known))
        if frame.link >= self._mechanism.nv:
            raise PlannerError(f"{name}'s frame is on link {frame.link}, expected one below {self._mechanism.nv}.")
        offset = frame.T[:3, :3] @ point.offset + frame.T[:3, 3]
        world = _stages(f"{name}'s world", point.world, self._N, 1)
        key = (int(frame.link), offset.tobytes(), point.share, world.tobytes())
        if key not in self._rows:
            self._rows[key] = len(self.places)
            self.places.append(_Place(int(frame.link), offset, point.share, world))
        return self._rows[key]


def _stages(name: str, value: np.ndarray, N: int, rest: int = 0) -> np.ndarray:
    """Something given once or per stage, as (N+1, ...) with so many axes beyond the stages'."""
    if value.ndim > rest and len(value) != N + 1:
        raise PlannerError(f"{name} has {len(value)} rows, expected N+1 = {N + 1}.")
    return np.array(np.broadcast_to(value, (N + 1, *value.shape[value.ndim - rest :])))


def _contact(mechanism: Mechanism, name: Any, term: str) -> Contact:
    """A contact by its name, or by that of its geom alone."""
    known = {contact.name: contact for contact in mechanism.contacts}
    if not known:
        raise PlannerError(f"{term}'s contact is {shown(name)}, but the mechanism has no contacts.")
    if len(known) < len(mechanism.contacts):
        raise PlannerError(f"{term}'s contact is {shown(name)}, but contacts of the mechanism share a name.")
    for full, contact in list(known.items()):
        known.setdefault(full.removeprefix("geom '").replace("'", ""), contact)
    return known[choice(f"{term}'s contact", name, known)]


def measures_of(mechanism: Mechanism, N: int, terms: Sequence[Any], dt: float) -> PenaltyArrays:
    """Terms of planner.problem.costs.penalty_terms as arrays for N stages of length dt."""
    points, T = _Points(mechanism, N), len(terms)
    kind, ends, normal = np.zeros(T, dtype=np.int64), np.zeros((T, 4), dtype=np.int64), np.zeros((T, 3))
    level, side, ramp, bound, weight = np.zeros(T), np.zeros(T), np.zeros(T), np.zeros((T, N + 1)), np.zeros((T, N + 1))
    for t, term in enumerate(terms):
        name = f"terms[{t}]"
        if isinstance(term, Height):
            ends[t], normal[t] = points.row(term.point, name), term.normal
        elif isinstance(term, Velocity):
            kind[t], normal[t] = VELOCITY, term.direction
            ends[t] = 2 * [points.row(term.point, name), points.row(term.relative, name)]
        elif isinstance(term, Gap):
            contact = _contact(mechanism, term.contact, name)
            plane, T_centre = contact.plane, np.eye(4)
            T_centre[:3, 3] = contact.centre
            ends[t], normal[t] = points.row(Point(Frame(contact.link, T_centre)), name), plane.normal
            level[t] = contact.radius + plane.offset
        elif isinstance(term, Distance):
            lines = [Segment(part, part) if isinstance(part, Point) else part for part in (term.a, term.b)]
            kind[t], level[t] = DISTANCE, sum(line.radius for line in lines)
            ends[t] = [points.row(end, name) for line in lines for end in (line.start, line.end)]
        else:
            raise PlannerError(f"{name} is {shown(term)}, expected a Height, Distance, Gap or Velocity.")
        side[t], ramp[t] = _SIDES[term.wanted], term.ramp
        bound[t], weight[t] = _wanted(name, term, N, dt)
    offsets, worlds = ([getattr(place, part) for place in points.places] for part in ("offset", "world"))
    return PenaltyArrays(
        np.array([place.link for place in points.places], dtype=np.int64), np.array(offsets).reshape(-1, 3),
        np.array([place.share for place in points.places]), np.array(worlds).reshape(-1, N + 1, 3),
        kind, ends, normal, level, side, ramp, bound, weight,
    )  # fmt: skip


def _wanted(name: str, term: Penalty, N: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Bound and weight (N+1,) of a term, both 0 where it is off."""
    bound = _stages(f"{name}.{term.wanted}", getattr(term, term.wanted), N)
    weight = dt * _stages(f"{name}.weight", term.weight, N)
    if term.final_weight is not None:
        weight[N] = term.final_weight
    off = np.isnan(bound)
    return np.where(off, 0.0, bound), np.where(off, 0.0, weight / term.tolerance**2)
