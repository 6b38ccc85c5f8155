"""Scales of the errors of a replay: what one per cent is, of a coordinate's motion and of a cost.

A coordinate's error is judged beside its own range of motion along the plan. A coordinate that hardly moves is judged
beside a tenth of the largest range of its unit, since a simulator's error comes from the machine's whole motion. A
length of a machine that stands is judged beside the depth to which the plan's ground lets it sink: what holds the
machine up is that law only to a share.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from planner.base.measured import Measurement
from planner.model.coordinates import ANGLE, LENGTH, Coordinate, coordinates_of
from planner.problem.control_bounds import AT_BOUND
from planner.problem.goals import goals_of, terms_of
from planner.problem.plan import Plan
from planner.problem.problem import Problem

SHARE = 0.01  # of a range of motion
SMOOTHED = 0.05  # the same where the plan smooths what MuJoCo does not: contacts, stops, friction loss
OF_LARGEST = 0.1  # of the largest range of the same unit, for what hardly moves
MIN_RANGE = 1e-3  # rad, m, rad/s, m/s, for a machine that stands still
COST_BOUND = 1.0  # %

KINDS = ("exact_goal", "position_range", "velocity_range", "state_range")  # of limits of states
WORDS = {
    "rad": "angle", "m": "distance", "rad/s": "angular_velocity", "m/s": "velocity", "in": "position", "in/s": "rate",
    "": "state",
}  # fmt: skip


def path_error_bounds(plan: Plan) -> np.ndarray:
    """(ndx,) the largest error of each coordinate that passes, in its unit."""
    return (SMOOTHED if is_nonsmooth(plan.problem) else SHARE) * ranges_of_motion(plan)


def ranges_of_motion(plan: Plan) -> np.ndarray:
    """(ndx,) how far each coordinate moves along the plan; at least a tenth of the largest of its unit."""
    assert plan.problem is not None  # its dynamics know the units
    own = np.ptp(plan.space.difference(plan.xs, plan.xs[0]), axis=0)
    units = np.array([one.unit for one in coordinates_of(plan.problem.dynamics)])
    largest = np.array([own[units == unit].max() for unit in units])
    least = np.where(units == LENGTH, max(MIN_RANGE, contact_penetration(plan.problem)), MIN_RANGE)
    return np.maximum(np.maximum(own, OF_LARGEST * largest), least)


def contact_penetration(problem: Problem | None) -> float:
    """How deep a plan's machine sinks into its ground on one contact, m; 0 without contacts."""
    mechanism = getattr(getattr(problem, "dynamics", None), "mechanism", None)
    if mechanism is None or not mechanism.contacts:
        return 0.0
    weight = float(mechanism.mass.sum() * np.linalg.norm(mechanism.gravity))
    return weight / max(contact.law.stiffness for contact in mechanism.contacts)


def has_contacts(problem: Problem | None) -> bool:
    """Whether a plan's mechanism has contacts or stops of its own."""
    mechanism = getattr(getattr(problem, "dynamics", None), "mechanism", None)
    return mechanism is not None and bool(mechanism.contacts or mechanism.body_contacts or mechanism.stops)


def is_nonsmooth(problem: Problem | None) -> bool:
    """Whether a plan's mechanism has forces so steep that the LQ model holds for no step: of contacts, or friction."""
    mechanism = getattr(getattr(problem, "dynamics", None), "mechanism", None)
    return has_contacts(problem) or (mechanism is not None and bool(np.any(mechanism.friction_loss)))


def by_unit(problem: Problem) -> Iterator[tuple[str, str, np.ndarray, list[str]]]:
    """Units of a problem's coordinates: the quantity in a word, the unit, the components (k,) and their names."""
    coordinates = coordinates_of(problem.dynamics)
    for unit in dict.fromkeys(one.unit for one in coordinates):
        which = np.array([i for i, one in enumerate(coordinates) if one.unit == unit])
        yield word_of(unit), unit, which, [coordinates[i].name for i in which]


class Worst(NamedTuple):
    """The error of one unit that is nearest to its bound."""

    word: str  # the quantity, for a key
    unit: str
    name: str  # of the coordinate
    value: float  # in the unit, infinite after a runaway
    bound: float  # in the unit, what passes

    @property
    def share(self) -> float:
        """The error over its bound."""
        return self.value / self.bound


def worst_by_unit(plan: Plan, errors: np.ndarray) -> Iterator[Worst]:
    """Of errors (K, ndx) of a plan's coordinates, the one of each unit that is nearest to its bound."""
    assert plan.problem is not None  # its dynamics know the units
    most, bounds = np.abs(errors).max(axis=0), path_error_bounds(plan)
    most = np.where(np.isfinite(most), most, np.inf)
    for word, unit, which, names in by_unit(plan.problem):
        worst = int(np.argmax(most[which] / bounds[which]))
        yield Worst(word, unit, names[worst], float(most[which[worst]]), float(bounds[which[worst]]))


def shares_of_bounds(plan: Plan, errors: np.ndarray) -> np.ndarray:
    """(K,) the largest of errors (K, ndx) of a plan's coordinates, each over what passes: 1 is the bound."""
    return (np.abs(errors) / path_error_bounds(plan)).max(axis=1)


def word_of(unit: str) -> str:
    """A quantity in a word for a key, by its unit."""
    return WORDS.get(unit, f"state_{unit.replace('/', '_per_')}")


class JudgedCost(NamedTuple):
    """The part of a problem's cost whose error is judged."""

    name: str  # "cost", or "running cost" where what remains at the end is a penalty on goals that are judged
    final: tuple[Any, ...]  # the terms whose final part is left out

    def __call__(self, problem: Problem, xs: np.ndarray, us: np.ndarray) -> float:
        """Its value on a trajectory xs (N+1, nx), us (N, nu)."""
        if not np.isfinite(xs).all():
            return np.inf
        return float(problem.cost.value(xs, us)) - self.of_end(xs[-1])

    def of_end(self, x: np.ndarray) -> float:
        """The part that is left out, of an end x (nx,)."""
        return float(sum(term.final_cost(x) for term in self.final))

    def scale(self, plan: Plan, problem: Problem) -> float:
        """What errors are relative to: its value on the plan, or that of an error at its bound where it is smaller."""
        quadratic = problem.cost.quadratize(plan.xs, plan.us)
        weights = np.abs(np.diagonal(quadratic.Q[:-1] if self.final else quadratic.Q, axis1=1, axis2=2))
        of_errors = 0.5 * float(np.sum(weights @ path_error_bounds(plan) ** 2))
        return max(abs(self(problem, plan.xs, plan.us)), of_errors, np.finfo(float).tiny)


def judged_cost(problem: Problem) -> JudgedCost:
    """The running cost where the final part is a penalty on what the goal judges, else the whole cost."""
    own_rule = problem.requirements is not None and problem.requirements.goal is not None
    judged = own_rule or any(np.isfinite(goal.tolerance) for goal in goals_of(problem))
    terms = terms_of(problem.cost)
    final = tuple(term for term in terms if judged and hasattr(term, "final_cost"))
    return JudgedCost("running cost" if final else "cost", final)


def limit_violations(
    problem: Problem, xs: np.ndarray, us: np.ndarray | None, whose: str, tolerances: np.ndarray | None = None
) -> list[Measurement]:
    """The largest violation of each kind of limit; nothing where there are none.

    Of states at the knots (N+1, nx), or of a replay (N k + 1, nx), and of controls (N, nu), where they are asked about;
    notes say `whose` they are. Ranges of states are judged by the limits' own tolerance, or by `tolerances` (ndx,).
    """
    measured = []
    if problem.bounds is not None and us is not None:
        own = len(xs) == len(us) + 1  # in a replay the force of a servo is judged, not its control
        lower, upper = problem.bounds.at(slice(None), xs[:-1] if own else None)
        nearly = 0.0 if problem.bounds.servos is None else AT_BOUND * np.maximum(1.0, np.abs(us))
        outside = float(np.maximum(lower - us - nearly, us - upper - nearly).max())
        active = int(np.sum((us <= lower + nearly) | (us >= upper - nearly)))
        note = f"largest, {whose}; {active} of {us.size} controls at a bound"
        measured.append(Measurement("control_violation", max(outside, 0.0), "", 0.0, note))
    ranges, limits = problem.ranges, problem.limits
    if ranges is None or limits is None:
        return measured
    beyond = ranges.violation(xs)
    allowed = np.full(len(ranges.coordinates), limits.tolerance)
    if tolerances is not None:
        allowed = np.maximum(allowed, tolerances[ranges.component])
    kinds = [_kind(one) for one in ranges.coordinates]
    kinds[len(kinds) - ranges.at_end :] = ["exact_goal"] * ranges.at_end
    for kind in KINDS:
        which = [h for h, own in enumerate(kinds) if own == kind]
        if which:
            most = beyond[:, which].max(axis=0)
            worst = which[int(np.argmax(np.where(np.isfinite(most), most / allowed[which], np.inf)))]
            value, (name, unit) = float(beyond[:, worst].max()), ranges.coordinates[worst]
            note = f"largest, {whose}: {name}"
            measured.append(Measurement(f"{kind}_violation", value, unit, float(allowed[worst]), note))
    return measured


def _kind(coordinate: Coordinate) -> str:
    """The kind of a range, by what it is of."""
    if coordinate.is_rate:
        return "velocity_range"
    return "position_range" if coordinate.unit in (ANGLE, LENGTH) else "state_range"
