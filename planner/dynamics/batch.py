"""Argument checks of the public algorithms for one state or a batch, and the cached kernel model of a mechanism."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from planner.base.arguments import array, short_repr
from planner.base.errors import PlannerError
from planner.kernels.integrators import KNOWN_INTEGRATORS
from planner.kernels.numba.jit import announce
from planner.kernels.tree.mechanism_table import Model
from planner.kernels.tree.memory import TreeMemory
from planner.model.mechanism import Mechanism

_models: WeakKeyDictionary[Mechanism, dict[bytes, Model]] = WeakKeyDictionary()
_idle: WeakKeyDictionary[Model, dict[bool, list[TreeMemory]]] = WeakKeyDictionary()  # scratch memory not in use


def kernel_model(mechanism: Mechanism, prescribed: np.ndarray | None = None) -> Model:
    """The kernel model of a mechanism without actuators, cached; `prescribed` (nv,) bool."""
    known = _models.setdefault(mechanism, {})
    key = b"" if prescribed is None else prescribed.tobytes()
    if key not in known:
        known[key] = Model(mechanism, prescribed, actuated=False)
    return known[key]


class KernelCall:
    """Arguments of a kernel as (K, n) arrays, and whether they were a single state."""

    def __init__(self, mechanism: Mechanism, **given: Any) -> None:
        if not isinstance(mechanism, Mechanism):
            raise PlannerError(f"mechanism is {short_repr(mechanism)}, expected a Mechanism.")
        self.mechanism = mechanism
        sizes = {"q": mechanism.nq}
        self.single = all(_dimensions(value) <= 1 for value in given.values())
        arrays: dict[str, np.ndarray] = {}
        for name, value in given.items():
            size = sizes.get(name, mechanism.nv)
            shape = (size,) if _dimensions(value) <= 1 else ("K", size)
            arrays[name] = np.atleast_2d(array(name, value, shape))
        K = max(len(value) for value in arrays.values())
        for name, value in arrays.items():
            if len(value) not in (1, K):
                raise PlannerError(f"{name} has {len(value)} rows, expected {K} as the others, or one.")
            arrays[name] = np.ascontiguousarray(np.broadcast_to(value, (K, value.shape[1])))
        for address, _ in mechanism.quaternions:
            norms = np.linalg.norm(arrays["q"][:, address : address + 4], axis=1)
            if not np.all(norms > 0.0):
                raise PlannerError(f"q[{address}:{address + 4}] is zero, expected a quaternion.")
        self.K, self.arrays = K, arrays

    def __getitem__(self, name: str) -> np.ndarray:
        return self.arrays[name]

    def out(self, value: np.ndarray) -> np.ndarray:
        """The result, without its first axis for a single state."""
        return value[0] if self.single else value

    def call(self, kernel: Any, model: Model, *arrays: np.ndarray, linearizing: bool = False) -> None:
        """Run a kernel on the states, with scratch memory that is reused, since its allocation is slow."""
        announce(kernel)
        # Removed from the list while in use, so that threads do not share it.
        idle = _idle.setdefault(model, {}).setdefault(linearizing, [])
        try:
            memory = idle.pop()
        except IndexError:
            memory = TreeMemory(model, KNOWN_INTEGRATORS["euler"], 0, linearizing)
        kernel(model.table, memory.table, self["q"], *arrays)
        idle.append(memory)


def _dimensions(value: Any) -> int:
    """Number of dimensions of an argument; 1 if ragged, which `array` rejects."""
    try:
        return np.ndim(value)
    except ValueError:
        return 1
