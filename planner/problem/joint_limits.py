"""Limits as they may be written, and ranges of joints from them: those of the model less a margin.

A limit is a pair, a number, None, infinity or a word; here it becomes arrays, or JSON values. A start or goal within
the margin widens the bound to it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array, choice, number, numbers, short_repr, toml_key, word_or_numbers
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.dynamics.assembly import assembled
from planner.model.coordinates import ANGLE, LENGTH, Coordinate, coordinates_of, coordinates_of_mechanism
from planner.model.couplings import closed_state
from planner.model.mechanism import SCREW, Mechanism

MODEL, OFF = "model", "off"
Pair = tuple[float, float]


TENDON_ROUNDING = 1e-9  # rad or m, rounding of a length that equalities fix
SHARE = 0.01  # of a range, the default margin
MIN_MARGINS = {ANGLE: 0.01, LENGTH: 1e-3}  # rad, m: a constant control overshoots by a dt^2 / 8 between knots
MAX_SHARE = 0.1  # of a range, upper limit of the margin: the fingers of a gripper move by few millimetres
YIELDS = 0.1  # of a range: how far beyond a stop that gives a joint may lean
START_OFFSET = 1e-3  # rad or m, by which a start at a limit is moved inside: a replay that errs meets no stop
GOAL_OFFSET = 1e-4  # rad or m, the same of a goal, whose tolerance may be small: the tolerance of limits
ROUNDING = 1e-6  # share of a range; a start outside by less is at the limit


def with_names(mechanism: Mechanism | None, what: str) -> Mechanism:
    """The machine whose names a limit has; refuses dynamics without one."""
    if mechanism is None:
        raise PlannerError(f"the limits' {what} has names, but the dynamics have no mechanism: expected numbers.")
    return mechanism


def table_of(name: str, value: Any) -> Mapping[Any, Any]:
    """A limit that must be a table."""
    if not isinstance(value, Mapping):
        raise PlannerError(f"the limits' {name} is {short_repr(value)}, expected a table of (lower, upper).")
    return value


def component_of(name: str, value: Any, ndx: int) -> int:
    """The index of a component of the deviation, 0 to ndx - 1."""
    value = int(value) if isinstance(value, str) and value.isdigit() else value  # a key of JSON
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 0 <= value < ndx:
        raise PlannerError(f"the limits' {name} has {short_repr(value)}, expected an index of 0 to {ndx - 1}.")
    return int(value)


def check_word(name: str, value: Any, example: str) -> None:
    """Refuse a word for limits by name that is neither MODEL nor OFF, with an example of what to write."""
    if isinstance(value, str):
        word_or_numbers(f"the limits' {name}", value, (MODEL, OFF), example)


def is_word(value: Any, word: str) -> bool:
    """Whether a limit is this word; an array never is."""
    return isinstance(value, str) and value == word


def pair_of(name: str, value: Any) -> Pair:
    """(lower, upper) from a pair, from a number b for -b to b, or "off" for none."""
    if is_word(value, OFF):
        return -np.inf, np.inf
    if isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, str):
        if len(value) != 2:
            raise PlannerError(f"{name} is {short_repr(value)}, expected (lower, upper).")
        sides = sides_of(name, value)
        if any(side.ndim for side in sides):
            raise PlannerError(f"{name} is {short_repr(value)}, expected (lower, upper).")
        low, high = map(float, sides)
    else:
        high = number(name, value, greater_than=0.0)
        low = -high
    if not low <= high or low == np.inf or high == -np.inf:
        raise PlannerError(f"{name} is {short_repr(value)}, expected a lower bound below the upper.")
    return low, high


def json_value(value: Any) -> Any:
    """A limit as JSON values: infinity is None. NaN stays what it is, to be refused."""
    if isinstance(value, Mapping):
        return {str(key): json_value(part) for key, part in value.items()}
    if isinstance(value, np.ndarray):
        return json_value(value.tolist())
    if isinstance(value, (list, tuple)):
        return [json_value(part) for part in value]
    value = value.item() if isinstance(value, np.number) else value
    if isinstance(value, float) and np.isinf(value):  # an int may be larger than any float
        return None
    return value


def sides_of(name: str, pair: Any) -> list[np.ndarray]:
    """Lower and upper bounds with infinity in the place of None; NaN is refused."""
    sides = [numbers(name, _filled(part, none)) for part, none in zip(pair, (-np.inf, np.inf), strict=True)]
    if any(np.isnan(side).any() for side in sides):
        raise PlannerError(f"{name} has a bound that is not a number, expected numbers or None.")
    return sides


def _filled(value: Any, none: float) -> Any:
    if value is None:
        return none
    return [_filled(part, none) for part in value] if isinstance(value, (list, tuple)) else value


def spread(bound: np.ndarray, N: int, nu: int) -> np.ndarray:
    """Bounds (N, nu) from a number, (nu,) or (N, nu)."""
    if bound.ndim == 1:
        bound = array("the limits' control", bound, (nu,), any_value=True)
    if bound.ndim <= 1:
        bound = np.broadcast_to(bound, (N, nu))
    return array("the limits' control", bound, (N, nu), any_value=True)


def pairs_of_coordinates(what: str, value: Any, dynamics: Dynamics) -> dict[int, Pair]:
    """Limits by component, of dynamics whose coordinates have names and units instead of joints."""
    coordinates = coordinates_of(dynamics)
    if isinstance(value, str):
        with_names(None, what)
    if isinstance(value, Mapping):
        places = {one.name: i for i, one in enumerate(coordinates)}
        known = {name: places[choice(f"the coordinate in the limits' {what}", name, places)] for name in value}
        return {known[name]: pair_of(f"the {what} range of {name!r}", part) for name, part in value.items()}
    pair = pair_of(f"the limits' {what}", value)
    halves = getattr(dynamics, "integrator", None) == "semi-implicit-euler"  # positions, then as many velocities
    last = [2 * i >= len(coordinates) if halves else None for i in range(len(coordinates))]
    rates = [one.is_rate if one.unit else known for one, known in zip(coordinates, last, strict=True)]
    found = {i: pair for i, rate in enumerate(rates) if rate is (what == "velocity")}
    if not found:
        raise PlannerError(
            f"the limits' {what} is {short_repr(value)}, but no coordinate of the dynamics has the unit of one: write "
            'coordinates=[("angle", "rad"), ("speed", "rad/s"), ...] of the dynamics, or limits by the index of the '
            "state, state={1: (-4, 4)}, or of all of it, state=4."
        )
    return found


class Leader(NamedTuple):
    """The joint that another one follows, for messages: who follows is slope * leader + offset."""

    name: str
    unit: str
    slope: float
    offset: float

    def value(self, follower: float) -> float:
        """Where it is, in its unit, when its follower is at a value, rad or m."""
        return (follower - self.offset) / self.slope


class Range(NamedTuple):
    """Bounds of a coordinate, with and without the margin."""

    low: float
    high: float
    model_lower: float  # The model's own range; low and high are inside by the margin
    model_upper: float
    of_model: bool = False
    leader: Leader | None = None  # of a joint that follows another one, which is to be written in its place

    @classmethod
    def of(cls, low: float, high: float) -> Range:
        """A range without a margin."""
        return cls(low, high, low, high)

    def widened_to(self, value: float) -> Range | None:
        """The range widened to a value within the margin; None for a value outside of the model's range."""
        width = self.model_upper - self.model_lower
        slack = ROUNDING * width if np.isfinite(width) else 0.0
        if not self.model_lower - slack <= value <= self.model_upper + slack:
            return None
        inside = min(max(value, self.model_lower), self.model_upper)
        return self._replace(low=min(self.low, inside), high=max(self.high, inside))

    def with_state(self, what: str, coordinate: Coordinate, value: float) -> Range:
        """The range widened to a start or goal `what`; PlannerError for a value outside of the model's range."""
        widened = self.widened_to(value)
        if widened is None:
            said = f"the {what} has {coordinate[0]} at {value:.6g} {coordinate[1]}".rstrip()
            raise PlannerError(said + self.refusal(coordinate, value))
        return widened

    def refusal(self, coordinate: Coordinate, value: float) -> str:
        """The end of a message about a value outside of the range: expected range and fix."""
        name, unit = coordinate
        nearest = self.model_lower if value < self.model_lower else self.model_upper
        message, written = f", expected {self.model_lower:g} ... {self.model_upper:g} {unit}".rstrip(), f"{nearest:.6g}"
        if self.leader is not None:
            written = f"{toml_key(self.leader.name)} = {self.leader.value(nearest):.6g}"
            value, unit = self.leader.value(value), self.leader.unit
        message += f": write {written}"
        message += f', or limits.position = {{ {toml_key(name)} = "off" }}.' if self.of_model else "."
        if unit == "rad" and abs(value) > 2.0 * np.pi:
            message += f" Angles are in rad: {value:g} deg are {np.radians(value):.6g}."
        return message


def model_ranges(mechanism: Mechanism, margin: Any) -> dict[int, Range]:
    """Ranges of hinges and slides by degree of freedom, except joints whose stops the mechanism models."""
    stopped = {stop.dof for stop in mechanism.stops}
    found = {}
    for name, links in zip(mechanism.joint_names, mechanism.joint_links, strict=True):
        i = links.start
        low, high = map(float, mechanism.joint_range[i])
        single = links.stop - i == 1 and mechanism.kind[i] == SCREW
        if single and i not in stopped and np.isfinite([low, high]).any():
            keep = min(_margin(mechanism, name, i, margin), 0.5 * (high - low))
            found[i] = Range(low + keep, high - keep, low, high, of_model=True, leader=_leader(mechanism, i))
    return found


def _leader(mechanism: Mechanism, dof: int) -> Leader | None:
    """The one joint that a degree of freedom follows linearly, if it has a name."""
    reduction = mechanism.reduction
    if reduction is None or dof not in reduction.dependent:
        return None
    row, offset = reduction.G[dof], reduction.offset[list(reduction.dependent).index(dof)]
    leading = np.flatnonzero(row)
    if len(leading) != 1:
        return None
    leader = int(reduction.independent[leading[0]])
    name, unit = (
        mechanism.joint_names[_joint_index(mechanism, leader)],
        coordinates_of_mechanism(mechanism)[leader].unit,
    )
    return Leader(name, unit, float(row[leading[0]]), float(offset)) if name else None


def moved_inside_limits(
    mechanism: Mechanism, what: str, x: np.ndarray, limited: Collection[str]
) -> tuple[np.ndarray, str]:
    """A state (nx,) whose joints outside of the model's ranges by at most a margin are moved to the limit.

    A start at the limit is moved inside by START_OFFSET, because coupling forces may first move the joint towards the
    limit; a goal by GOAL_OFFSET. Joints that follow others go with them, and chains stay closed. Unchanged are those in
    `limited`, which have a range from the user, and those that would take what follows them out of its range.

    Returns:
        The state, and a message about the moved joints; `what` is "start" or "goal". "" if none was moved.
    """
    following = () if mechanism.reduction is None else mechanism.reduction.dependent
    result, names, largest = x.copy(), [], 0.0
    ranges = model_ranges(mechanism, None)
    for i, joint_range in ranges.items():
        name, address = mechanism.joint_names[_joint_index(mechanism, i)], int(mechanism.q_address[i])
        off = START_OFFSET if what == "start" else GOAL_OFFSET
        off = min(off, SHARE * (joint_range.model_upper - joint_range.model_lower))
        end = min(max(x[address], joint_range.model_lower + off), joint_range.model_upper - off)
        displacement = abs(end - x[address])
        if 0.0 < displacement <= off + _margin(mechanism, name, i, None) and i not in following and name not in limited:
            candidate = result.copy()
            candidate[address] = end
            candidate = closed_state(mechanism, candidate)
            if _outside(mechanism, ranges, candidate) <= _outside(mechanism, ranges, result) + TENDON_ROUNDING:
                result = candidate
                names.append(mechanism.joint_of(i))
                largest = max(largest, float(displacement))
    if not names:
        return x, ""
    others = f" and {len(names) - 1} more" if len(names) > 1 else ""
    message = f"the {what} has {names[0]}{others} at a stop and is put off it, by up to {largest:.2g} rad or m."
    return assembled(mechanism, result, name=f"the {what} off its stops"), message


def _outside(mechanism: Mechanism, ranges: Mapping[int, Range], x: np.ndarray) -> float:
    """How far a state (nx,) is out of ranges, rad and m together."""
    values = ((x[mechanism.q_address[i]], one) for i, one in ranges.items())
    return float(sum(max(one.model_lower - value, value - one.model_upper, 0.0) for value, one in values))


def unlimited_joints(mechanism: Mechanism, position: Any) -> set[str]:
    """Names of joints that no range or stop of the model limits, by the positions of a Limits."""
    if position is None or is_word(position, OFF):
        return set(mechanism.joint_names)
    table = position if isinstance(position, Mapping) else {}
    return {joint for joint, value in table.items() if is_word(value, OFF)}


def stop_ranges(mechanism: Mechanism, unlimited: Collection[str]) -> dict[int, Range]:
    """Ranges of joints by degree of freedom from end to end of stops with a lead.

    Args:
        mechanism: The machine.
        unlimited: Names of joints whose range the user turned off; they have none.
    """
    ends = dict[int, list[float]]()
    for stop in mechanism.stops:
        if stop.law.lead > 0.0 and mechanism.joint_names[_joint_index(mechanism, stop.dof)] not in unlimited:
            ends.setdefault(stop.dof, []).append(stop.end)
    found = {}
    for i, both in sorted(ends.items()):
        give = YIELDS * (max(both) - min(both))
        found[i] = Range(min(both) - give, max(both) + give, min(both), max(both), of_model=True)
    return found


def check_stops(mechanism: Mechanism, what: str, values: np.ndarray, unlimited: Collection[str]) -> None:
    """Refuse a start or goal `what` (nv,) beyond stops with a lead by more than YIELDS of the file's range.

    Args:
        mechanism: The machine.
        what: "start" or "goal".
        values: (nv,) rad or m.
        unlimited: Names of joints whose range the user turned off.

    Raises:
        PlannerError: A joint is there.
    """
    coordinates = coordinates_of_mechanism(mechanism)
    for i, one in stop_ranges(mechanism, unlimited).items():
        if not one.low <= values[i] <= one.high:
            one.with_state(what, coordinates[i], float(values[i]))


def _joint_index(mechanism: Mechanism, dof: int) -> int:
    return next(k for k, links in enumerate(mechanism.joint_links) if links.start <= dof < links.stop)


def check_margin(mechanism: Mechanism, margin: Any) -> None:
    """Raise a PlannerError unless a margin is None, a number or a table of numbers by joint or tendon."""
    if isinstance(margin, Mapping):
        for joint, value in margin.items():
            known = (*mechanism.joint_names, *(tendon.name for tendon in mechanism.tendons))
            choice("the joint in the limits' margin", joint, [name for name in known if name])
            number(f"the margin of {joint!r}", value, minimum=0.0)
    elif margin is not None:
        if isinstance(margin, str):
            raise PlannerError(f"the limits' margin is {short_repr(margin)}, expected a number or a table by joint.")
        number("the limits' margin", margin, minimum=0.0)


def _margin(mechanism: Mechanism, name: str, i: int, margin: Any) -> float:
    given = margin.get(name) if isinstance(margin, Mapping) else margin
    unit = ANGLE if np.any(mechanism.S[i, :3]) else LENGTH
    return margin_of(float(np.ptp(mechanism.joint_range[i])), unit, given)


def margin_of(width: float, unit: str, given: float | None) -> float:
    """The margin of a range of a width, in rad or m: as given, else the default."""
    if given is not None:
        return float(given)
    if not np.isfinite(width):
        width = 0.0
    min_margin = MIN_MARGINS[unit]
    return max(SHARE * width, min(min_margin, MAX_SHARE * width) if width else min_margin)
