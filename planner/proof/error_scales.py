"""Error bounds of a replay, and violations of limits and constraints with the tolerances that follow from these bounds.

A coordinate's error is judged relative to its own range of motion along the plan. One that hardly moves has the range
STILL, or a tenth of the largest of its unit where that is smaller: no motion of another joint makes its bound wider. A
length of a standing machine is judged relative to the penetration of its contacts at rest.

The plan must satisfy ranges and constraints at its knots to their own tolerance. A replay is checked at every step of
the simulator, so between knots too, and may violate a range by its tolerance or by `resolutions`, what an error that
nobody sees makes of it, whichever is larger; a constraint h likewise, by the root of the sum of squares of dh/dx_i
times the resolution of x_i, the largest along the plan. With gains a constraint of controls may also be violated by a
hundredth of its own size, since they add corrections.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from planner.base.measured import Measurement
from planner.dynamics.contacts import stop_depth
from planner.model.capabilities import capabilities_of, constrained_dofs, stationary_object_dofs
from planner.model.coordinates import ANGLE, LENGTH, RATES, Coordinate, coordinates_of
from planner.model.mechanism import Mechanism
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.constraint_stack import ConstraintStack
from planner.problem.control_bounds import AT_BOUND
from planner.problem.goals import goals_of, terms_of
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.replays.replaying import Replay

SHARE = 0.01  # bound of a path error, as a share of the coordinate's range of motion
SMOOTHED = 0.05  # the same where the plan smooths contacts, stops or friction loss, and MuJoCo does not
STILL = 0.1  # rad, m: range of a coordinate that hardly moves, so that errors up to 1 mrad or 1 mm pass
OF_LARGEST = 0.1  # the same at most, as a share of the largest range of its unit: of small machines
MIN_RANGE = 1e-3  # rad, m, smallest range of motion, for a machine at rest; of velocities at the rate of the motion
COST_BOUND = 1.0  # %, bound of the error of the judged cost
ROUNDED = 1e-9  # of a control, at least of 1: what rounding makes of one that only holds

KINDS = ("exact_goal", "position_range", "velocity_range", "state_range")  # kinds of state limits
WORDS = {
    "rad": "angle", "m": "distance", "rad/s": "angular_velocity", "m/s": "velocity", "in": "position", "in/s": "rate",
    "": "state",
}  # fmt: skip


def path_error_bounds(plan: Plan) -> np.ndarray:
    """(ndx,) upper bound of each coordinate's path error, in its unit."""
    return (SMOOTHED if is_nonsmooth(plan) else SHARE) * ranges_of_motion(plan)


def resolutions(plan: Plan) -> np.ndarray:
    """(ndx,) the violation of a range of each coordinate that passes in a replay, in its unit.

    The error bound of a coordinate that hardly moves: no more, however far this one goes.
    """
    own, still = _own_and_still(plan)
    ranges = np.minimum(np.maximum(own, still), _of_still(plan, own))
    return (SMOOTHED if is_nonsmooth(plan) else SHARE) * ranges


def ranges_of_motion(plan: Plan) -> np.ndarray:
    """(ndx,) range of motion of each coordinate along the plan; of one that hardly moves that of the module."""
    return np.maximum(*_own_and_still(plan))


def _own_and_still(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """(ndx,) range of motion of each coordinate along the plan, and the least that it is judged by."""
    units = _units(plan)
    own = np.ptp(plan.space.difference(plan.xs, plan.xs[0]), axis=0)
    largest = np.array([own[units == unit].max() for unit in units])
    least = np.where(units == LENGTH, max(MIN_RANGE, contact_penetration(plan.problem)), MIN_RANGE)
    least[np.isin(units, RATES)] *= max(1.0, _rate(units, plan, own))
    return own, np.maximum(np.minimum(OF_LARGEST * largest, _of_still(plan, own)), least)


def _of_still(plan: Plan, own: np.ndarray) -> np.ndarray:
    """(ndx,) STILL of positions, of velocities STILL times the rate of the motion; infinite for other units."""
    units = _units(plan)
    velocities = np.where(np.isin(units, RATES), STILL * _rate(units, plan, own), np.inf)
    return np.where(np.isin(units, (ANGLE, LENGTH)), STILL, velocities)


def _rate(units: np.ndarray, plan: Plan, own: np.ndarray) -> float:
    """The rate of the motion, per s: the largest ratio of a velocity's range of motion `own` (ndx,) to its position's.

    It makes an error of a velocity of one of its position.
    """
    positions, velocities = np.isin(units, (ANGLE, LENGTH)), np.isin(units, RATES)
    rate = 0.0
    if positions.sum() == velocities.sum():
        moves = own[positions] > MIN_RANGE
        rate = float(np.max(own[velocities][moves] / own[positions][moves], initial=0.0))
    return max(rate, 1.0 / float(plan.t[-1]))


def _units(plan: Plan) -> np.ndarray:
    assert plan.problem is not None  # its dynamics know the units
    return np.array([one.unit for one in coordinates_of(plan.problem.dynamics)])


def _mechanism_of(problem: Problem | None) -> Mechanism | None:
    return None if problem is None else capabilities_of(problem.dynamics).mechanism


def contact_penetration(problem: Problem | None) -> float:
    """Static penetration of a plan's machine on one contact, m; 0 without contacts."""
    mechanism = _mechanism_of(problem)
    if mechanism is None or not mechanism.contacts:
        return 0.0
    weight = float(mechanism.mass.sum() * np.linalg.norm(mechanism.gravity))
    return min(law.rest_depth(weight) for law in {contact.law for contact in mechanism.contacts})


def has_contacts(plan: Plan) -> bool:
    """Whether a plan's mechanism models contacts, or joint stops that the plan reaches."""
    mechanism = _mechanism_of(plan.problem)
    return mechanism is not None and bool(
        mechanism.contacts or mechanism.body_contacts or reaches_stops(mechanism, plan.xs)
    )


def reaches_stops(mechanism: Mechanism, xs: np.ndarray) -> bool:
    """Whether states (K, nx) reach a joint stop of the plan, which is smoothed there and not in MuJoCo."""
    return any(bool(np.any(stop_depth(mechanism, stop, xs) > -stop.law.surface_offset)) for stop in mechanism.stops)


def is_path_judged(plan: Plan, unit: str) -> bool:
    """Whether path errors of a unit are judged: not velocities of a plan with contacts, where they jump."""
    return not (unit.endswith("/s") and has_contacts(plan))


def is_nonsmooth(plan: Plan) -> bool:
    """Whether contact or friction forces of a plan's mechanism are too steep for the LQ model."""
    mechanism = _mechanism_of(plan.problem)
    return has_contacts(plan) or (mechanism is not None and bool(np.any(mechanism.friction_loss)))


def by_unit(problem: Problem) -> Iterator[tuple[str, str, np.ndarray, list[str]]]:
    """Units of a problem's coordinates: quantity as a word, unit, components (k,) and their names."""
    coordinates = coordinates_of(problem.dynamics)
    for unit in dict.fromkeys(one.unit for one in coordinates):
        which = np.array([i for i, one in enumerate(coordinates) if one.unit == unit])
        yield word_of(unit), unit, which, [coordinates[i].name for i in which]


class Worst(NamedTuple):
    """The largest error of one unit relative to its bound."""

    word: str  # the quantity, for a key
    unit: str
    name: str  # of the coordinate
    value: float  # in the unit, infinite after divergence
    bound: float  # in the unit

    @property
    def share(self) -> float:
        """The error over its bound."""
        return self.value / self.bound


def bounds_in_file(plan: Plan, spring_rate: float) -> np.ndarray:
    """(ndx,) upper bound of each coordinate's path error in the user's file, in its unit.

    The plan keeps equalities exactly, the file's are springs of a natural frequency, `spring_rate` in rad/s. A machine
    with them may be off by SMOOTHED of its motion. A coordinate that they hold may also be off by SHARE of its joint's
    range, at most of STILL, and by that times the frequency in velocity, however little it moves.
    """
    bounds, problem = path_error_bounds(plan), plan.problem
    assert problem is not None
    mechanism = capabilities_of(problem.dynamics).mechanism
    if mechanism is None:
        return bounds
    held = np.concatenate([constrained_dofs(mechanism)] * 2)
    widths = np.clip(np.ptp(mechanism.joint_range, axis=1), 0.0, STILL)
    still = SHARE * np.concatenate([widths, widths * spring_rate])
    if np.any(held) and not is_nonsmooth(plan):  # whose bounds are SMOOTHED already
        bounds = bounds * SMOOTHED / SHARE  # of all: the joints beside move with those that are held
    bounds[: len(held)] = np.where(held, np.maximum(bounds[: len(held)], still), bounds[: len(held)])
    return bounds


def worst_by_unit(plan: Plan, errors: np.ndarray, bounds: np.ndarray | None = None) -> Iterator[Worst]:
    """For each unit, the largest of errors (K, ndx) relative to its bound; objects kept at the start may settle.

    The bounds (ndx,) are those of the path unless given.
    """
    assert plan.problem is not None  # its dynamics know the units
    bounds = path_error_bounds(plan) if bounds is None else bounds
    most = np.abs(errors).max(axis=0)
    most = np.where(np.isfinite(most), most, np.inf)
    mechanism = capabilities_of(plan.problem.dynamics).mechanism
    if mechanism is not None:
        most[: 2 * mechanism.nv][np.tile(stationary_object_dofs(mechanism), 2)] = 0.0
    for word, unit, which, names in by_unit(plan.problem):
        worst = int(np.argmax(most[which] / bounds[which]))
        yield Worst(word, unit, names[worst], float(most[which[worst]]), float(bounds[which[worst]]))


def shares_of_bounds(plan: Plan, errors: np.ndarray) -> np.ndarray:
    """(K,) the largest of errors (K, ndx) relative to its bound: 1 is the bound."""
    return (np.abs(errors) / path_error_bounds(plan)).max(axis=1)


def word_of(unit: str) -> str:
    """Name of a unit's quantity, for a key."""
    return WORDS.get(unit, f"state_{unit.replace('/', '_per_')}")


class JudgedCost(NamedTuple):
    """The part of a problem's cost whose error is judged."""

    name: str  # "cost", or "running cost" where the final cost only penalizes goals that are judged
    final: tuple[Any, ...]  # the terms whose final part is excluded

    def __call__(self, problem: Problem, xs: np.ndarray, us: np.ndarray) -> float:
        """Its value on a trajectory xs (N+1, nx), us (N, nu)."""
        if not np.isfinite(xs).all():
            return np.inf
        return float(problem.cost.value(xs, us)) - self.of_end(xs[-1])

    def of_end(self, x: np.ndarray) -> float:
        """The excluded final cost, at an end state x (nx,)."""
        return float(sum(term.final_cost(x) for term in self.final))

    def scale(self, plan: Plan, problem: Problem) -> float:
        """Reference of relative errors: its value on the plan, or at least its value for an error at its bound.

        Controls have none; a plan that only stays, by controls that cost nothing, is judged by what rounding costs.
        """
        quadratic = problem.cost.quadratize(plan.xs, plan.us)
        weights = np.abs(np.diagonal(quadratic.Q[:-1] if self.final else quadratic.Q, axis1=1, axis2=2))
        efforts = np.abs(np.diagonal(quadratic.R, axis1=1, axis2=2))
        of_errors = 0.5 * float(np.sum(weights @ path_error_bounds(plan) ** 2))
        of_rounding = 0.5 * float(np.sum(efforts * (ROUNDED * np.maximum(1.0, np.abs(plan.us))) ** 2))
        return max(abs(self(problem, plan.xs, plan.us)), of_errors, of_rounding, np.finfo(float).tiny)

    def change_by_errors(self, plan: Plan, problem: Problem) -> float:
        """By how much path errors at their bounds change it to first order: sum |dJ/dx| e, of those that are judged.

        More than 1 % of it where a plan keeps so near to its reference that the cost is a small difference.
        """
        gradient = problem.cost.quadratize(plan.xs, plan.us).q
        gradient = gradient[:-1] if self.final else gradient
        judged = [is_path_judged(plan, unit) for unit in _units(plan)]
        return float(np.sum(np.abs(gradient[:, judged]) @ path_error_bounds(plan)[judged]))


def judged_cost(problem: Problem) -> JudgedCost:
    """The running cost where the final cost only penalizes goals that are judged, else the whole cost."""
    own_rule = problem.requirements is not None and problem.requirements.goal is not None
    judged = own_rule or any(np.isfinite(goal.tolerance) for goal in goals_of(problem))
    terms = terms_of(problem.cost)
    final = tuple(term for term in terms if judged and hasattr(term, "final_cost"))
    return JudgedCost("running cost" if final else "cost", final)


def limit_violations(
    problem: Problem, xs: np.ndarray, us: np.ndarray | None, whose: str, replayed: Plan | None = None
) -> list[Measurement]:
    """The largest violation of each kind of limit; empty without limits.

    Of states at the knots (N+1, nx) or of a replay (N k + 1, nx), and of controls (N, nu) or None; `whose` describes
    them in notes. Ranges of states are judged by the limits' own tolerance, or by the `resolutions` of the plan
    `replayed`; exact goals by the bounds of its path.
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
    if replayed is not None:
        own, at_end = resolutions(replayed)[ranges.component], slice(len(allowed) - ranges.at_end, None)
        own[at_end] = path_error_bounds(replayed)[ranges.component][at_end]
        allowed = np.maximum(allowed, own)
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
    """The kind of limit of a range's coordinate."""
    if coordinate.is_rate:
        return "velocity_range"
    return "position_range" if coordinate.unit in (ANGLE, LENGTH) else "state_range"


CORRECTION = 0.01  # of the largest |h| along the plan: tolerance of constraints that depend on controls


def planned_violations(plan: Plan, problem: Problem) -> list[Measurement]:
    """The largest violation of each constraint at the plan's knots."""
    rows = _rows(problem)
    if rows is None:
        return []
    allowed = {id(one): (one.allowed(), "at the plan's knots") for one in rows.constraints}
    return _measured(rows, plan.xs, plan.us, plan.t, allowed)


def replayed_violations(run: Replay, problem: Problem, among: Sequence[Constraint] | None = None) -> list[Measurement]:
    """The largest violation of each constraint at any step of a replay; of all constraints, or of those in `among`."""
    rows = _rows(problem)
    if rows is None:
        return []
    plan = run.plan
    us = run.ctrl if run.ctrl.shape[1] == plan.us.shape[1] else np.repeat(plan.us, run.substeps, axis=0)
    reach, note = _reach(rows, run), "in MuJoCo; the bound is what an error of the path that nobody sees makes of it"
    allowed = {
        id(one): (one.allowed(), "in MuJoCo") if one.allowed() >= reach[id(one)] else (reach[id(one)], note)
        for one in rows.constraints
    }
    wanted = {id(one) for one in (rows.constraints if among is None else among)}
    return _measured(rows, run.xs, us, run.t, {key: bound for key, bound in allowed.items() if key in wanted})


def _rows(problem: Problem) -> ConstraintStack | None:
    return None if problem.trajectory_constraints is None else problem.trajectory_constraints.rows


def _reach(rows: ConstraintStack, run: Replay) -> dict[int, float]:
    """Effect of errors within the resolutions on each constraint, the largest over the knots where it applies."""
    plan, found = run.plan, dict[int, float]()
    bounds = resolutions(plan)
    us = np.concatenate([plan.us, plan.us[-1:]])
    for part in rows.parts:
        columns = part.columns
        n = np.flatnonzero((np.isfinite(rows.lower) | np.isfinite(rows.upper))[:, columns].any(axis=1))
        xs = plan.xs[n + part.at_end]
        by_x, _ = part.function.derivatives(xs, us[n], n)
        moved = float(np.sqrt(np.sum((by_x * bounds) ** 2, axis=2)).max(initial=0.0))
        if part.function.of_controls and run.feedback:
            moved = max(moved, CORRECTION * float(np.abs(part.function.values(xs, us[n], n)).max(initial=0.0)))
        found[id(part.constraint)] = max(found.get(id(part.constraint), 0.0), moved)
    return found


def _measured(
    rows: ConstraintStack, xs: np.ndarray, us: np.ndarray, t: np.ndarray, allowed: dict[int, tuple[float, str]]
) -> list[Measurement]:
    measured, used = [], set[str]()
    known = bool(np.isfinite(xs).all() and np.isfinite(us).all())
    parts = {id(part.constraint): part.constraint for part in rows.parts if id(part.constraint) in allowed}
    found = rows.violations(xs, us) if known else []
    values = {id(one.constraint): (one.value, one.at) for one in found}
    for key, constraint in parts.items():
        value, at = values.get(key, (np.inf, 0))
        bound, note = allowed[key]
        when = f" at t = {t[at]:.4g} s" if 0.0 < value < np.inf else ""
        name = _key(constraint, used)
        measured.append(Measurement(name, value, constraint.unit, bound, f"{constraint.name}: largest{when}, {note}"))
    return measured


def _key(constraint: Constraint, used: set[str]) -> str:
    """A snake_case key, unique among the problem's constraints."""
    word = "_".join("".join(c if c.isalnum() else " " for c in constraint.name.lower()).split()) or "constraint"
    key, number = f"{word}_violation", 2
    while key in used:
        key, number = f"{word}_{number}_violation", number + 1
    used.add(key)
    return key
