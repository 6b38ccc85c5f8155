"""Limits: bounds of the controls, ranges of joints and their velocities, and goals to be met exactly.

    lower <= u(n) <= upper                            met exactly, in the sweep and in every rollout
    lower <= x_i(n) <= upper   for n = 1 ... N        to a tolerance, by an augmented Lagrangian
    x_i(N) = goal_i                                   likewise

Ranges hold at the knots. What the feedback of a plan asks for is put back within the bounds of the controls.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, number, numbers, shown
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.model.coordinates import coordinates_of
from planner.model.mechanism import DIRECT, SCREW, Mechanism
from planner.model.space import space_of
from planner.problem.costs.terms import Cost
from planner.problem.costs.weights import places
from planner.problem.state_ranges import StateRanges

TOLERANCE = 1e-4  # rad, m, rad/s, m/s
MODEL, EXACT = "model", "exact"
Pair = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Limits:
    """Bounds and goals that a plan keeps. A bound of None or infinity is none.

    Attributes:
        control: (lower, upper), each a number, (nu,) or (N, nu); a number b for -b to b; a dict of numbers or pairs
            by the names of actuators; "model" for the model's ctrlrange, and forcerange where it bounds a control.
        position: (lower, upper) by the names of hinge and slide joints, or "model" for their ranges. rad or m.
        velocity: A number for all joints, or by joint a number or (lower, upper). rad/s or m/s.
        state: (lower, upper) by the index of a component of the deviation, for a machine without named joints.
        final: "exact" for all that has a final weight, or names of joints (their positions and velocities), or
            indices of components of the deviation: what is to end at the cost's own goal.
        tolerance: How far a state may be outside its range, or from an exact goal.

    Raises:
        PlannerError: Where a Problem is made with it: names that the machine does not have, a lower bound above the
            upper one, joints that have no ranges.
    """

    control: Any = None
    position: Any = None
    velocity: Any = None
    state: Any = None
    final: Any = None
    tolerance: float = TOLERANCE

    def __post_init__(self) -> None:
        object.__setattr__(self, "tolerance", number("the limits' tolerance", self.tolerance, above=0.0))

    def to_dict(self) -> dict[str, Any]:
        """As JSON values; what is infinite is None."""
        return {name: _plain(value) for name, value in vars(self).items() if value is not None}

    def repeated(self, parts: int) -> Limits:
        """The same for stages divided into parts: bounds of each stage are those of its parts."""
        if isinstance(self.control, (str, Mapping)) or not isinstance(self.control, Sequence):
            return self
        sides = [np.asarray(part, dtype=float) if np.ndim(part) == 2 else part for part in self.control]
        control = tuple(np.repeat(side, parts, axis=0) if np.ndim(side) == 2 else side for side in sides)
        return replace(self, control=control)

    @classmethod
    def from_dict(cls, table: Any) -> Limits:
        """The limits of a table, to_dict's or a problem.toml's.

        Raises:
            PlannerError: It is none, or has a key that is no limit.
        """
        names = list(cls.__dataclass_fields__)
        if not isinstance(table, Mapping):
            raise PlannerError(f"limits is {shown(table)}, expected a table with some of: {', '.join(names)}.")
        return cls(**{choice("the key in [limits]", name, names): value for name, value in table.items()})

    def bounds(self, dynamics: Dynamics, N: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Lower and upper bounds of the controls, (N, nu) each; None where there are none.

        Raises:
            PlannerError: As for the class.
        """
        nu, mechanism = dynamics.nu, getattr(dynamics, "mechanism", None)
        if self.control is None:
            return None
        if isinstance(self.control, str):
            choice("the limits' control", self.control, (MODEL,))
            lower, upper = _of_model(_named(mechanism, "control"), nu)
        elif isinstance(self.control, Mapping):
            inputs = places(_named(mechanism, "control"), getattr(dynamics, "prescribed", ()))[1]
            lower, upper = np.full(nu, -np.inf), np.full(nu, np.inf)
            for name, value in self.control.items():
                place = inputs[choice("the actuator in the limits' control", name, inputs)]
                lower[place], upper[place] = _pair(f"the limit of control {name!r}", value)
        elif isinstance(self.control, Sequence) and len(self.control) == 2:
            lower, upper = _sides("the limits' control", self.control)
        else:
            upper = np.asarray(number("the limits' control", self.control, above=0.0))
            lower = -upper
        lower, upper = _spread(lower, N, nu), _spread(upper, N, nu)
        wrong = np.argwhere(~(lower <= upper) | (lower == np.inf) | (upper == -np.inf))
        if len(wrong):
            n, a = map(int, wrong[0])
            given = f"{lower[n, a]:g} ... {upper[n, a]:g}"
            raise PlannerError(f"control {a} is limited to {given}, expected a lower bound below the upper.")
        return (lower, upper) if np.isfinite(lower).any() or np.isfinite(upper).any() else None

    def ranges(self, dynamics: Dynamics, cost: Cost, x0: np.ndarray, N: int) -> StateRanges | None:
        """The ranges of the states, and exact goals; None where there are none.

        Raises:
            PlannerError: As for the class; a start or a goal outside its range.
        """
        space, mechanism = space_of(dynamics), getattr(dynamics, "mechanism", None)
        coordinates = coordinates_of(dynamics)
        found = self._found(mechanism, space.ndx)
        rotations = {j + c for _, j in space.quaternions for c in range(3)}
        reference = getattr(cost, "x_ref", None)
        at_end = self._at_end(mechanism, cost, space.ndx)
        if reference is None:
            reference = np.tile(x0, (N + 1, 1))
        if not found and not at_end:
            return None
        origin = np.zeros(space.nx)
        for i, _ in space.quaternions:
            origin[i] = 1.0
        offset, start = space.difference(reference, origin), space.difference(x0, origin)
        lower, upper = np.full((2, N + 1, len(found) + len(at_end)), np.inf)
        lower = -lower
        for h, (i, (low, high)) in enumerate(found.items()):
            name, unit = coordinates[i]
            if i in rotations:
                raise PlannerError(f"{name} is an orientation, expected ranges of hinges, slides or velocities.")
            for what, value in (("start", start[i]), *((("goal", offset[-1, i]),) if i in at_end else ())):
                if not low <= value <= high:
                    ranged = f"{low:g} ... {high:g} {unit}".rstrip()
                    raise PlannerError(f"the {what} has {name} at {value:.6g}, expected {ranged}.")
            lower[1:, h], upper[1:, h] = low - offset[1:, i], high - offset[1:, i]
        lower[N, len(found) :] = upper[N, len(found) :] = 0.0
        limited = tuple(coordinates[i] for i in (*found, *at_end))
        component = np.array([*found, *at_end], dtype=np.int64)
        return StateRanges(space, np.asarray(reference), component, lower, upper, len(at_end), limited)

    def _found(self, mechanism: Mechanism | None, ndx: int) -> dict[int, Pair]:
        """(lower, upper) by component."""
        found: dict[int, Pair] = {}
        if self.position is not None:
            machine = _named(mechanism, "position")
            if isinstance(self.position, str):
                choice("the limits' position", self.position, (MODEL,))
            limited = {n: machine.joint_range[machine.joint(n)] for n in machine.joint_names if n}
            limited = {name: ranges[0] for name, ranges in limited.items() if np.isfinite(ranges).any()}
            given = limited if self.position == MODEL else _table("position", self.position)
            for joint, value in given.items():
                links = machine.joint(joint)
                if links.stop - links.start != 1 or machine.kind[links.start] != SCREW:
                    expected = "expected ranges of hinge and slide joints only"
                    raise PlannerError(f"joint {joint!r} is a ball or free joint, {expected}.")
                i = links.start
                found[i] = _pair(f"the range of joint {joint!r}", value)
        if self.velocity is not None:
            machine, given = _named(mechanism, "velocity"), self.velocity
            if not isinstance(given, Mapping):
                most = number("the limits' velocity", given, above=0.0)
                given = {name: most for name in machine.joint_names if name}
            for joint, value in given.items():
                links, pair = machine.joint(joint), _pair(f"the velocity range of joint {joint!r}", value)
                for i in range(machine.nv + links.start, machine.nv + links.stop):
                    found[i] = pair
        for i, value in ({} if self.state is None else _table("state", self.state)).items():
            i = _index("state", i, ndx)
            found[i] = _pair(f"the range of component {i}", value)
        return {i: pair for i, pair in sorted(found.items()) if np.isfinite(pair).any()}

    def _at_end(self, mechanism: Mechanism | None, cost: Cost, ndx: int) -> list[int]:
        """The components that are to end at the goal exactly."""
        if self.final is None:
            return []
        Q = getattr(cost, "Q", None)
        if Q is None or getattr(cost, "x_ref", None) is None:
            raise PlannerError("the cost has no goal of its own to be met exactly, expected a TrackingCost.")
        if isinstance(self.final, str):
            choice("the limits' final", self.final, (EXACT,))
            at_end = np.flatnonzero(np.abs(Q[-1]).max(axis=0)).tolist()
            if not at_end:
                raise PlannerError("no final weight is above 0, expected one where the goal is to be met exactly.")
            return at_end
        if not isinstance(self.final, Sequence) or not self.final:
            raise PlannerError(f"final is {shown(self.final)}, expected 'exact', or a list of joints or of indices.")
        at_end = []
        for part in self.final:
            if isinstance(part, str):
                machine = _named(mechanism, "final")
                links = machine.joint(part)
                inside = range(links.start, links.stop)
                at_end += [*inside, *(machine.nv + i for i in inside)]
            else:
                at_end.append(_index("final", part, ndx))
        return sorted(set(at_end))


def _named(mechanism: Mechanism | None, what: str) -> Mechanism:
    if mechanism is None:
        raise PlannerError(f"the limits' {what} has names, but the dynamics have no mechanism: expected numbers.")
    return mechanism


def _table(name: str, value: Any) -> Mapping[Any, Any]:
    if not isinstance(value, Mapping):
        raise PlannerError(f"the limits' {name} is {shown(value)}, expected a table of (lower, upper).")
    return value


def _index(name: str, value: Any, ndx: int) -> int:
    value = int(value) if isinstance(value, str) and value.isdigit() else value  # a key of JSON
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 <= value < ndx:
        raise PlannerError(f"the limits' {name} has {shown(value)}, expected an index of 0 to {ndx - 1}.")
    return int(value)


def _pair(name: str, value: Any) -> Pair:
    """(lower, upper) from a pair, or from a number b for -b to b."""
    if isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, str):
        if len(value) != 2:
            raise PlannerError(f"{name} is {shown(value)}, expected (lower, upper).")
        sides = _sides(name, value)
        if any(side.ndim for side in sides):
            raise PlannerError(f"{name} is {shown(value)}, expected (lower, upper).")
        low, high = map(float, sides)
    else:
        high = number(name, value, above=0.0)
        low = -high
    if not low <= high or low == np.inf or high == -np.inf:
        raise PlannerError(f"{name} is {shown(value)}, expected a lower bound below the upper.")
    return low, high


def _plain(value: Any) -> Any:
    """A limit as JSON values."""
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    value = value.item() if isinstance(value, np.number) else value
    if isinstance(value, float) and not np.isfinite(value):  # an int may be larger than any float
        return None
    return value


def _of_model(mechanism: Mechanism, nu: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (nu,) of the controls from ctrlrange, forcerange and actuatorfrcrange."""
    acts = mechanism.actuators
    lower, upper = np.full(nu, -np.inf), np.full(nu, np.inf)
    lower[: acts.nu], upper[: acts.nu] = acts.control_range.T
    for a, name in enumerate(acts.names):
        ranges = [(acts.force_range[a], acts.gain[a], "forcerange", 1)]
        for i in np.flatnonzero(acts.moment[a]):
            several, gain = int(np.count_nonzero(acts.moment[:, i])), acts.gain[a] * acts.moment[a, i]
            ranges.append((mechanism.joint_force_range[i], gain, "actuatorfrcrange", several))
        for limits, gain, what, several in ranges:
            if not np.isfinite(limits).any():
                continue
            if acts.dynamics[a] != DIRECT or np.any(acts.bias[a]) or several > 1 or gain == 0.0:
                raise PlannerError(
                    f"actuator {name!r} has a {what} that is no bound of its control alone, "
                    f"expected one of a motor that drives its joint alone."
                )
            low, high = sorted(limits / gain)
            lower[a], upper[a] = max(lower[a], low), min(upper[a], high)
    return lower, upper


def _sides(name: str, pair: Any) -> list[np.ndarray]:
    """Lower and upper bounds with infinity in the place of None; NaN is refused."""
    sides = [numbers(name, _filled(part, none)) for part, none in zip(pair, (-np.inf, np.inf), strict=True)]
    if any(np.isnan(side).any() for side in sides):
        raise PlannerError(f"{name} has a bound that is not a number, expected numbers or None.")
    return sides


def _filled(value: Any, none: float) -> Any:
    if value is None:
        return none
    return [_filled(part, none) for part in value] if isinstance(value, (list, tuple)) else value


def _spread(bound: np.ndarray, N: int, nu: int) -> np.ndarray:
    """Bounds (N, nu) from a number, (nu,) or (N, nu)."""
    if bound.ndim == 1:
        bound = array("the limits' control", bound, (nu,), any_value=True)
    if bound.ndim <= 1:
        bound = np.broadcast_to(bound, (N, nu))
    return array("the limits' control", bound, (N, nu), any_value=True)
