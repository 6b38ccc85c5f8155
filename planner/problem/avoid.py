"""Avoid: collision avoidance, a clearance between shapes of a model.

The shapes are those of the user's file, as MuJoCo collides them: spheres, capsules, boxes and planes are exact, others
are fitted (planner.model.contact.bounding_fit). MuJoCo's own collision judges the plan.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from planner.base.arguments import array, number, numbers, set_fields, short_repr
from planner.base.errors import PlannerError
from planner.model.capabilities import stationary_object_bodies
from planner.model.mechanism import SCREW, Mechanism
from planner.model.mjcf.collision_pairs import CollisionPairs, select_collision_pairs
from planner.model.mjcf.model_index import ModelIndex, compile_model
from planner.model.mjcf.unmodelled_features import pairs_by_name
from planner.problem.collision_checker import CollisionChecker
from planner.problem.constraints.clearance import PairClearance
from planner.problem.constraints.constraint import Constraint
from planner.problem.initial_guess import inverse_dynamics_controls
from planner.problem.rrt_connect import along

TOLERANCE_SHARE = 0.02  # of the clearance: the constraint's tolerance
PENALTY_SHARE = 0.1  # of the clearance: PairClearance.penalty_length

_indices: WeakKeyDictionary[Mechanism, ModelIndex] = WeakKeyDictionary()


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
        return AvoidanceConstraint(_constraint(found, a.clearance, a.extra_clearance), found.notes)


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


def _constraint(found: CollisionPairs, clearance: float, more: Mapping[str, float]) -> Constraint:
    extra_clearance = np.array([min(more.get(pair.names, 0.0), pair.spare_clearance) for pair in found.pairs])
    clearance_of_pairs = PairClearance(found.pairs, extra_clearance, PENALTY_SHARE * clearance)
    return Constraint(
        clearance_of_pairs, lower=clearance_of_pairs.lower, tolerance=TOLERANCE_SHARE * clearance, name="clearance"
    )


def collision_free_motion(
    clearance_of_pairs: PairClearance,
    mechanism: Mechanism,
    x0: np.ndarray,
    goal: np.ndarray,
    duration: float,
    N: int,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray] | None:
    """States (N+1, nx) along a collision-free path, and controls (N, nu) by inverse dynamics.

    None where no path is found, or unless the machine is fully actuated, of hinges and slides, and from rest to rest.
    """
    nq, nv = mechanism.nq, mechanism.nv
    moving = np.concatenate([x0[nq : nq + nv], goal[nq : nq + nv]])
    if np.any(mechanism.kind != SCREW) or mechanism.contacts or mechanism.body_contacts or np.any(moving):
        return None
    path = CollisionChecker(clearance_of_pairs, mechanism).find_path(x0[:nq], goal[:nq], seed)
    if path is None:
        return None
    xs = np.tile(x0, (N + 1, 1))
    xs[:, :nq], xs[:, nq : nq + nv], _ = along(path, duration, np.arange(N + 1) / N)
    try:
        return xs, inverse_dynamics_controls(mechanism, *along(path, duration, (np.arange(N) + 0.5) / N))
    except PlannerError:  # the actuators do not reach every joint
        return None
