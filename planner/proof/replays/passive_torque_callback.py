"""Add exponential torques (planner.model.passive_forces), which MJCF does not have, to MuJoCo's passive forces.

MuJoCo calls its one global callback at every stage of its integrators, so a replay has no error of its own from it. The
callback is set only inside `curves_acting`, and acts on the models named there alone. Where the data of the models are
known too (rollouts), it is a compiled C function that many threads call at once. MuJoCo hands it the addresses of a
model and of its data; the rest is one table of numbers:

    models, data, curves, slopes
    (address, then amplitude per curve) per model, by address
    (address, offset of qpos, offset of qfrc_passive, in numbers) per data
    (dof, constant, first slope, its end) per curve
    (address in qpos, slope) per slope

Addresses are below 2^53, so floating-point numbers hold them exactly.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.passive_forces import LARGEST, ExponentialTorque
from planner.model.twin import Twin

_lock = threading.RLock()  # one owner of the callback at a time


@contextmanager
def curves_acting(
    twin: Twin, *models: Any, factors: np.ndarray | None = None, data: Sequence[Any] = ()
) -> Iterator[None]:
    """MuJoCo with the curves of a twin, if it has any, acting in some models, times factors (models, curves).

    With `data`, all that these models run in, by compiled code.
    """
    if not twin.curves:
        yield
        return
    mujoco = load_mujoco()
    factors = np.ones((len(models), len(twin.curves))) if factors is None else factors
    tables = {
        model._address: _table(model, twin.curves, row) for model, row in zip(models, factors.tolist(), strict=True)
    }
    with _lock:
        before = mujoco.get_mjcb_passive()
        if data and before is None:
            with compiled_curves(tables, data) as function:
                mujoco.set_mjcb_passive(function)
                try:
                    yield
                finally:
                    mujoco.set_mjcb_passive(None)
            return

        def passive(model: Any, data: Any) -> None:
            if before is not None:
                before(model, data)
            table = tables.get(model._address)
            if table is None:
                return
            q, force = data.qpos, data.qfrc_passive
            for dof, amplitude, exponent, slopes in table:
                for address, slope in slopes:
                    exponent += slope * q[address]
                force[dof] += amplitude * math.exp(min(max(exponent, -LARGEST), LARGEST))

        mujoco.set_mjcb_passive(passive)
        try:
            yield
        finally:
            mujoco.set_mjcb_passive(before)


def _table(model: Any, curves: Sequence[ExponentialTorque], factors: Sequence[float]) -> list[Any]:
    """For each curve: its dof, amplitude, constant, and (address in qpos, slope) pairs."""
    kinds = load_mujoco().mjtJoint
    single = np.isin(model.jnt_type, [int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)])
    for curve in curves:
        if not all(dof < model.nv and single[model.dof_jntid[dof]] for dof in curve.dofs):
            raise ModelError(
                f"the model has no hinge or slide at one of dofs {', '.join(map(str, curve.dofs))}, expected the "
                "joints of the plan's exponential torques."
            )
    address = model.jnt_qposadr[model.dof_jntid].tolist()
    return [
        (c.dof, factor * c.amplitude, c.constant, [(address[j], slope) for j, slope in c.slopes])
        for c, factor in zip(curves, factors, strict=True)
    ]


_place = np.zeros(1)  # the address of the table; the function is compiled once for wherever that is


@contextmanager
def compiled_curves(tables: Mapping[int, Sequence[Any]], data: Sequence[Any]) -> Iterator[Any]:
    """The function, with its table: by model address (dof, amplitude, constant, (address in qpos, slope) pairs)."""
    curves = next(iter(tables.values()))
    ends = np.cumsum([0, *(len(slopes) for *_, slopes in curves)])
    parts: list[Any] = [[len(tables), len(data), len(curves), int(ends[-1])]]
    parts += [[address, *(curve[1] for curve in tables[address])] for address in sorted(tables)]
    parts += [
        [one._address, *((a.ctypes.data - one._address) // 8 for a in (one.qpos, one.qfrc_passive))] for one in data
    ]
    parts += [[c[0], c[2], ends[i], ends[i + 1]] for i, c in enumerate(curves)]
    parts += [pair for *_, slopes in curves for pair in slopes]
    table = np.concatenate([np.asarray(part, dtype=float) for part in parts])
    _place[0] = table.ctypes.data
    try:
        yield _function().ctypes
    finally:
        _place[0] = 0.0


@cache
def _function() -> Any:
    """Compile it, on first use alone: no other machine pays for it."""
    from numba import cfunc, types
    from numba.extending import intrinsic

    make: Any = intrinsic  # its first argument is the compiler's

    @make
    def numbers(typing_context: Any, address: Any) -> Any:
        """The pointer to floating-point numbers at an address."""

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return types.CPointer(types.float64)(types.intp), generate

    place, largest, exp = _place.ctypes.data, LARGEST, math.exp

    @cfunc(types.void(types.intp, types.intp))
    def passive(model: int, data: int) -> None:
        where = int(numbers(place)[0])
        if where == 0:
            return
        table = numbers(where)
        models, width = int(table[0]), 1 + int(table[2])
        low, high = 0, models
        while high - low > 1:  # the last model whose address is not above
            middle = (low + high) // 2
            if int(table[4 + middle * width]) <= model:
                low = middle
            else:
                high = middle
        mine, its = 4 + low * width, 4 + models * width
        if int(table[mine]) != model:
            return
        curves = its + 3 * int(table[1])
        while its < curves and int(table[its]) != data:
            its += 3
        if its == curves:
            return
        here = numbers(data)
        q, force, slopes = int(table[its + 1]), int(table[its + 2]), curves + 4 * (width - 1)
        for i in range(width - 1):
            curve = curves + 4 * i
            exponent = table[curve + 1]
            for j in range(int(table[curve + 2]), int(table[curve + 3])):
                exponent += table[slopes + 2 * j + 1] * here[q + int(table[slopes + 2 * j])]
            here[force + int(table[curve])] += table[mine + 1 + i] * exp(min(max(exponent, -largest), largest))

    return passive
