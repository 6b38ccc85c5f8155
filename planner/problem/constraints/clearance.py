"""Clearance between shapes of a model: Avoid chooses the pairs, and one constraint has a component for each.

The kernels compute the distances as terms of two shapes. Here NumPy computes all pairs at once; well above its bound a
pair's distance is replaced by that of the bounding spheres.

The shapes are those of the user's file, as MuJoCo collides them: spheres, capsules, boxes and planes are exact, others
are fitted (planner.model.contact.bounding_fit). MuJoCo's own collision judges the plan.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from planner.base.arguments import array, number, numbers, set_fields, short_repr
from planner.base.errors import PlannerError
from planner.dynamics import Dynamics
from planner.dynamics.contact_kinematics import SignedDistances, distance_lower_bound
from planner.model.capabilities import stationary_object_bodies
from planner.model.mechanism import Mechanism
from planner.model.mjcf.collision_pairs import CollisionPair, select_collision_pairs
from planner.model.mjcf.model_index import ModelIndex, compile_model
from planner.model.mjcf.unmodelled_features import pairs_by_name
from planner.problem.constraints.constraint import Constraint
from planner.problem.constraints.quantities import KernelResidual, mechanism_of
from planner.problem.costs.penalty_terms import Clearance
from planner.problem.costs.residual_arrays import arrays_of_terms

EXACT_RANGE = 2.0  # of the required clearance, up to which distances are exact
PARTS = 8  # of a stage, at whose ends clearance is checked between knots
TOLERANCE_SHARE = 0.02  # of the clearance: the constraint's tolerance
PENALTY_SHARE = 0.1  # of the clearance: PairClearance.penalty_length
_indices: WeakKeyDictionary[Mechanism, ModelIndex] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class PairClearance:
    """Distances of pairs of shapes, m.

    Attributes:
        pairs: Pairs with the required clearance of each; planner.constraints.Avoid finds them.
        more: (P,) m, clearance in addition to that.
        penalty_length: m, violation that costs 1/2 per second in the first solve, before multipliers are known. The
            trajectory then stays on the side of an obstacle on which its first guess is.
    """

    pairs: tuple[CollisionPair, ...]
    more: np.ndarray
    penalty_length: float
    unit = "m"

    def __post_init__(self) -> None:
        length = number("penalty_length", self.penalty_length, greater_than=0.0)
        set_fields(self, pairs=tuple(self.pairs), penalty_length=length)

    def __str__(self) -> str:
        return "clearance"

    def __repr__(self) -> str:
        return f"PairClearance({len(self.pairs)} pairs)"

    @property
    def lower(self) -> np.ndarray:
        """(P,) m, the required clearance of each pair."""
        return np.array([pair.required_clearance for pair in self.pairs]) + self.more

    @property
    def names(self) -> tuple[str, ...]:
        """(P,) short names of the pairs, for pictures."""
        return tuple(pair.names.replace("geom ", "").replace("'", "").replace(" and ", ", ") for pair in self.pairs)

    def residual_function(self, dynamics: Dynamics, N: int) -> PairClearanceFunction:
        """The constraint function for a machine."""
        return PairClearanceFunction(self, dynamics, N)


class PairClearanceFunction(KernelResidual):
    """The distances of a PairClearance, and their violation between knots."""

    def __init__(self, what: PairClearance, dynamics: Dynamics, N: int) -> None:
        mechanism = mechanism_of(dynamics, what)
        terms = [
            Clearance(a=pair.a, b=pair.b, lift=pair.distance_offset, lower=lower, tolerance=1.0)
            for pair, lower in zip(what.pairs, what.lower, strict=True)
        ]
        super().__init__(dynamics, what, arrays_of_terms(mechanism, N, terms, dynamics.dt))
        self._distances = SignedDistances(mechanism, [pair[:2] for pair in what.pairs])
        self.lower = what.lower
        self._offset = np.array([pair.distance_offset for pair in what.pairs])
        self._exact_below = EXACT_RANGE * np.abs(what.lower) + what.penalty_length - self._offset
        self.initial_penalty = dynamics.dt / what.penalty_length**2

    def values(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, P) m, distances; a lower bound of the distance for pairs well above their bounds."""
        return self._distances.values(self._q(xs), self._exact_below) + self._offset

    def shown(self, xs: np.ndarray, us: np.ndarray, n: np.ndarray) -> np.ndarray:
        """(K, P) m, the exact distances of all pairs, for pictures."""
        return self._distances.values(self._q(xs)) + self._offset

    def _jacobian(self, xs: np.ndarray, n: np.ndarray) -> np.ndarray:
        return self._distances.derivatives(self._q(xs), self._exact_below)[1]

    def clearance_violation(self, dynamics: Dynamics, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        """The largest violation (N, P), m, on each stage of a trajectory xs (N+1, nx), us (N, nu).

        It is checked at the ends of PARTS of the stage, by the plan's own integrator. Between these, a lower bound of
        the distance that follows from the motion of the shapes must not be negative.
        """
        N, states = len(us), states_between_knots(dynamics, xs, us, PARTS)
        values = self.values(states, us, np.arange(len(states)))
        displacement = self.mechanism.space.difference(states[1:, : self._nx], states[:-1, : self._nx])
        motion = self._distances.motion_bound(self._q(states[:-1]), displacement[:, : self.mechanism.nv])
        nearest = np.minimum(values[:-1], values[1:])
        violation = np.maximum(self.lower - nearest, -distance_lower_bound(values, motion))
        return violation.reshape(N, PARTS, -1).max(axis=1)

    def _q(self, xs: np.ndarray) -> np.ndarray:
        return xs[:, : self.mechanism.nq]


def states_between_knots(dynamics: Dynamics, xs: np.ndarray, us: np.ndarray, parts: int) -> np.ndarray:
    """States (N * parts + 1, nx) at equal parts of each stage of xs (N+1, nx), us (N, nu), by the dynamics."""
    times = np.tile(dynamics.dt / parts * np.arange(parts), len(us))
    inside = dynamics.step(np.repeat(xs[:-1], parts, axis=0), np.repeat(us, parts, axis=0), times)
    inside[::parts] = xs[:-1]
    return np.concatenate([inside, xs[-1:]])


def pair_clearance_of(constraints: Sequence[object]) -> PairClearance | None:
    """The PairClearance among constraints; None for none."""
    return next((one.of for one in constraints if isinstance(getattr(one, "of", None), PairClearance)), None)  # type: ignore[attr-defined]


class AvoidanceConstraint(NamedTuple):
    """The clearance constraint, and notes about it."""

    constraint: Constraint
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Avoid:
    """Which collisions a plan avoids.

    Attributes:
        self: Between shapes of the machine.
        world: With shapes at rest.
        clearance: m between surfaces.
        extra_clearance: m in addition, by the names of a pair ("geom 'hand' and geom 'post'"); may be negative.
    """

    self: bool = True
    world: bool = True
    clearance: float = 0.01
    extra_clearance: Any = None

    def __post_init__(a) -> None:  # pyright: ignore[reportSelfClsParameterName] - a field is called self
        for name in ("self", "world"):
            if not isinstance(getattr(a, name), bool):
                raise PlannerError(f"{name} of avoid is {short_repr(getattr(a, name))}, expected true or false.")
        if not (a.self or a.world):
            raise PlannerError("self and world of avoid are false, expected one of them true.")
        extra = {} if a.extra_clearance is None else a.extra_clearance
        if not isinstance(extra, Mapping):
            raise PlannerError(
                f"extra_clearance of avoid is {short_repr(extra)}, expected a table of m by the names of pairs."
            )
        set_fields(
            a, clearance=number("clearance of avoid", a.clearance, greater_than=0.0),
            extra_clearance={name: number(f"extra_clearance of {name}", value) for name, value in extra.items()},
        )  # fmt: skip

    def to_dict(a) -> dict[str, Any]:  # pyright: ignore[reportSelfClsParameterName]
        """As a table [avoid]."""
        return {one.name: getattr(a, one.name) for one in fields(a) if getattr(a, one.name) != one.default}

    def constraint(
        a,  # pyright: ignore[reportSelfClsParameterName]
        mechanism: Mechanism,
        start: Any,
        goal: Any = None,
    ) -> AvoidanceConstraint:
        """The constraint for a motion of a mechanism from a start to goals, and notes about it.

        Args:
            mechanism: The machine, read from a file.
            start: (nx,) state or (nq,) positions, or a keyframe's name.
            goal: The same of the end, or several by name ("goal 1 (hand)"); None for none.

        Raises:
            PlannerError: The mechanism has no model, no shapes can collide, or a pose violates the clearance.
        """
        if not mechanism.mjcf:
            raise PlannerError("avoid needs the shapes of a model, expected a mechanism that was read from a file.")
        index = model_index_of(mechanism)
        goals = {} if goal is None else goal if isinstance(goal, Mapping) else {"the goal": goal}
        poses = {"the start": start, **goals}
        poses = {name: _positions(name, x, mechanism) for name, x in poses.items()}
        found = select_collision_pairs(
            index, poses, a.clearance, own=a.self, world=a.world, known=_known(mechanism, index)
        )
        if not found.pairs:
            raise PlannerError("avoid has nothing to keep apart: no shapes of the model can touch; leave it out.")
        extra = np.array([min(a.extra_clearance.get(one.names, 0.0), one.spare_clearance) for one in found.pairs])
        pairs = PairClearance(found.pairs, extra, PENALTY_SHARE * a.clearance)
        tolerance = TOLERANCE_SHARE * a.clearance
        return AvoidanceConstraint(
            Constraint(pairs, lower=pairs.lower, tolerance=tolerance, name="clearance"), found.notes
        )


def _positions(name: str, given: Any, mechanism: Mechanism) -> np.ndarray:
    """(nq,) of a state (nx,) or positions (nq,)."""
    x = numbers(name, mechanism.keyframe(given) if isinstance(given, str) else given)
    if x.shape not in ((mechanism.nq,), (mechanism.space.nx,)):
        expected = f"({mechanism.nq},), its positions, or ({mechanism.space.nx},), its state"
        raise PlannerError(f"{name} has shape {x.shape}, expected a keyframe, or {expected}.")
    return array(name, x[: mechanism.nq], (mechanism.nq,))


def model_index_of(mechanism: Mechanism) -> ModelIndex:
    """The user's file of a mechanism, compiled once."""
    if mechanism not in _indices:
        _indices[mechanism] = ModelIndex(compile_model(mechanism.original or mechanism.mjcf, mechanism.assets))
    return _indices[mechanism]


def _known(mechanism: Mechanism, index: ModelIndex) -> Collection[frozenset[int]]:
    """Pairs of geoms that are not avoided: contacts of the plan's model, and objects at rest with fixed bodies."""
    model, named = index.model, pairs_by_name(index.model)
    own = {}
    if mechanism.contacts or mechanism.body_contacts:
        own = pairs_by_name(compile_model(mechanism.mjcf, mechanism.assets))
    beside = (stationary_object_bodies(mechanism) | (model.body_weldid == 0))[model.geom_bodyid]
    return {frozenset(pair) for name, pair in named.items() if name in own or np.all(beside[list(pair)])}
