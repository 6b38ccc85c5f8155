"""Residuals as arrays over stages, for NumPy and kernels: names resolved to indices, bounds and weights per stage.

A term has up to six functions e of the state, its rows (kinds in kernels.tree.residuals.kinds). Each row is compared
with a target or bound b at each stage and costs w r^2 / 2:

    target b     r = e - b
    upper b      r = ramp(e - b; a)          0, d^2 / 2a, d - a/2  for d < 0, 0..a, > a; a may be 0
    lower b      r = ramp(b - e; a)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from planner.base.arguments import choice, short_repr
from planner.base.errors import PlannerError
from planner.kernels.tree.residuals.kinds import BOXES, DISTANCE, HEIGHT, KINDS, LINE_BOX, OVER_PLANE, VELOCITY
from planner.model.contact.laws import Contact
from planner.model.contact.signed_distance import BOX, CAPSULE, PLANE
from planner.model.mechanism import Frame, Mechanism
from planner.problem.costs.penalty_terms import Clearance, Distance, Gap, Height, Penalty, Point, Segment, Velocity

CONSTANTS = 26  # max number of constants of a term: those of two collision shapes


_SIDES = {"lower": -1.0, "upper": 1.0, "target": 0.0}


@dataclass(frozen=True, eq=False)
class ResidualArrays:
    """T terms with M rows and S reference entries in total, over P points; also input of the kernels."""

    link: np.ndarray  # (P,) link of a point or frame, -1 for the world
    offset: np.ndarray  # (P, 3) m, in the link's frame
    share: np.ndarray  # (P,) factor of the point's position in the world
    world: np.ndarray  # (P, N+1, 3) m, added to share times the position
    kind: np.ndarray  # (T,) residual kind
    ends: np.ndarray  # (T, 4) indices of points, by kind; the first is a frame's origin. -1 for none
    # (T, CONSTANTS): direction and level of a scalar, rotation or axis of a frame in its link, two collision shapes
    constant: np.ndarray
    first_row: np.ndarray  # (T+1,) index of the first row of a term
    first_reference: np.ndarray  # (T+1,) index of its first reference entry
    reference: np.ndarray  # (S, N+1) entries of the reference rotation of an orientation, or of a reference pose
    side: np.ndarray  # (M,) +1 for upper, -1 for lower, 0 for a target
    ramp: np.ndarray  # (M,) a
    bound: np.ndarray  # (M, N+1) b, 0 where a row is off
    weight: np.ndarray  # (M, N+1) w, 0 where a row is off; running weights times dt
    # (E, 3) of the motors' work: weight per J, smoothing in W, length of a stage in s
    work: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        for value in vars(self).values():
            value.flags.writeable = False

    def rows(self, t: int) -> slice:
        """The rows of term t."""
        return slice(int(self.first_row[t]), int(self.first_row[t + 1]))

    def references(self, t: int) -> np.ndarray:
        """(stages, number of entries) of the references of term t."""
        return self.reference[self.first_reference[t] : self.first_reference[t + 1]].T

    def along(self, stages: Any) -> ResidualArrays:
        """The same terms at the given stages, in their order."""
        return replace(
            self, world=self.world[:, stages], reference=self.reference[:, stages], bound=self.bound[:, stages],
            weight=self.weight[:, stages],
        )  # fmt: skip


def resampled(measures: ResidualArrays, parts: int, ratio: float) -> ResidualArrays:
    """The terms for stages divided into parts, with running weights multiplied by ratio; final weights unchanged."""
    N = measures.weight.shape[1] - 1
    finer = measures.along(np.append(np.repeat(np.arange(N), parts), N))
    weight = np.array(finer.weight)
    weight[:, :-1] *= ratio
    return replace(finer, weight=weight)


def joined(parts: Sequence[ResidualArrays]) -> ResidualArrays:
    """Concatenate the terms of several ResidualArrays of one mechanism and horizon."""
    together = {f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(ResidualArrays)}
    first_entry = np.cumsum([0, *(len(part.link) for part in parts[:-1])])
    ends = [np.where(part.ends < 0, -1, part.ends + k) for part, k in zip(parts, first_entry, strict=True)]
    together["ends"] = np.concatenate(ends)
    for name in ("first_row", "first_reference"):
        sizes = np.concatenate([np.diff(getattr(part, name)) for part in parts])
        together[name] = np.cumsum(np.concatenate([[0], sizes]), dtype=np.int64)
    return ResidualArrays(**together)


class ResidualList:
    """Builder of ResidualArrays for N stages: unique points, and terms that refer to them by index."""

    def __init__(self, N: int) -> None:
        self.N = N
        self._numbers: dict[tuple[Any, ...], int] = {}
        self._points: list[tuple[int, np.ndarray, float, np.ndarray]] = []
        self._terms: list[tuple[Any, ...]] = []

    def point(self, link: int, offset: np.ndarray, share: float = 1.0, world: Any = 0.0) -> int:
        """The index of a point, which is added if it is new."""
        world = np.array(np.broadcast_to(world, (self.N + 1, 3)), dtype=float)
        key = (int(link), np.asarray(offset, dtype=float).tobytes(), share, world.tobytes())
        if key not in self._numbers:
            self._numbers[key] = len(self._points)
            self._points.append((int(link), np.asarray(offset, dtype=float), share, world))
        return self._numbers[key]

    def add(
        self, kind: int, ends: Sequence[int], weight: Any, *, bound: Any = 0.0, constant: Any = (), reference: Any = (),
        side: float = 0.0, ramp: float = 0.0,
    ) -> None:  # fmt: skip
        """Add a term: weight and bound broadcast to (rows, N+1), reference reshaped to (its kind's references, N+1)."""
        rows, references = KINDS[kind][:2]
        shape, constants = (rows, self.N + 1), np.zeros(CONSTANTS)
        constants[: np.size(constant)] = np.ravel(constant)
        self._terms.append((
            kind, [*ends, *(4 - len(ends)) * [ends[0] if ends else -1]], constants,
            np.asarray(reference, dtype=float).reshape(references, self.N + 1),
            np.full(rows, side), np.full(rows, ramp), np.array(np.broadcast_to(bound, shape), dtype=float),
            np.array(np.broadcast_to(weight, shape), dtype=float),
        ))  # fmt: skip

    @property
    def count(self) -> int:
        """Number of terms."""
        return len(self._terms)

    def arrays(self) -> ResidualArrays:
        """The points and terms as ResidualArrays."""
        stages, terms = self.N + 1, self._terms
        kind = np.array([term[0] for term in terms], dtype=np.int64)
        rows, references = ([0, *(KINDS[int(k)][i] for k in kind)] for i in range(2))
        empty = (np.zeros((0, stages)), np.zeros(0), np.zeros(0), np.zeros((0, stages)), np.zeros((0, stages)))
        reference, side, ramp, bound, weight = (
            np.concatenate([none, *(term[i] for term in terms)]) for i, none in enumerate(empty, 3)
        )
        links, offsets, shares, worlds = ([point[i] for point in self._points] for i in range(4))
        return ResidualArrays(
            np.array(links, dtype=np.int64), np.array(offsets, dtype=float).reshape(-1, 3),
            np.array(shares, dtype=float),
            np.array(worlds, dtype=float).reshape(-1, stages, 3), kind,
            np.array([term[1] for term in terms], dtype=np.int64).reshape(-1, 4),
            np.array([term[2] for term in terms], dtype=float).reshape(-1, CONSTANTS),
            np.cumsum(rows, dtype=np.int64), np.cumsum(references, dtype=np.int64), reference, side, ramp, bound,
            weight,
        )  # fmt: skip


def arrays_of_terms(mechanism: Mechanism, N: int, terms: Sequence[Any], dt: float) -> ResidualArrays:
    """Terms of planner.problem.costs.penalty_terms as arrays for N stages of length dt."""
    residual_arrays = ResidualList(N)
    for t, term in enumerate(terms):
        name = f"terms[{t}]"
        kind, points, constant = _measured(residual_arrays, mechanism, term, name)
        bound, weight = _wanted(name, term, N, dt)
        residual_arrays.add(
            kind, points, weight, bound=bound, constant=constant, side=_SIDES[term.side], ramp=term.ramp
        )
    return residual_arrays.arrays()


def _measured(
    measures: ResidualList, mechanism: Mechanism, term: Any, name: str
) -> tuple[int, list[int], tuple[float, ...]]:
    """Kind, points and constants (direction, level) of a term."""

    def number(point: Point) -> int:
        return _point(measures, mechanism, point, name)

    if isinstance(term, Height):
        return HEIGHT, 4 * [number(term.point)], (*term.normal, 0.0)
    if isinstance(term, Velocity):
        return VELOCITY, 2 * [number(term.point), number(term.relative)], (*term.direction, 0.0)
    if isinstance(term, Gap):
        contact = _contact(mechanism, term.contact, name)
        point, plane = number(Point(Frame.at(contact.link, contact.centre))), contact.plane
        return HEIGHT, 4 * [point], (*plane.normal, contact.radius + plane.offset)
    if isinstance(term, Distance):
        lines = [Segment(part, part) if isinstance(part, Point) else part for part in (term.a, term.b)]
        points = [number(end) for line in lines for end in (line.start, line.end)]
        return DISTANCE, points, (0.0, 0.0, 0.0, sum(line.radius for line in lines))
    if isinstance(term, Clearance):
        return _of_solids(term, number)
    raise PlannerError(f"{name} is {short_repr(term)}, expected a Height, Distance, Gap, Velocity or Clearance.")


def _of_solids(term: Clearance, number: Callable[[Point], int]) -> tuple[int, list[int], tuple[float, ...]]:
    """Kind, points and constants of the distance of two solids; of two lines those of a Distance."""
    a, b = term.a, term.b
    level = a.radius + b.radius - term.lift
    if b.kind == CAPSULE:
        ends = [(solid, solid.T[:3, 3] + side * solid.half[2] * solid.T[:3, 2]) for solid in (a, b) for side in (-1, 1)]
        return DISTANCE, [number(Point(Frame(solid.link, np.eye(4)), at)) for solid, at in ends], (0.0, 0.0, 0.0, level)
    kind = OVER_PLANE if b.kind == PLANE else BOXES if a.kind == BOX else LINE_BOX
    sizes = [np.linalg.norm(a.half), 0.0 if b.plane else np.linalg.norm(b.half)]
    parts = (a.T[:3, :3].ravel(), a.half, b.T[:3, :3].ravel(), b.half, [level, sum(sizes)])
    return kind, [number(Point(Frame(solid.link, solid.T))) for solid in (a, b)], tuple(np.concatenate(parts))


def _point(measures: ResidualList, mechanism: Mechanism, point: Point, name: str) -> int:
    """The index of a point."""
    frame = Frame(-1, np.eye(4)) if point.frame is None else point.frame
    if isinstance(frame, str):
        known = [*mechanism.sites, *filter(None, mechanism.body_names)]
        frame = mechanism.frame(choice(f"{name}'s frame", frame, known))
    if frame.link >= mechanism.nv:
        raise PlannerError(f"{name}'s frame is on link {frame.link}, expected one below {mechanism.nv}.")
    offset = frame.T[:3, :3] @ point.offset + frame.T[:3, 3]
    return measures.point(frame.link, offset, point.share, _stages(f"{name}'s world", point.world, measures.N, 1))


def _stages(name: str, value: np.ndarray, N: int, rest: int = 0) -> np.ndarray:
    """A value given once or per stage, as (N+1, ...) with `rest` axes in addition to that of the stages."""
    if value.ndim > rest and len(value) != N + 1:
        raise PlannerError(f"{name} has {len(value)} rows, expected N+1 = {N + 1}.")
    return np.array(np.broadcast_to(value, (N + 1, *value.shape[value.ndim - rest :])))


def _contact(mechanism: Mechanism, name: Any, term: str) -> Contact:
    """A contact by its name, or by that of its geom alone."""
    known = {contact.name: contact for contact in mechanism.contacts}
    if not known:
        raise PlannerError(f"{term}'s contact is {short_repr(name)}, but the mechanism has no contacts.")
    if len(known) < len(mechanism.contacts):
        raise PlannerError(f"{term}'s contact is {short_repr(name)}, but contacts of the mechanism share a name.")
    for full, contact in list(known.items()):
        known.setdefault(full.removeprefix("geom '").replace("'", ""), contact)
    return known[choice(f"{term}'s contact", name, known)]


def _wanted(name: str, term: Penalty, N: int, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Bound and weight (N+1,) of a term, both 0 where it is off."""
    bound = _stages(f"{name}.{term.side}", getattr(term, term.side), N)
    weight = dt * _stages(f"{name}.weight", term.weight, N)
    if term.final_weight is not None:
        weight[N] = term.final_weight
    off = np.isnan(bound)
    return np.where(off, 0.0, bound), np.where(off, 0.0, weight / term.tolerance**2)
