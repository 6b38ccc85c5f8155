"""PenaltyCost: least squares of heights, distances, gaps and velocities of a machine over the stages.

    J = sum_n dt weight_n 1/2 r_n^2  over the stages,  + final_weight 1/2 r_N^2 at the end

for each term of problem.costs.penalty_terms, r its residual. Constraints use the same terms as ResidualArrays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from planner.base.arguments import LONGEST_HORIZON, choice, count, short_repr
from planner.base.errors import PlannerError
from planner.kernels.tree.residuals.kinds import BOXES, DISTANCE, HEIGHT, LINE_BOX, OVER_PLANE, VELOCITY
from planner.model.contact.laws import Contact
from planner.model.contact.signed_distance import BOX, CAPSULE, PLANE
from planner.model.mechanism import Frame, Mechanism
from planner.problem.costs.penalty_terms import Clearance, Distance, Gap, Height, Penalty, Point, Segment, Velocity
from planner.problem.costs.residuals.arrays import ResidualArrays, ResidualList
from planner.problem.costs.residuals.cost import GoalRows, ResidualCost
from planner.problem.costs.tracking import mechanism_and_step

_SIDES = {"lower": -1.0, "upper": 1.0, "target": 0.0}


class PenaltyCost(ResidualCost):
    """Penalties of heights, distances, gaps and velocities; one term of a cost: TrackingCost(...) + PenaltyCost(...).

    With RigidBodyDynamics it is part of the compiled solver.

    Args:
        machine: RigidBodyDynamics or a Mechanism.
        horizon: N, number of stages.
        terms: Height, Distance, Gap and Velocity.
        dt: s; that of the dynamics by default.

    Attributes:
        names: (T,) of the terms, for a reader.

    Raises:
        PlannerError: No such frame or contact, an array per stage whose length is not N+1, or an entry that is no term.
    """

    def __init__(self, machine: Any, horizon: int, terms: Sequence[Any], dt: float | None = None) -> None:
        mechanism, dt = mechanism_and_step(machine, dt)
        N = count("horizon", horizon, maximum=LONGEST_HORIZON)
        if not isinstance(terms, Sequence):
            raise PlannerError(f"terms is {short_repr(terms)}, expected a list of Height, Distance, Gap and Velocity.")
        self.names = tuple(str(term) for term in terms)
        residual_arrays = arrays_of_terms(mechanism, N, terms, dt)
        units = ["m/s" if kind == VELOCITY else "m" for kind in residual_arrays.kind]
        # a term without its own final weight is no goal at the end
        asked = [t for t, term in enumerate(terms) if getattr(term, "final_weight", None) is not None]
        super().__init__(mechanism, residual_arrays, N, [GoalRows(self.names[t], units[t], t) for t in asked])

    def values(self, xs: np.ndarray) -> np.ndarray:
        """(N+1, T) m or m/s, the values of the terms along xs (N+1, nx), also where they are off."""
        return self._values(self.residual_arrays, xs).T


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
        plane, T_centre = contact.plane, np.eye(4)
        T_centre[:3, 3] = contact.centre
        point = number(Point(Frame(contact.link, T_centre)))
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
