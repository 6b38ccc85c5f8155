"""Ranges of joints as a plan keeps them: those of the model less a margin, with starts and goals at their very ends."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import choice, number, short_repr
from planner.base.errors import PlannerError
from planner.model.coordinates import ANGLE, LENGTH, Coordinate
from planner.model.mechanism import SCREW, Mechanism

SHARE = 0.01  # of a range, the margin by default
MIN_MARGINS = {ANGLE: 0.01, LENGTH: 1e-3}  # and at least so much: a held control bulges out by a dt^2 / 8 between knots
WIDEST = 0.1  # of a range: the fingers of a gripper move by few millimetres
OFF = 1e-4  # rad or m, of a start at the end of a range: the tolerance of limits
ROUNDING = 1e-6  # of a range: a start outside by less is at its end


class Range(NamedTuple):
    """Where a coordinate is to stay."""

    low: float
    high: float
    model_lower: float  # The ends of the model's own range, where low and high are nearer to each other by the margin
    model_upper: float
    of_model: bool = False

    @classmethod
    def of(cls, low: float, high: float) -> Range:
        """A range without a margin."""
        return cls(low, high, low, high)

    def widened_to(self, value: float) -> Range | None:
        """The range with room for a value in the margin; None where the value is outside of the model's range too."""
        width = self.model_upper - self.model_lower
        slack = ROUNDING * width if np.isfinite(width) else 0.0
        if not self.model_lower - slack <= value <= self.model_upper + slack:
            return None
        inside = min(max(value, self.model_lower), self.model_upper)
        return self._replace(low=min(self.low, inside), high=max(self.high, inside))

    def refusal(self, coordinate: Coordinate, value: float) -> str:
        """The end of a sentence about a value outside."""
        name, unit = coordinate
        nearest = self.model_lower if value < self.model_lower else self.model_upper
        said = f", expected {self.model_lower:g} ... {self.model_upper:g} {unit}".rstrip() + f": write {nearest:.6g}"
        said += f', or limits.position = {{ {name} = "off" }}.' if self.of_model else "."
        if unit == "rad" and abs(value) > 2.0 * np.pi:
            said += f" Angles are in rad: {value:g} deg are {np.radians(value):.6g}."
        return said


def model_ranges(mechanism: Mechanism, margin: Any) -> dict[int, Range]:
    """The ranges of hinges and slides by degree of freedom, but for those whose stops the mechanism has itself."""
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
    """A state (nx,) whose joints lie outside of the model's ranges by no more than a margin, at their ends instead.

    A stop acts from a little before its end on, by its own margin: what begins or ends there is pushed to where the
    stop lets go, so that is where it is put. A start at the very end is put OFF off it: what moves beside it pushes it
    back by less than that before it leaves, and no stop answers. Coupled joints stay where they are, and so do those of
    `limited`, which have a range of their own.

    Returns:
        The state, and a sentence about it that calls it `what`, "start" or "goal"; "" where nothing was moved.
    """
    coupled = {dof for coupling in mechanism.couplings for dof in coupling.dofs}
    moved, names, most = x.copy(), [], 0.0
    for i, kept in model_ranges(mechanism, None).items():
        name, address = mechanism.joint_names[_place(mechanism, i)], int(mechanism.q_address[i])
        off = min(OFF, SHARE * (kept.model_upper - kept.model_lower)) if what == "start" else 0.0
        end = min(max(x[address], kept.model_lower + off), kept.model_upper - off)
        way = abs(end - x[address])
        if 0.0 < way <= off + _margin(mechanism, name, i, None) and i not in coupled and name not in limited:
            moved[address] = end
            names.append(mechanism.joint_of(i))
            most = max(most, float(way))
    if not names:
        return x, ""
    others = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return moved, f"the {what} has {names[0]}{others} at a stop and is put off it, by up to {most:.2g} rad or m."


def starts_at_limit(mechanism: Mechanism, what: str, x: np.ndarray, limited: Collection[str]) -> str:
    """A sentence about joints that nothing drives and that are at a stop in a state (nx,); "" where there are none.

    What moves beside them pushes them into it. In MuJoCo it holds them, and a plan has no such force.
    """
    tied = {dof for coupling in mechanism.couplings for dof in coupling.dofs}
    driven, names = np.any(mechanism.actuators.moment, axis=0), []
    for i, kept in model_ranges(mechanism, None).items():
        value, name = float(x[mechanism.q_address[i]]), mechanism.joint_names[_place(mechanism, i)]
        free = (
            not driven[i]
            and i not in tied
            and name not in limited
            and not (mechanism.loops or mechanism.polynomial_couplings)
        )
        if free and min(value - kept.model_lower, kept.model_upper - value) <= _margin(mechanism, name, i, None):
            names.append(mechanism.joint_of(i))
    if not names:
        return ""
    others, them = (f" and {len(names) - 1} more", "them") if len(names) > 1 else ("", "it")
    return (
        f"nothing drives {names[0]}{others}, which the {what} has at a stop: what moves beside {them} pushes {them} "
        "into it, where MuJoCo has a force and a plan has none. A solve that takes long or misses its limits needs "
        f"a `start` and a `goal` with {them} off the stop, by 0.1 rad or more."
    )


def _place(mechanism: Mechanism, dof: int) -> int:
    return next(k for k, links in enumerate(mechanism.joint_links) if links.start <= dof < links.stop)


def check_margin(mechanism: Mechanism, margin: Any) -> None:
    """Raise a PlannerError where a margin is neither a number nor a table of numbers by joint."""
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
    """How far a plan stays off the ends of a range of some width, in rad or m: as given, else by default."""
    if given is not None:
        return float(given)
    if not np.isfinite(width):
        width = 0.0
    least = MIN_MARGINS[unit]
    return max(SHARE * width, min(least, WIDEST * width) if width else least)
