"""Weights: matrices and diagonals from a number, or from numbers by the names of joints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, numbers
from planner.base.errors import PlannerError
from planner.model.mechanism import Mechanism


def matrices(name: str, value: Any, stages: int, size: int) -> np.ndarray:
    """(stages, size, size) from a number, a diagonal (size,), a matrix, or one of these per stage."""
    given = numbers(name, value)
    if given.ndim == 0:
        given = np.full(size, given)
    if given.ndim == 1:
        given = np.diag(array(name, given, (size,)))
    if given.ndim == 2 and given.shape == (stages, size) and stages != size:
        given = np.einsum("ni,ij->nij", given, np.eye(size))
    if given.ndim == 2:
        given = np.broadcast_to(given, (stages, *given.shape))
    return array(name, given, (stages, size, size))


def diagonal(name: str, value: Any, size: int, kind: str, places: Mapping[str, slice]) -> np.ndarray:
    """(size,) from a number, an array (size,), or a dict of these by the names of `places`, the others zero.

    Messages use `name` for the weight and `kind`, e.g. "joint", for its keys.
    """
    if not isinstance(value, Mapping):
        given = numbers(name, value)
        weights = array(name, np.full(size, given) if given.ndim == 0 else given, (size,))
    else:
        weights = np.zeros(size)
        for key, part in value.items():
            if not places:
                raise PlannerError(f"{name} names the {kind} {key!r}, but no {kind} has a name: expected a number.")
            place = places[choice(f"the {kind} in {name}", key, places)]
            label = f"{name}[{key!r}]"
            weights[place] = diagonal(label, numbers(label, part), place.stop - place.start, kind, places)
    if weights.min(initial=0.0) < 0.0:
        raise PlannerError(f"{name} has the weight {weights.min():g}, expected weights of at least 0.")
    return weights


def places(
    mechanism: Mechanism, prescribed: tuple[str, ...]
) -> tuple[dict[str, slice], dict[str, slice], dict[str, slice]]:
    """Slices of named weights: joints in (nv,), actuators and prescribed joints in (nu,), actuators in (na,)."""
    joints = {name: s for name, s in zip(mechanism.joint_names, mechanism.joint_links, strict=True) if name}
    names = mechanism.actuators.names
    inputs = {name: slice(i, i + 1) for i, name in enumerate(names) if name}
    at = len(names)
    for name in sorted(prescribed, key=lambda name: joints[name].start):  # in the order of qvel
        inputs[name] = slice(at, at + joints[name].stop - joints[name].start)
        at = inputs[name].stop
    indices = mechanism.actuators.activation.tolist()
    activations = {name: slice(i, i + 1) for name, i in zip(names, indices, strict=True) if name and i >= 0}
    return joints, inputs, activations
