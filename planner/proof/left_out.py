"""left_out(): what a plan's model lacks of the user's file, for the line of the verdict."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from planner.model.mechanism import Mechanism
from planner.model.mjcf.unmodelled_features import UnmodelledFeatures
from planner.model.mjcf.unmodelled_features import unmodelled_features as compare
from planner.problem.problem import Problem
from planner.proof.replays.compiled_twin import CompiledTwin

_found: WeakKeyDictionary[Problem, UnmodelledFeatures] = WeakKeyDictionary()


def left_out(problem: Problem, compiled: CompiledTwin | None = None) -> tuple[str, ...]:
    """Say in short phrases what a problem's model lacks of the user's file: "contacts of 1 pair", "1 equality".

    Ranges and clamps are not left out in this sense: the steps of a proof say where a motion reaches one.

    Args:
        problem: With a twin; without, nothing is left out.
        compiled: Its twin, or the twin in the user's file, where that is compiled already.

    Raises:
        ModelError: MuJoCo refuses one of the two texts.
    """
    return unmodelled_of(problem, compiled).phrases


def pairs_left_out(problem: Problem) -> tuple[str, ...]:
    """Name the pairs of geoms that may touch in the user's file and not in the plan's model.

    Raises:
        ModelError: MuJoCo refuses one of the two texts.
    """
    return unmodelled_of(problem).pairs


def unmodelled_of(problem: Problem, compiled: CompiledTwin | None = None) -> UnmodelledFeatures:
    """Everything that a problem's model lacks of the user's file; nothing for dynamics that are not a mechanism's."""
    twin, mechanism = problem.twin, getattr(problem.dynamics, "mechanism", None)
    if twin is None or not isinstance(mechanism, Mechanism):
        return UnmodelledFeatures()
    if problem not in _found:
        model = compiled.model if compiled is not None and compiled.twin.mjcf == twin.mjcf else None
        given = compiled.model if compiled is not None and compiled.twin.mjcf == twin.original else None
        touches = bool(mechanism.contacts or mechanism.body_contacts)
        # The text as it was before joints were driven: what those edits leave out moves nothing.
        start = twin.sim_of(problem.x0)[: mechanism.nq]
        _found[problem] = compare(twin.original, twin.planned, twin.assets, touches, model, start, given)
    return _found[problem]
