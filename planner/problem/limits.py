"""Limits: bounds of the controls, ranges of joints and their velocities, and goals to be met exactly.

    lower <= u(n) <= upper                            exactly, in the backward pass and in every rollout
    lower <= x_i(n) <= upper   for n = 1 ... N        to a tolerance, by an augmented Lagrangian
    x_i(N) = goal_i                                   likewise

Ranges are satisfied at the knots, to the tolerance. A trajectory may overshoot between knots, so the model's ranges are
reduced by a margin, which avoids contact with MuJoCo's joint stops. Controls with feedback are clipped to their bounds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from planner.base.arguments import choice, number, short_repr
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.model.capabilities import capabilities_of
from planner.model.coordinates import coordinates_of
from planner.model.couplings import contradiction
from planner.model.mechanism import SCREW, Mechanism
from planner.model.space import origin_of, space_of
from planner.problem.constraints.constraint import DEFAULT_TOLERANCE, Constraint
from planner.problem.constraints.forces import ActuatorForce, JointForce, tendon_constraint, tendon_ranges
from planner.problem.constraints.trajectory_constraints import StateBounds
from planner.problem.control_bounds import (
    ControlBounds,
    Servos,
    constrained_forces,
    model_bounds,
    servo_bounds,
    summed_joint_forces,
    unbounded_actuators,
)
from planner.problem.costs.terms import Cost
from planner.problem.costs.tracking import places
from planner.problem.joint_limits import (
    MODEL,
    OFF,
    Range,
    check_margin,
    check_stops,
    check_word,
    component_of,
    is_word,
    json_value,
    model_ranges,
    pair_of,
    pairs_of_coordinates,
    sides_of,
    spread,
    stop_ranges,
    table_of,
    unlimited_joints,
    with_names,
)

TOLERANCE, EXACT = 1e-4, "exact"  # rad, m, rad/s, m/s; the word


@dataclass(frozen=True, eq=False)
class Limits:
    """Bounds and exact goals of a plan. None, infinity and "off" are no bound.

    Numbers replace the model's own limits. Entries that a table does not name have the limit of the model.

    Attributes:
        control: (lower, upper), each a number, (nu,) or (N, nu); a number b for -b to b; a table of numbers or pairs
            by the names of actuators; "model" for the model's ctrlrange, forcerange and actuatorfrcrange. Those of
            servos bound controls that depend on the state; some bound none (planner.problem.control_bounds.unbounded).
        position: (lower, upper) by the names of hinge and slide joints, or "model" for their ranges less the margin.
            rad or m. No default range if the mechanism models the joint's stops. Lengths of fixed tendons likewise.
        velocity: A number for all joints, or by joint a number or (lower, upper), or "model" for the limits that a
            URDF has. rad/s or m/s. Of dynamics without a mechanism, position and velocity are a number b for -b to b or
            (lower, upper), of all coordinates that its `coordinates` give the unit of one, or that semi-implicit Euler
            takes for one, or a table by their names.
        state: (lower, upper) by the index of a component of the deviation, for a machine without named joints; a number
            or a pair alone is of all components.
        final: "exact" for all that has a final weight, or names of joints (their positions and velocities), or
            indices of components of the deviation that end at the cost's goal.
        tolerance: Largest violation of a range or of an exact goal.
        margin: Distance of a plan from the ends of the model's ranges, rad or m, a number or a table by joint. By
            default 1 % of the range, and at least the smaller of 0.01 rad or 1 mm and a tenth of the range. A start or
            goal within the margin widens the bound to it.

    Raises:
        PlannerError: Where a Problem is made with it: names that the machine does not have, a lower bound above the
            upper one, joints that have no ranges, a start or a goal outside its range.
    """

    control: Any = None
    position: Any = None
    velocity: Any = None
    state: Any = None
    final: Any = None
    tolerance: float = TOLERANCE
    margin: Any = None

    @classmethod
    def of_model(cls) -> Limits:
        """The limits of the model: its clamps, its ranges and its limits of velocities."""
        return cls(control=MODEL, position=MODEL, velocity=MODEL)

    def __post_init__(self) -> None:
        object.__setattr__(self, "tolerance", number("the limits' tolerance", self.tolerance, greater_than=0.0))

    def to_dict(self) -> dict[str, Any]:
        """As JSON values; infinity is None."""
        return {name: json_value(value) for name, value in vars(self).items() if value is not None}

    @property
    def keeps_clamps(self) -> bool:
        """Whether the model's clamps bound the controls that no table names."""
        return is_word(self.control, MODEL) or isinstance(self.control, Mapping)

    def without_clamps(self, mechanism: Mechanism) -> frozenset[int]:
        """The actuators whose clamps do not bound a control, or not all of them."""
        own = self.control if isinstance(self.control, Mapping) else {}
        given = {a for a, name in enumerate(mechanism.actuators.names) if not is_word(own.get(name, MODEL), MODEL)}
        return unbounded_actuators(mechanism) | given

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
            PlannerError: No table, or a key that is no limit.
        """
        names = list(cls.__dataclass_fields__)
        if not isinstance(table, Mapping):
            raise PlannerError(f"limits is {short_repr(table)}, expected a table with some of: {', '.join(names)}.")
        return cls(**{choice("the key in [limits]", name, names): value for name, value in table.items()})

    def bounds(self, dynamics: Dynamics, N: int) -> ControlBounds | None:
        """Lower and upper bounds of the controls; None where there are none.

        Raises:
            PlannerError: As for the class.
        """
        nu, mechanism = dynamics.nu, capabilities_of(dynamics).mechanism
        servos: Servos | None = None
        if self.control is None or is_word(self.control, OFF):
            return None
        if isinstance(self.control, str):
            check_word("control", self.control, "control = 5.0 or { elbow = 5.0 }, in the unit of the actuators")
        if isinstance(self.control, (str, Mapping)):
            machine = with_names(mechanism, "control")
            inputs, given = places(machine, getattr(dynamics, "prescribed", ()))[1], set()
            lower, upper = model_bounds(machine, nu)
            for name, value in self.control.items() if isinstance(self.control, Mapping) else ():
                place = inputs[choice("the actuator in the limits' control", name, inputs)]
                if not is_word(value, MODEL):
                    lower[place], upper[place] = pair_of(f"the limit of control {name!r}", value)
                    given |= set(np.arange(nu)[place].ravel().tolist())
            servos = servo_bounds(machine, dynamics.dt, space_of(dynamics).ndx, frozenset(given))
        elif isinstance(self.control, Sequence) and len(self.control) == 2:
            lower, upper = sides_of("the limits' control", self.control)
        else:
            upper = np.asarray(number("the limits' control", self.control, greater_than=0.0))
            lower = -upper
        lower, upper = spread(lower, N, nu), spread(upper, N, nu)
        wrong = np.argwhere(~(lower <= upper) | (lower == np.inf) | (upper == -np.inf))
        if len(wrong):
            n, a = map(int, wrong[0])
            raise PlannerError(
                f"control {a} is limited to {lower[n, a]:g} ... {upper[n, a]:g}, expected a lower bound below the "
                "upper: (lower, upper), each a number or a row with one for each control."
            )
        some = servos is not None or np.isfinite(lower).any() or np.isfinite(upper).any()
        return ControlBounds(lower, upper, servos) if some else None

    def joint_forces(self, dynamics: Dynamics) -> tuple[Constraint, ...]:
        """The actuatorfrcrange of joints and the forcerange of actuators that no bound of one control keeps."""
        mechanism = capabilities_of(dynamics).mechanism
        if mechanism is None or not self.keeps_clamps:
            return ()
        found, own = [], self.control if isinstance(self.control, Mapping) else {}
        acts, prescribed = mechanism.actuators, getattr(dynamics, "prescribed", ())
        clamps = [
            (JointForce(joint), np.flatnonzero(acts.acts_on[:, dof]), mechanism.joint_force_range[dof])
            for dof, joint in summed_joint_forces(mechanism).items()
            if joint not in prescribed
        ]
        clamps += [(ActuatorForce(name), [a], acts.force_range[a]) for a, name in constrained_forces(mechanism).items()]
        for residual, acting, ends in clamps:
            if any(not is_word(own.get(acts.names[a], MODEL), MODEL) for a in acting):
                continue
            tolerance = DEFAULT_TOLERANCE * float(np.abs(ends[np.isfinite(ends)]).max())
            low, high = ends[0] + tolerance, ends[1] - tolerance  # so that the replay's clamp does not act
            sides = {name: side for name, side in (("lower", low), ("upper", high)) if np.isfinite(side)}
            found.append(Constraint(residual, **sides, tolerance=tolerance))
        return tuple(found)

    def position_ranges(self, dynamics: Dynamics) -> np.ndarray:
        """Ends (nv, 2) of ranges of a mechanism's joints and stops, infinite without; PlannerError as for the class."""
        mechanism = with_names(capabilities_of(dynamics).mechanism, "position")
        found = self._ends(dynamics, "position")
        for i, one in stop_ranges(mechanism, unlimited_joints(mechanism, self.position)).items():
            found[i] = max(found[i, 0], one.low), min(found[i, 1], one.high)
        return found

    def velocity_ranges(self, dynamics: Dynamics) -> np.ndarray:
        """The same of the joints' velocities."""
        return self._ends(dynamics, "velocity")

    def _ends(self, dynamics: Dynamics, what: str) -> np.ndarray:
        mechanism = with_names(capabilities_of(dynamics).mechanism, what)
        found, first = np.tile([-np.inf, np.inf], (mechanism.nv, 1)), mechanism.nv * (what == "velocity")
        for i, joint_range in self._found(dynamics).items():
            if first <= i < first + mechanism.nv:
                found[i - first] = joint_range.low, joint_range.high
        return found

    def ranges(self, dynamics: Dynamics, cost: Cost, x0: np.ndarray, N: int, ends: bool = True) -> StateBounds | None:
        """The ranges of the states, and exact goals if the last reference is one (`ends`); None without either.

        Raises:
            PlannerError: As for the class; a start or a goal outside its range.
        """
        space, mechanism = space_of(dynamics), capabilities_of(dynamics).mechanism
        coordinates = coordinates_of(dynamics)
        found = self._found(dynamics)
        rotations = {j + c for _, j in space.quaternions for c in range(3)}
        reference = getattr(cost, "x_ref", None)
        at_end = self._at_end(mechanism, cost, space.ndx)
        if at_end and not ends:
            raise PlannerError('final is "exact", and a periodic motion ends as its start says: expected no final.')
        if reference is None:
            reference = np.tile(x0, (N + 1, 1))
        origin = origin_of(space)
        offset, start = space.difference(reference, origin), space.difference(x0, origin)
        exact = np.zeros(space.ndx, dtype=bool)
        exact[at_end] = True
        largest = _final_weights(cost) if ends else None
        weighed = np.zeros(space.ndx, dtype=bool) if largest is None else largest > 0.0
        if mechanism is not None:
            off = unlimited_joints(mechanism, self.position)
            check_stops(mechanism, "start", start, off)
            check_stops(mechanism, "goal", np.where(exact | weighed, offset[-1], start), off)
        if not found and not at_end:
            return None
        lower, upper = np.full((2, N + 1, len(found) + len(at_end)), np.inf)
        lower = -lower
        for h, (i, joint_range) in enumerate(found.items()):
            if i in rotations:
                name = coordinates[i][0]
                raise PlannerError(f"{name} is an orientation, expected ranges of hinges, slides or velocities.")
            aims = exact[i] or (joint_range.of_model and weighed[i])
            for what, value in (("start", start[i]), *((("goal", offset[-1, i]),) if aims else ())):
                joint_range = joint_range.with_state(what, coordinates[i], float(value))
            lower[1:, h], upper[1:, h] = joint_range.low - offset[1:, i], joint_range.high - offset[1:, i]
        lower[N, len(found) :] = upper[N, len(found) :] = 0.0
        limited = tuple(coordinates[i] for i in (*found, *at_end))
        component = np.array([*found, *at_end], dtype=np.int64)
        return StateBounds(space, np.asarray(reference), component, lower, upper, len(at_end), limited)

    def check_start(self, dynamics: Dynamics, x0: np.ndarray) -> None:
        """Refuse a start (nx,) outside its ranges, before anything is sought from there.

        Raises:
            PlannerError: As for the class; a start outside its range.
        """
        space, coordinates = space_of(dynamics), coordinates_of(dynamics)
        start = space.difference(x0, origin_of(space))
        for i, joint_range in self._found(dynamics).items():
            joint_range.with_state("start", coordinates[i], float(start[i]))

    def tendons(self, dynamics: Dynamics, cost: Cost, x0: np.ndarray) -> tuple[Constraint, ...]:
        """The ranges of fixed tendons.

        Raises:
            PlannerError: As for the class; a start or a goal outside its range.
        """
        mechanism = capabilities_of(dynamics).mechanism
        if mechanism is None or not mechanism.tendons or self.position is None or is_word(self.position, OFF):
            return ()
        table = {} if is_word(self.position, MODEL) else table_of("position", self.position)
        given = {}
        for tendon in mechanism.tendons:
            if tendon.name in table and not is_word(table[tendon.name], MODEL):
                scale = float(np.abs(tendon.coefficients).max())
                low, high = pair_of(f"the range of tendon {tendon.name!r}", table[tendon.name])
                given[tendon.name] = Range.of(low / scale, high / scale)
        largest, found = _final_weights(cost), []
        for length, joint_range in tendon_ranges(mechanism, self.margin, given, self._found(dynamics)):
            aims = largest is not None and np.all(largest[list(length.tendon.dofs)] > 0.0)
            goal = cost.x_ref[-1] if aims else None  # pyright: ignore - a cost with a reference
            found.append(tendon_constraint(length, joint_range, x0, goal, self.tolerance))
        return tuple(found)

    def _found(self, dynamics: Dynamics) -> dict[int, Range]:
        """Ranges by component."""
        found: dict[int, Range] = {}
        mechanism, ndx = capabilities_of(dynamics).mechanism, space_of(dynamics).ndx
        if self.margin is not None:
            check_margin(with_names(mechanism, "margin"), self.margin)
        ranges = {what: getattr(self, what) for what in ("position", "velocity")}
        named = {what: value for what, value in ranges.items() if value is not None and not is_word(value, OFF)}
        if mechanism is None:
            for what, value in named.items():
                pairs = pairs_of_coordinates(what, value, dynamics)
                found |= {i: Range.of(*pair) for i, pair in pairs.items()}
        elif "position" in named:
            machine = mechanism
            check_word("position", self.position, "position = { elbow = [-1.0, 1.0] }, rad or m")
            found = model_ranges(machine, self.margin)
            if is_word(self.position, MODEL) and machine.couplings:
                wide = np.array([[one.model_lower, one.model_upper] if (one := found.get(i)) else [-np.inf, np.inf]
                                 for i in range(machine.nv)])  # fmt: skip
                if contradicted := contradiction(machine, wide):
                    raise PlannerError(str(contradicted))
            tendons = {tendon.name for tendon in machine.tendons} - set(machine.joint_names)
            for joint, value in {} if is_word(self.position, MODEL) else table_of("position", self.position).items():
                if joint in tendons:
                    continue
                links = machine.joint(joint)
                if links.stop - links.start != 1 or machine.kind[links.start] != SCREW:
                    expected = "expected ranges of hinge and slide joints only"
                    raise PlannerError(f"joint {joint!r} is a ball or free joint, {expected}.")
                if not is_word(value, MODEL):
                    found[links.start] = Range.of(*pair_of(f"the range of joint {joint!r}", value))
        if mechanism is not None and "velocity" in named:
            found |= self._velocities(mechanism)
        state: Any = {} if self.state is None or is_word(self.state, OFF) else self.state
        for i, value in (state if isinstance(state, Mapping) else dict.fromkeys(range(ndx), state)).items():
            i = component_of("state", i, ndx)
            found[i] = Range.of(*pair_of(f"the range of component {i}", value))
        return {i: one for i, one in sorted(found.items()) if np.isfinite([one.low, one.high]).any()}

    def _velocities(self, machine: Mechanism) -> dict[int, Range]:
        """Ranges of velocities by component."""
        given: Any = self.velocity
        if isinstance(given, (str, Mapping)):
            found = {machine.nv + i: Range.of(-most, most) for i, most in enumerate(map(float, machine.velocity_limit))}
        else:
            most, found = number("the limits' velocity", given, greater_than=0.0), {}
            given = {name: most for name in machine.joint_names if name}
        if isinstance(given, str):
            check_word("velocity", given, "velocity = 2.0 or { elbow = 2.0 }, rad/s or m/s")
            return found
        for joint, value in given.items():
            links = machine.joint(joint)
            if not is_word(value, MODEL):
                pair = pair_of(f"the velocity range of joint {joint!r}", value)
                found |= {machine.nv + i: Range.of(*pair) for i in range(links.start, links.stop)}
        return found

    def _at_end(self, mechanism: Mechanism | None, cost: Cost, ndx: int) -> list[int]:
        """The components with an exact goal."""
        if self.final is None:
            return []
        if (largest := _final_weights(cost)) is None:
            raise PlannerError("the cost has no goal of its own to be met exactly, expected a TrackingCost.")
        if isinstance(self.final, str):
            choice("the limits' final", self.final, (EXACT,))
            own = ndx if mechanism is None else mechanism.space.ndx  # appended components are no goals
            at_end = np.flatnonzero(largest[:own]).tolist()
            if not at_end:
                raise PlannerError("no final weight is above 0, expected one where the goal is to be met exactly.")
            return at_end
        if not isinstance(self.final, Sequence) or not self.final:
            raise PlannerError(
                f"final is {short_repr(self.final)}, expected 'exact', or a list of joints or of indices."
            )
        at_end = []
        for part in self.final:
            if isinstance(part, str):
                machine = with_names(mechanism, "final")
                links = machine.joint(part)
                inside = range(links.start, links.stop)
                at_end += [*inside, *(machine.nv + i for i in inside)]
            else:
                at_end.append(component_of("final", part, ndx))
        return sorted(set(at_end))


def _final_weights(cost: Cost) -> np.ndarray | None:
    """(ndx,) the largest magnitude of each component's final weights; None for a cost without weights and reference."""
    Q = None if getattr(cost, "x_ref", None) is None else getattr(cost, "Q", None)
    return None if Q is None else np.abs(Q[-1]).max(axis=0)
