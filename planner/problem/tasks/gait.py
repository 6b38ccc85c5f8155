"""Gait: which feet swing when, by name or by phases, and the motion of a machine that steps so, as a reference.

`rows` is a motion of the whole machine in which the feet are dragged; its legs are bent so that its feet step instead,
and it goes along the ground as feet can carry it. In each of n cycles of T seconds a foot stands for the share `duty`
and swings for the rest. Cycles have as many slots as feet have different turns; foot k leaves the ground in cycle c at

    t = T (c + turn_k + max(0, 1 / slots - (1 - duty))),    turn_k in 0 ... 1.

It stands where the machine, at one speed from the first step to the last, is in the middle of its stance, so that the
body passes over it symmetrically (Raibert, Legged Robots That Balance, 1986), at first where it stood at the start and
at last where the motion ends. On its way it rises by lift 64 (s (1 - s))^3, at rest at both ends. By default a slot
lasts sqrt(h / g), h the height of the centre of mass: in that time an inverted pendulum falls away by a factor e. That
of a walk on two feet lasts twice as long, and SHIFT times that time pass before the first step and after the last one,
in which the weight goes to one foot and back. Where the feet that stand have the centre of mass between them in every
slot, nothing falls: then there are no more cycles than strides of STRIDE h on the way.

Phases say the times of each swing in place of these rules. A foot that is still in the air at the end goes to where the
motion has it. The zero-moment point is in the middle of the feet that stand (see over_support).

Nothing enforces contacts. Weights of positions and velocities refer to this motion; the solver finds the forces, and
when feet touch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import choice, number, short_repr
from planner.base.errors import PlannerError
from planner.dynamics.kinematics import center_of_mass
from planner.model.mechanism import Mechanism
from planner.model.urdf.write import is_urdf
from planner.problem.constraints.clearance import model_index_of
from planner.problem.costs.frame import CLEARANCE
from planner.problem.stances import Stance, stances_of_phases, stances_of_swings
from planner.problem.tasks.flight import check_flight_time, flights_of, jumping
from planner.problem.tasks.legs import (
    Foot,
    Phase,
    centres_of,
    evenly_paced,
    height_of,
    last_change,
    longest_step,
    over_support,
    phase_of,
    points_of_feet,
    standing_feet,
    stepping,
    with_legs,
)

# Turns of the rear left, rear right, front left and front right foot; walk has the lateral sequence, and a walk on two
# feet the first two of its turns.
TURNS = {
    "trot": (0.5, 0.0, 0.0, 0.5),
    "walk": (0.0, 0.5, 0.25, 0.75),
    "bound": (0.5, 0.5, 0.0, 0.0),
    "pace": (0.0, 0.5, 0.0, 0.5),
}
SHIFT = 3.0  # times sqrt(h / g), before the first step on two feet: the weight then goes to one of them
ROUNDING = 1e-9  # of a duration: by which the times of phases miss it; of a cycle, that of turns
STRIDE = 0.5  # of the height of the centre of mass, in a cycle of a machine that falls at no time
WIDEST = 0.9 * np.pi  # rad: largest angle between two feet, as the centre of mass sees them, that hold it firmly
OVERLAP = 0.2  # of a slot, in which feet of two turns stand by default


class GaitMotion(NamedTuple):
    """A motion on feet."""

    states: np.ndarray  # (N+1, nx)
    said: str  # A sentence
    stances: tuple[Stance, ...]


@dataclass(frozen=True)
class Gait:
    """A gait.

    Attributes:
        kind: One of TURNS, for machines of four feet; None with `feet` or `phases`.
        feet: Turns by the names of bodies, 0 to 1: when in a cycle each begins to swing.
        duty: Share of a cycle in which a foot stands; by default feet of two turns overlap by OVERLAP of a slot.
        stride: m, at most, of the motion in a cycle; by default a slot lasts sqrt(h / g), or more where nothing falls.
        lift: m, of a swinging foot; by default a fifth of the height of the centre of mass, at most CLEARANCE.
        phases: One after another, in place of turns; the last lasts to the end of the motion.
    """

    kind: str | None = None
    feet: Mapping[str, float] = field(default_factory=dict)
    duty: float | None = None
    stride: float | None = None
    lift: float | None = None
    phases: tuple[Phase, ...] = ()

    def motion(
        self, mechanism: Mechanism, rows: np.ndarray, dt: float, ranges: np.ndarray, direct: bool = True
    ) -> GaitMotion:
        """The gait along a motion `rows` (N+1, nx).

        Args:
            mechanism: The machine.
            rows: Begins and ends at rest, on the ground.
            dt: s.
            ranges: (nv, 2) rad or m, of hinges and slides.
            direct: Whether the end of the motion alone is asked for, so that steps are as long as each other.

        Raises:
            PlannerError: The machine has other feet, or its legs do not reach their footholds.
        """
        nq, nv, space = mechanism.nq, mechanism.nv, mechanism.space
        standing = feet_of(mechanism, rows[0])
        dragged = points_of_feet(mechanism, rows[:, :nq], standing)[0]
        feet, h = centres_of(standing, dragged), height_of(mechanism, rows[0], standing)
        lift = self.lift_of(h)
        if self.phases:
            swings, said = self.swings_of_phases(standing, dt * (len(rows) - 1))
            for k, (begin, phase) in enumerate(zip(self._begins, self.phases, strict=True), 1):
                if not phase.stand:
                    end = min(phase.until, dt * (len(rows) - 1))
                    check_flight_time(mechanism, f"[[phase]] {k}", end - begin, ranges)
        else:
            times = dt * last_change(rows), dt * (len(rows) - 1)
            centre = center_of_mass(mechanism, rows[0, :nq])
            swings, said = self._swings_of_turns(mechanism, standing, feet, times, h, centre)
        of_foot = np.repeat(np.arange(len(standing)), [len(foot.points) for foot in standing])
        normals = np.array([foot.normal for foot in standing])[of_foot]
        t, of_points = dt * np.arange(len(rows)), [swings[k] for k in of_foot]
        stands = stands_at(t, of_points)
        carried = bool(np.any(stands.any(axis=1) & ~stands.all(axis=1)))
        when = evenly_paced(dragged, normals, of_points, dt) if direct and carried else t
        places = stepping(dragged, when, normals, of_points, lift, dt)
        q = over_support(mechanism, rows[:, :nq], places, stands, normals[0], dt)
        flights = flights_of(stands)
        # The times of phases are asked for, those of turns are the gait's own: a trot's are too short to be worth it.
        lifted = bool(self.phases)
        high = jumping(mechanism, q, standing, places, flights, ranges, dt, lifted) if flights else None
        q = with_legs(mechanism, q, standing, places, ranges) if high is None else high
        xs = rows.copy()
        xs[:, :nq] = q
        xs[1:-1, mechanism.velocities] = space.difference(xs[2:], xs[:-2])[:, :nv] / (2.0 * dt)
        said = f"Gait: {said}, steps of up to {longest_step(places):.2g} m, feet lifted by {lift:.2g} m."
        return GaitMotion(xs, said, self._stances([foot.name for foot in standing], swings))

    def stepping_links(self, mechanism: Mechanism, x: np.ndarray) -> frozenset[int]:
        """Links of the feet of a machine that stands at x (nx,) that swing at some time."""
        stay = set.intersection(*(set(phase.stand) for phase in self.phases)) if self.phases else set()
        return frozenset(foot.link for foot in standing_feet(mechanism, x) if foot.name not in stay)

    def lift_of(self, height: float) -> float:
        """m, by which feet are lifted, of a machine whose centre of mass has a height, m."""
        return min(CLEARANCE, 0.2 * height) if self.lift is None else self.lift

    @property
    def always_stands(self) -> bool:
        """Whether a foot stands at all times: none leaves the ground while all others swing."""
        if self.phases:
            return all(phase.stand for phase in self.phases)
        turns = np.array(list(self.feet.values()) if self.kind is None else [0.0, 0.5])  # that all kinds have
        return not _in_air(turns, self.times_of(turns)[1]).all(axis=1).any()

    def _stances(self, names: list[str], swings: list[list[tuple[float, float]]]) -> tuple[Stance, ...]:
        """What phases or turns ask of feet with these names, which swing so, s."""
        if not self.phases:
            return stances_of_swings(names, swings)
        spans = [(begin, phase.until) for begin, phase in zip(self._begins, self.phases, strict=True)]
        return stances_of_phases(names, spans, [phase.stand for phase in self.phases])

    @property
    def _begins(self) -> list[float]:
        """s, when each phase begins."""
        return [0.0, *(phase.until for phase in self.phases[:-1])]

    def _swings_of_turns(
        self, mechanism: Mechanism, standing: list[Foot], dragged: np.ndarray, times: tuple[float, float], h: float,
        centre: np.ndarray,
    ) -> tuple[list[list[tuple[float, float]]], str]:  # fmt: skip
        """Begin and end of each foot's swings, s; and words about them.

        Args:
            mechanism: The machine.
            standing: Its feet.
            dragged: (N+1, F, 3) m, where the motion has them.
            times: s, when it comes to rest, and its duration.
            h: m, the height of the centre of mass.
            centre: (3,) m, where it is at the start.
        """
        turns = self.turns(standing, dragged)
        slots, duty, lead = self.times_of(turns)
        distance = float(np.linalg.norm(np.diff(dragged, axis=0), axis=2).sum(axis=0).max())
        g = float(np.linalg.norm(mechanism.gravity)) or 1.0
        falling, (moving, duration), wait, slot = math.sqrt(h / g), times, 0.0, 1.0
        if len(standing) == 2 and self.kind == "walk":
            wait, slot = SHIFT * falling, 2.0
            moving, cycle = duration - 2.0 * wait, 0.0 if self.stride else slots * slot * falling
            if moving <= cycle:
                raise PlannerError(
                    f"duration is {duration:g} s, and a walk on two feet takes {wait:.2g} s before and after it, in "
                    f"which the weight goes to one foot and back: expected more than {2.0 * wait + cycle:.2g} s."
                )
        cycles = round(moving / (slots * slot * falling)) if self.stride is None else math.ceil(distance / self.stride)
        if self.stride is None and _holds(dragged[0] - centre, turns, duty, standing[0].normal):
            cycles = min(cycles, math.ceil(distance / (STRIDE * h)))
        cycles = max(1, cycles)
        T = moving / (cycles - 1 + lead + float(turns.max()) + 1.0 - duty)
        begins = wait + T * (np.arange(cycles)[:, None] + lead + turns)  # (cycles, feet) s
        swings = [[(float(t), float(t + (1.0 - duty) * T)) for t in column] for column in begins.T]
        return swings, f"{cycles} cycles of {T:.3g} s, feet standing for {duty:.2g} of the time"

    def swings_of_phases(
        self, standing: list[Foot], duration: float
    ) -> tuple[list[list[tuple[float, float]]], str]:  # fmt: skip
        """Begin and end of each foot's swings, s, by the phases; and words about them."""
        names = [foot.name for foot in standing]
        for k, phase in enumerate(self.phases, 1):
            for name in phase.stand:
                choice(f"a foot that stands in [[phase]] {k}", name, names)
        ends = [*self._begins[1:], min(self.phases[-1].until, duration)]
        if ends[-1] < duration * (1.0 - ROUNDING) or np.any(np.diff([0.0, *ends]) <= 0.0):
            raise PlannerError(
                f"the phases end at {', '.join(f'{t:g}' for t in ends)} s, expected times that grow to the duration, "
                f"{duration:g} s, or no `until` in the last phase."
            )
        swings = []
        for name in names:
            up = [j for j, phase in enumerate(self.phases) if name not in phase.stand]
            runs = [(j, next(i for i in range(j, len(ends) + 1) if i not in up)) for j in up if j - 1 not in up]
            landings = [*ends[:-1], math.inf]
            swings.append([(self._begins[first], landings[after - 1]) for first, after in runs])
        return swings, f"{len(ends)} phases"

    def times_of(self, turns: np.ndarray) -> tuple[int, float, float]:
        """The slots of a cycle, the share in which a foot stands, and that before the first one leaves the ground."""
        slots = len(np.unique(turns))
        duty = 1.0 - (1.0 - OVERLAP) / slots if self.duty is None else self.duty
        return slots, duty, max(0.0, 1.0 / slots - (1.0 - duty))

    def turns(self, standing: list[Foot], dragged: np.ndarray) -> np.ndarray:
        """(F,) the turn of each standing foot."""
        names = [foot.name for foot in standing]
        if self.feet:
            for name in self.feet:
                choice("a foot of the gait", name, names)
            if missing := [name for name in names if name not in self.feet]:
                raise PlannerError(f"the gait has no turn of {missing[0]!r}, expected one for: {', '.join(names)}.")
            return np.array([self.feet[name] for name in names])
        if len(standing) == 2 and self.kind == "walk":
            return np.array(TURNS["walk"][:2])
        if len(standing) != 4:
            two = 'gait = "walk" or ' if len(standing) == 2 else ""
            raise PlannerError(
                f"gait is {self.kind!r}, for machines of four feet, walk for two too, and this one stands on "
                f"{len(standing)} ({', '.join(names)}): expected {two}gait = {{ feet = {{ NAME = 0.0, ... }} }}, with "
                "turns from 0 to 1."
            )
        # The longer side of the feet is the machine's; forwards is where it goes.
        at, up = dragged[0] - dragged[0].mean(axis=0), standing[0].normal
        forward = np.linalg.svd(at - np.outer(at @ up, up))[2][0]
        ahead = (dragged[-1] - dragged[0]).mean(axis=0) @ forward
        forward *= -1.0 if ahead < 0.0 or (ahead == 0.0 and forward.sum() < 0.0) else 1.0
        left = np.cross(up, forward)
        order = np.argsort(at @ forward, kind="stable")
        order = np.concatenate([part[np.argsort(-at[part] @ left, kind="stable")] for part in (order[:2], order[2:])])
        turns = np.empty(4)
        turns[order] = TURNS[str(self.kind)]
        return turns


def _in_air(turns: np.ndarray, duty: float) -> np.ndarray:
    """(F, F) bool, which feet (of a row) are in the air once that of the row has left the ground; turns (F,)."""
    return (turns[:, None] - turns) % 1.0 < 1.0 - duty - ROUNDING


def _holds(feet: np.ndarray, turns: np.ndarray, duty: float, normal: np.ndarray) -> bool:
    """Whether feet at (F, 3) m from the centre of mass have it between them whichever swing, by their turns (F,)."""
    level = np.linalg.svd(normal[None])[2][1]
    angles = np.arctan2(feet @ np.cross(normal, level), feet @ level)
    for swing in _in_air(turns, duty):
        around = np.sort(angles[~swing])
        if len(around) < 3 or np.diff(around, append=around[0] + 2.0 * np.pi).max() > WIDEST:
            return False
    return True


def feet_of(mechanism: Mechanism, x: np.ndarray) -> list[Foot]:
    """The feet on which a machine stands at a state (nx,).

    Raises:
        PlannerError: It stands on none.
    """
    standing = standing_feet(mechanism, x)
    if not standing:
        planes = "" if mechanism.contacts else "the model has no plane, so "
        path = str(mechanism.origin.get("path", ""))
        floor = "`floor = true`" if path and is_urdf(path) else 'a <geom type="plane" size="0 0 1"/> in worldbody'
        write = "" if mechanism.contacts else f": {floor}"
        raise PlannerError(
            f"{planes}the machine stands on no foot at the start, expected one on the ground{write}, or no gait."
        )
    return standing


def stands_at(t: np.ndarray, swings: list[list[tuple[float, float]]]) -> np.ndarray:
    """(N, F) bool, whether feet stand at times t (N,), s."""
    return np.stack([~sum(((t > a) & (t < b) for a, b in own), np.zeros(len(t), dtype=bool)) for own in swings], axis=1)


def gait_of(value: Any) -> Gait:
    """A Gait from the name of one, from a table of its attributes, or from a list of tables of phases.

    Raises:
        PlannerError: Another type, an unknown name or key, or a number out of range.
    """
    if isinstance(value, list):
        return Gait(phases=tuple(phase_of(table, k, len(value)) for k, table in enumerate(value, 1)))
    table: Any = {"kind": value} if isinstance(value, str) else value
    keys = ("kind", "feet", "duty", "stride", "lift")
    if not isinstance(table, Mapping):
        raise PlannerError(
            f"gait is {short_repr(value)}, expected one of {', '.join(TURNS)}, or a table of some of: "
            f"{', '.join(keys)}."
        )
    given = {choice("a key of gait", key, keys): part for key, part in table.items()}
    feet = given.get("feet", {})
    if ("kind" in given) == bool(feet) or not isinstance(feet, Mapping):
        raise PlannerError(f"gait has kind and feet, or neither: expected one of {', '.join(TURNS)}, or turns of feet.")
    if "kind" in given:
        choice("gait", given["kind"], TURNS)
    for foot, turn in feet.items():
        number(f"the turn of {foot}", turn, minimum=0.0, maximum=1.0)
    for key, upper in (("duty", 0.95), ("stride", math.inf), ("lift", math.inf)):
        if key in given:
            number(f"{key} of gait", given[key], greater_than=0.0, maximum=upper)
    return Gait(**given)


def with_feet_of(gait: Gait, mechanism: Mechanism) -> Gait:
    """The gait with the names of the bodies that joints move in place of those of bodies and shapes fixed to them.

    A body comes before a geom of the same name; a name that nothing has stays, to be refused with those of the feet.

    Raises:
        PlannerError: Two names with turns are those of one foot.
    """
    links = {
        name: body.link for name, body in zip(mechanism.body_names, mechanism.bodies, strict=True) if body.link >= 0
    }
    given = {*gait.feet, *(name for phase in gait.phases for name in phase.stand)}
    if given - {*links}:
        index = model_index_of(mechanism)
        shapes = {index.model.geom(g).name: index.carriers[0][body] for g, body in enumerate(index.model.geom_bodyid)}
        links = {name: int(link) for name, link in shapes.items() if name and link >= 0} | links
    names = {name: mechanism.body_of(links[name]) if name in links else name for name in given}
    called: dict[str, str] = {}
    for name in gait.feet:
        if (other := called.setdefault(names[name], name)) != name:
            raise PlannerError(
                f"the gait has turns of {other!r} and {name!r}, which are one foot, expected one of them."
            )
    return replace(
        gait,
        feet={names[name]: turn for name, turn in gait.feet.items()},
        phases=tuple(phase._replace(stand=tuple(names[name] for name in phase.stand)) for phase in gait.phases),
    )
