"""Bounds of a plan from ranges of joints and fixed tendons: those of the model less a margin.

A start or goal within the margin widens the bound to it. The constraint of a fixed tendon is

    low <= c'q <= high    at every knot,

with c'q divided by the largest |c|, so that margins and tolerances in rad or m mean the same as for joints. A tendon
has no constraint if the ranges of its joints imply its own, or if equalities fix its length within its range:
MuJoCo's equalities are soft, so the length varies slightly in any motion.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import choice, number, short_repr, toml_key
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.dynamics.assembly import assembled
from planner.model.coordinates import ANGLE, LENGTH, Coordinate
from planner.model.couplings import closed_state
from planner.model.mechanism import SCREW, Mechanism
from planner.model.passive_forces import FixedTendon
from planner.model.space import space_of
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.quantities import mechanism_of

SHARE = 0.01  # of a range, the default margin
MIN_MARGINS = {ANGLE: 0.01, LENGTH: 1e-3}  # rad, m: a constant control overshoots by a dt^2 / 8 between knots
MAX_SHARE = 0.1  # of a range, upper limit of the margin: the fingers of a gripper move by few millimetres
START_OFFSET = 1e-3  # rad or m, by which a start at a limit is moved inside: a replay that errs meets no stop
GOAL_OFFSET = 1e-4  # rad or m, the same of a goal, whose tolerance may be small: the tolerance of limits
TENDON_ROUNDING = 1e-9  # rad or m, rounding of a length that equalities fix
ROUNDING = 1e-6  # share of a range; a start outside by less is at the limit


class Range(NamedTuple):
    """Bounds of a coordinate, with and without the margin."""

    low: float
    high: float
    model_lower: float  # The model's own range; low and high are inside by the margin
    model_upper: float
    of_model: bool = False

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
        message = f", expected {self.model_lower:g} ... {self.model_upper:g} {unit}".rstrip() + f": write {nearest:.6g}"
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
            found[i] = Range(low + keep, high - keep, low, high, of_model=True)
    return found


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


def starts_at_limit(mechanism: Mechanism, what: str, x: np.ndarray, limited: Collection[str]) -> str:
    """A message about unactuated joints at a limit in a state (nx,); "" for none.

    Coupling forces of other joints press them against the stop, whose reaction MuJoCo has and the plan has not.
    """
    coupled = {dof for coupling in mechanism.couplings for dof in coupling.dofs}
    driven, names = mechanism.directly_actuated, []
    for i, joint_range in model_ranges(mechanism, None).items():
        value, name = float(x[mechanism.q_address[i]]), mechanism.joint_names[_joint_index(mechanism, i)]
        is_free = not driven[i] and i not in coupled and name not in limited and not mechanism.has_closed_chains
        if is_free and min(value - joint_range.model_lower, joint_range.model_upper - value) <= _margin(
            mechanism, name, i, None
        ):
            names.append(mechanism.joint_of(i))
    if not names:
        return ""
    others, them = (f" and {len(names) - 1} more", "them") if len(names) > 1 else ("", "it")
    return (
        f"nothing drives {names[0]}{others}, which the {what} has at a stop: what moves beside {them} pushes {them} "
        "into it, where MuJoCo has a force and a plan has none. A solve that takes long or misses its limits needs "
        f"a `start` and a `goal` with {them} off the stop, by 0.1 rad or more."
    )


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


def tendon_ranges(
    mechanism: Mechanism, margin: Any, given: Mapping[str, Range], of_joints: Mapping[int, Range]
) -> list[tuple[TendonLength, Range]]:
    """The ranges of tendons that constrain a plan, less the margin.

    Args:
        mechanism: Of the plan.
        margin: Of the limits: a number, a table by joints and tendons, or None.
        given: Ranges by name of tendon, in place of the model's.
        of_joints: Ranges of joints in the plan, by degree of freedom.
    """
    found = []
    for tendon in mechanism.tendons:
        length = TendonLength(tendon, mechanism)
        if _is_fixed(length):
            continue
        joint_range = given.get(tendon.name) or _of_model(length, margin)
        ends = [[(one.low, one.high) if (one := of_joints.get(i)) else (-np.inf, np.inf)] for i in tendon.dofs]
        reached = np.sort(length.coefficients[:, None] * np.concatenate(ends), axis=1).sum(axis=0)
        if reached[0] < joint_range.low or reached[1] > joint_range.high:
            found.append((length, joint_range))
    return found


def _is_fixed(length: TendonLength) -> bool:
    """Whether equalities alone fix a tendon's length, at a value within its range."""
    reduction = length.mechanism.reduction
    if reduction is None:
        return False
    c = np.zeros(length.mechanism.nv)
    np.add.at(c, list(length.tendon.dofs), length.coefficients)
    if np.any(np.abs(c @ reduction.G) > TENDON_ROUNDING):
        return False
    low, high = np.array(length.tendon.range) / length.scale
    return bool(low - TENDON_ROUNDING <= c[reduction.dependent] @ reduction.offset <= high + TENDON_ROUNDING)


def tendon_constraint(
    length: TendonLength, joint_range: Range, start: np.ndarray, goal: np.ndarray | None, tolerance: float
) -> Any:
    """The constraint of a tendon, widened to a start or goal within the margin.

    Raises:
        PlannerError: A start, or a goal (nx,) if there is one, outside of the range.
    """
    for what, x in (("start", start), ("goal", goal)):
        if x is None:
            continue
        value = float(length.of(x[None])[0])
        widened = joint_range.widened_to(value)
        if widened is None:
            scaled = Range(*(end * length.scale for end in joint_range[:4]), of_model=joint_range.of_model)
            own, message = value * length.scale, f"the {what} has {length} at {value * length.scale:.6g}"
            raise PlannerError(message + scaled.refusal(Coordinate(length.tendon.name, ""), own))
        joint_range = widened
    lower, upper = (end if np.isfinite(end) else None for end in (joint_range.low, joint_range.high))
    return Constraint(length, lower=lower, upper=upper, tolerance=tolerance, name=f"range of {length}")


def _of_model(length: TendonLength, margin: Any) -> Range:
    low, high = np.array(length.tendon.range) / length.scale
    given = margin.get(length.tendon.name) if isinstance(margin, Mapping) else margin
    keep = min(margin_of(high - low, length.unit, given), 0.5 * (high - low))
    return Range(low + keep, high - keep, low, high, of_model=True)


@dataclass(frozen=True, eq=False)
class TendonLength:
    """The length of a fixed tendon divided by its largest |coefficient|: a quantity for a constraint."""

    tendon: FixedTendon
    mechanism: Mechanism

    def __str__(self) -> str:
        return f"tendon {self.tendon.name!r}"

    @property
    def scale(self) -> float:
        """The largest of its |coefficients|."""
        return float(np.abs(self.tendon.coefficients).max())

    @property
    def coefficients(self) -> np.ndarray:
        """(k,) scaled coefficients of its degrees of freedom; the largest is 1 or -1."""
        return np.array(self.tendon.coefficients) / self.scale

    @property
    def unit(self) -> str:
        """Unit, rad or m, of the joint with the largest |coefficient|."""
        dof = self.tendon.dofs[int(np.argmax(np.abs(self.tendon.coefficients)))]
        return ANGLE if np.any(self.mechanism.S[dof, :3]) else LENGTH

    def of(self, xs: np.ndarray) -> np.ndarray:
        """(K,) scaled lengths for states (K, nx)."""
        return xs[:, self.mechanism.q_address[list(self.tendon.dofs)]] @ self.coefficients

    def residual_function(self, dynamics: Dynamics, N: int) -> TendonFunction:
        """The constraint function for a machine."""
        mechanism_of(dynamics, self)
        return TendonFunction(self, dynamics)


class TendonFunction:
    """Constraint function of a TendonLength: one component with a constant derivative."""

    rows, of_controls = 1, False

    def __init__(self, length: TendonLength, dynamics: Dynamics) -> None:
        self._length, self.same = length, id(length)
        self._ndx, self._nu = space_of(dynamics).ndx, dynamics.nu

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, 1) scaled lengths."""
        return self._length.of(xs)[:, None]

    def derivatives(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K, 1, ndx) and zeros (K, 1, nu)."""
        by_x = np.zeros((len(xs), 1, self._ndx))
        by_x[:, 0, list(self._length.tendon.dofs)] = self._length.coefficients
        return by_x, np.zeros((len(xs), 1, self._nu))
