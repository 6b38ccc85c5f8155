"""Gait: which feet swing when, by name or by phases, and the motion of a machine that steps so, as a reference.

The machine follows `rows`, a motion of the whole of it in which the feet are dragged; its legs are bent so that its
feet step instead. In each of n cycles of T seconds a foot stands for the share `duty` and swings for the rest. Cycles
have as many slots as feet have different turns; foot k leaves the ground in cycle c at

    t = T (c + turn_k + max(0, 1 / slots - (1 - duty))),    turn_k in 0 ... 1.

It stands where the motion has it in the middle of its stance, so that the body passes over it symmetrically (Raibert,
Legged Robots That Balance, 1986), at first where it stood at the start and at last where the motion ends. On its way it
rises by lift 64 (s (1 - s))^3, at rest at both ends. By default a slot lasts sqrt(h / g), h the height of the centre of
mass: in that time an inverted pendulum falls away by a factor e.

Phases say the times of each swing in place of these rules. A foot that is still in the air at the end goes to where the
motion has it.

Nothing enforces contacts. Weights of positions and velocities refer to this motion; the solver finds the forces, and
when feet touch.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import choice, number, short_repr
from planner.base.errors import PlannerError
from planner.dynamics.contacts import contact_forces
from planner.dynamics.kinematics import points_of
from planner.dynamics.momentum import center_of_mass, center_of_mass_jacobian
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.mechanism import Mechanism
from planner.problem.costs.slip import CLEARANCE
from planner.problem.initial_guess import minimum_jerk
from planner.problem.tasks.flight import check_flight_time

# Turns of the rear left, rear right, front left and front right foot; walk has the lateral sequence.
TURNS = {
    "trot": (0.5, 0.0, 0.0, 0.5),
    "walk": (0.0, 0.5, 0.25, 0.75),
    "bound": (0.5, 0.5, 0.0, 0.0),
    "pace": (0.0, 0.5, 0.0, 0.5),
}
OVERLAP = 0.2  # of a slot, in which feet of two turns stand by default
NEWTON = 50  # iterations of the legs' inverse kinematics
LONGEST_STEP = 0.3  # rad or m: beyond it a leg that is nearly stretched turns over
REACHED = 5e-3  # m: of a foot from its place; a sole that turns on its way is bent by less
STILL = 1e-6  # m or rad and their rates: by which a motion at rest changes by rounding alone
DAMPING = 1e-3  # m: of a singular leg, which is stretched


class Phase(NamedTuple):
    """A part of a motion, and who stands in it."""

    until: float  # s
    stand: tuple[str, ...]  # names of bodies; the other feet swing


class _Foot(NamedTuple):
    """A body that stands on the ground at the start."""

    name: str
    link: int
    points: np.ndarray  # (K, 3) m, its loaded contacts in the link's frame: of a sole its corners
    normal: np.ndarray  # (3,) of the ground


@dataclass(frozen=True)
class Gait:
    """A gait.

    Attributes:
        kind: One of TURNS, for machines of four feet; None with `feet` or `phases`.
        feet: Turns by the names of bodies, 0 to 1: when in a cycle each begins to swing.
        duty: Share of a cycle in which a foot stands; by default feet of two turns overlap by OVERLAP of a slot.
        stride: m, at most, of the motion in a cycle; by default a slot lasts sqrt(h / g).
        lift: m, of a swinging foot; by default a fifth of the height of the centre of mass, at most CLEARANCE.
        phases: One after another, in place of turns; the last lasts to the end of the motion.
    """

    kind: str | None = None
    feet: Mapping[str, float] = field(default_factory=dict)
    duty: float | None = None
    stride: float | None = None
    lift: float | None = None
    phases: tuple[Phase, ...] = ()

    def motion(self, mechanism: Mechanism, rows: np.ndarray, dt: float, ranges: np.ndarray) -> tuple[np.ndarray, str]:
        """The states (N+1, nx) of the gait along a motion `rows` (N+1, nx), and a sentence about it.

        Args:
            mechanism: The machine.
            rows: Begins and ends at rest, on the ground.
            dt: s.
            ranges: (nv, 2) rad or m, of hinges and slides.

        Raises:
            PlannerError: The machine has other feet, or its legs do not reach their footholds.
        """
        nq, nv, space = mechanism.nq, mechanism.nv, mechanism.space
        standing = _standing(mechanism, rows[0])
        if not standing:
            raise PlannerError("the machine stands on no foot at the start, expected one on the ground, or no gait.")
        dragged = _points_of(mechanism, rows[:, :nq], standing)[0]
        firsts = np.cumsum([0, *(len(foot.points) for foot in standing[:-1])])
        feet = np.stack([part.mean(axis=1) for part in np.split(dragged, firsts[1:], axis=1)], axis=1)
        normals = np.array([foot.normal for foot in standing])
        h = float(normals[0] @ (center_of_mass(mechanism, rows[0, :nq]) - feet[0].mean(axis=0)))
        lift = min(CLEARANCE, 0.2 * h) if self.lift is None else self.lift
        if self.phases:
            swings, said = self._swings_of_phases(standing, dt * (len(rows) - 1))
            for k, (begin, phase) in enumerate(zip(self._begins, self.phases, strict=True), 1):
                if not phase.stand:
                    end = min(phase.until, dt * (len(rows) - 1))
                    check_flight_time(mechanism, f"[[phase]] {k}", end - begin, ranges)
        else:
            swings, said = self._swings_of_turns(mechanism, standing, feet, dt * _last_change(rows), h)
        of_foot = np.repeat(np.arange(len(standing)), [len(foot.points) for foot in standing])
        places = _stepping(dragged, normals[of_foot], [swings[k] for k in of_foot], lift, dt)
        q = rows[:, :nq]
        if self.phases:
            t = dt * np.arange(len(rows))
            swinging = [sum(((t > a) & (t < b) for a, b in own), np.zeros(len(t), dtype=bool)) for own in swings]
            stands = ~np.array(swinging).T
            q = _over_support(mechanism, q, places, stands[:, of_foot], normals[0])
        q = _with_legs(mechanism, q, standing, places, ranges)
        xs = rows.copy()
        xs[:, :nq] = q
        xs[1:-1, nq : nq + nv] = space.difference(xs[2:], xs[:-2])[:, :nv] / (2.0 * dt)
        return xs, f"Gait: {said}, steps of up to {_longest(places):.2g} m, feet lifted by {lift:.2g} m."

    @property
    def _begins(self) -> list[float]:
        """s, when each phase begins."""
        return [0.0, *(phase.until for phase in self.phases[:-1])]

    def _swings_of_turns(
        self, mechanism: Mechanism, standing: list[_Foot], dragged: np.ndarray, moving: float, h: float
    ) -> tuple[list[list[tuple[float, float]]], str]:
        """Begin and end of each foot's swings, s, in `moving` s, by a centre of mass h m high; and words about them."""
        turns = self._turns(standing, dragged)
        slots = len(np.unique(turns))
        duty = 1.0 - (1.0 - OVERLAP) / slots if self.duty is None else self.duty
        lead = max(0.0, 1.0 / slots - (1.0 - duty))
        distance = float(np.linalg.norm(np.diff(dragged, axis=0), axis=2).sum(axis=0).max())
        g = float(np.linalg.norm(mechanism.gravity)) or 1.0
        cycles = (
            round(moving / (slots * math.sqrt(h / g))) if self.stride is None else math.ceil(distance / self.stride)
        )
        cycles = max(1, cycles)
        T = moving / (cycles - 1 + lead + float(turns.max()) + 1.0 - duty)
        begins = T * (np.arange(cycles)[:, None] + lead + turns)  # (cycles, feet) s
        swings = [[(float(t), float(t + (1.0 - duty) * T)) for t in column] for column in begins.T]
        return swings, f"{cycles} cycles of {T:.3g} s, feet standing for {duty:.2g} of the time"

    def _swings_of_phases(
        self, standing: list[_Foot], duration: float
    ) -> tuple[list[list[tuple[float, float]]], str]:  # fmt: skip
        """Begin and end of each foot's swings, s, by the phases; and words about them."""
        names = [foot.name for foot in standing]
        for k, phase in enumerate(self.phases, 1):
            for name in phase.stand:
                choice(f"a foot that stands in [[phase]] {k}", name, names)
        ends = [*self._begins[1:], min(self.phases[-1].until, duration)]
        if ends[-1] < duration or np.any(np.diff([0.0, *ends]) <= 0.0):
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

    def _turns(self, standing: list[_Foot], dragged: np.ndarray) -> np.ndarray:
        """(F,) the turn of each standing foot."""
        names = [foot.name for foot in standing]
        if self.feet:
            for name in self.feet:
                choice("a foot of the gait", name, names)
            if missing := [name for name in names if name not in self.feet]:
                raise PlannerError(f"the gait has no turn of {missing[0]!r}, expected one for: {', '.join(names)}.")
            return np.array([self.feet[name] for name in names])
        if len(standing) != 4:
            raise PlannerError(
                f"gait is {self.kind!r}, for machines of four feet, and this one stands on {len(standing)} "
                f"({', '.join(names)}): expected gait = {{ feet = {{ NAME = turn from 0 to 1, ... }} }}."
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


def gait_of(value: Any) -> Gait:
    """A Gait from the name of one, from a table of its attributes, or from a list of tables of phases.

    Raises:
        PlannerError: Another type, an unknown name or key, or a number out of range.
    """
    if isinstance(value, list):
        return Gait(phases=tuple(_phase(table, k, len(value)) for k, table in enumerate(value, 1)))
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


def _phase(table: Any, k: int, of: int) -> Phase:
    """Phase k of a list, from its table."""
    where = f"[[phase]] {k}"
    if not isinstance(table, Mapping):
        raise PlannerError(f"{where} is {short_repr(table)}, expected a table of until and stand.")
    for key in table:
        choice(f"a key of {where}", key, ("until", "stand"))
    stand = table.get("stand")
    if not isinstance(stand, (list, tuple)) or not all(isinstance(name, str) for name in stand):
        raise PlannerError(f"stand of {where} is {short_repr(stand)}, expected names of bodies, [] for none.")
    if "until" not in table and k < of:
        raise PlannerError(f"{where} has no `until`, expected the time of its end, s; only the last needs none.")
    until = number(f"until of {where}", table["until"], greater_than=0.0) if "until" in table else math.inf
    return Phase(until, tuple(stand))


def _standing(mechanism: Mechanism, x: np.ndarray) -> list[_Foot]:
    """The bodies that bear load at a state (nx,)."""
    forces = contact_forces(mechanism, x[: mechanism.nq], np.zeros(mechanism.nv)).forces
    loaded = [one for one, force in zip(mechanism.contacts, forces, strict=True) if force.any()]
    feet = []
    for link in dict.fromkeys(one.link for one in loaded):
        own = [one for one in loaded if one.link == link]
        name = next((mechanism.body_names[k] for k, body in enumerate(mechanism.bodies) if body.link == link), "")
        feet.append(_Foot(name, link, np.array([one.centre for one in own]), np.array(own[0].plane.normal)))
    return feet


def _points_of(mechanism: Mechanism, q: np.ndarray, feet: list[_Foot]) -> tuple[np.ndarray, np.ndarray]:
    """Places (N, K, 3) m of the feet's points at configurations q (N, nq), and Jacobians (N, K, 3, nv)."""
    links = np.repeat([foot.link for foot in feet], [len(foot.points) for foot in feet])
    return points_of(mechanism, q, links, np.vstack([foot.points for foot in feet]))


def _last_change(rows: np.ndarray) -> int:
    """The knot at which a motion (N+1, nx) comes to rest; all of it where it does not move."""
    changes = np.flatnonzero(np.abs(np.diff(rows, axis=0)).max(axis=1) > STILL)
    return int(changes[-1]) + 1 if len(changes) else len(rows) - 1


def _stepping(
    dragged: np.ndarray, normals: np.ndarray, swings: list[list[tuple[float, float]]], lift: float, dt: float
) -> np.ndarray:  # fmt: skip
    """(N+1, F, 3) m, feet that stand and swing along where they are dragged.

    Args:
        dragged: (N+1, F, 3) m.
        normals: (F, 3) of the ground, along which feet stay as high as at the start.
        swings: Of each foot, s, when swings begin and end; inf for one that ends in the air.
        lift: m.
        dt: s.
    """
    t = dt * np.arange(len(dragged))
    places = np.tile(dragged[0], (len(t), 1, 1))
    for k, n in enumerate(normals):
        level = dragged[:, k] - np.outer((dragged[:, k] - dragged[0, k]) @ n, n)
        here = level[0]
        following = [*(begin for begin, _ in swings[k]), np.inf][1:]
        for (begin, end), then in zip(swings[k], following, strict=True):
            middle = min(0.5 * (end + then), t[-1])
            there = np.array([np.interp(middle, t, level[:, axis]) for axis in range(3)])
            if end == math.inf:
                there = dragged[-1, k]
            after = t > begin
            s = np.minimum((t[after] - begin) / (min(end, t[-1]) - begin), 1.0)
            places[after, k] = here + minimum_jerk(s)[0][:, None] * (there - here)
            if end < math.inf:
                places[after, k] += lift * 64.0 * ((s * (1.0 - s)) ** 3)[:, None] * n
            here = there
    return places


def _over_support(
    mechanism: Mechanism, q: np.ndarray, places: np.ndarray, stands: np.ndarray, n: np.ndarray
) -> np.ndarray:  # fmt: skip
    """Configurations whose base is shifted along the ground such that the standing feet carry the machine.

    Where some feet swing the centre of mass is above the middle of the others (quasi-static); before, between and after
    it the shift changes smoothly.

    Args:
        mechanism: The machine.
        q: (N+1, nq), where the motion has it.
        places: (N+1, K, 3) m, of the feet's points.
        stands: (N+1, K) bool.
        n: (3,) the normal of the ground.
    """
    whole = center_of_mass_jacobian(mechanism, q[0])  # of slides that move all of the machine it is their axis
    base = np.flatnonzero((np.abs(np.linalg.norm(whole, axis=0) - 1.0) < 1e-9) & ~mechanism.directly_actuated)
    if stands.all() or not base.size:
        return q
    some = stands.any(axis=1) & ~stands.all(axis=1)
    weights = stands[some] / stands[some].sum(axis=1, keepdims=True)
    shift = np.zeros((len(q), 3))
    shift[some] = np.einsum("nk,nka->na", weights, places[some]) - center_of_mass(mechanism, q[some])
    knots = np.flatnonzero(some)
    ends = np.unique([*([] if some[0] else [0]), *knots, *([] if some[-1] else [len(q) - 1])])
    for a, b in pairwise(ends):
        share = minimum_jerk(np.linspace(0.0, 1.0, b - a + 1))[0][1:-1, None]
        shift[a + 1 : b] = shift[a] + share * (shift[b] - shift[a])
    q, level = q.copy(), shift - np.outer(shift @ n, n)
    q[:, mechanism.q_address[base]] += level @ np.linalg.pinv(whole[:, base]).T
    return q


def _longest(places: np.ndarray) -> float:
    """m, of the longest step: feet stand between steps."""
    displacements = np.linalg.norm(np.diff(places, axis=0), axis=2)
    steps = [part.sum() for row in displacements.T for part in np.split(row, np.flatnonzero(row == 0.0))]
    return float(max(steps, default=0.0))


def _with_legs(
    mechanism: Mechanism, q: np.ndarray, feet: list[_Foot], places: np.ndarray, ranges: np.ndarray
) -> np.ndarray:  # fmt: skip
    """Configurations (N+1, nq) with the feet's points at places (N+1, K, 3), m, by Newton steps of the legs from q."""
    if mechanism.reduction is not None or mechanism.has_closed_chains:
        raise PlannerError("gait is for legs without closed chains and coupled joints, expected a [[goal]] without it.")
    legs = np.zeros(mechanism.nv, dtype=bool)
    for foot in feet:
        legs[chain_of(mechanism.parent, foot.link)] = True
    own = np.flatnonzero(legs & mechanism.directly_actuated)
    at = mechanism.q_address[own]

    def newton(q: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The configurations and the errors (N+1, K) m of their points."""
        q, rows = q.copy(), 3 * places.shape[1]
        for _ in range(NEWTON):
            here, J = _points_of(mechanism, q, feet)
            away = (places - here).reshape(len(q), rows)
            if np.abs(away).max() < 0.002 * REACHED:
                break
            J = J.reshape(len(q), rows, mechanism.nv)[:, :, own]
            damped = J @ np.swapaxes(J, 1, 2) + DAMPING**2 * np.eye(rows)
            step = (np.swapaxes(J, 1, 2) @ np.linalg.solve(damped, away[:, :, None]))[:, :, 0]
            q[:, at] = np.clip(q[:, at] + np.clip(step, -LONGEST_STEP, LONGEST_STEP), *ranges[own].T)
        return q, np.linalg.norm(places - _points_of(mechanism, q, feet)[0], axis=2)

    q, errors = newton(q, places)
    for k in np.flatnonzero(errors.max(axis=1) > REACHED):  # a leg nearly stretched: again, from the knot before

        def away(y: np.ndarray, k: int = k) -> tuple[np.ndarray, np.ndarray]:
            q[k, at] = y
            here, J = _points_of(mechanism, q[k : k + 1], feet)
            return (here[0] - places[k]).ravel(), J.reshape(-1, mechanism.nv)[:, own]

        from scipy.optimize import least_squares  # 0.4 s that `planner run` need not pay

        low, high = ranges[own].T
        begin = np.clip(q[max(k - 1, 0), at], low + STILL, high - STILL)
        found = least_squares(lambda y: away(y)[0], begin, lambda y: away(y)[1], bounds=(low, high))  # pyright: ignore
        errors[k] = np.linalg.norm(away(found.x)[0].reshape(-1, 3), axis=1)
    if errors.max() > REACHED:
        names, worst = [foot.name for foot in feet for _ in foot.points], int(errors.max(axis=0).argmax())
        raise PlannerError(
            f"the gait takes {names[worst]} {errors.max():.2g} m further than its leg reaches within its ranges: "
            "expected a smaller stride or lift, a lower trunk, or a longer duration."
        )
    return q
