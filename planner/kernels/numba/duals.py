"""D4: four doubles with a directional derivative each, that behave like one float in Numba.

Forward differentiation of kernels as they are: a part that is called with pointers of duals in place of lanes computes
what it always does and, beside it, how that changes along one direction. So second derivatives come from the source
of the first ones, exactly.

    load(p, k)        entry k of a pointer of duals: memory (K, 8), four values and then their four derivatives
    store(p, k, v)    v a D4; lanes and floats are constants, whose derivative is zero
    duals(t, k)       the pointer whose address is t[k], as lanes(t, k)

+ - * / take duals with duals, lanes, floats and integers. lane_math has rint and floor of duals, whose derivative is
dropped. Where one branch gives lanes and the other duals, the lanes become constants. As lanes, the same memory holds
the value of entry k at 2 k and its derivative at 2 k + 1.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typing.templates import AbstractTemplate, signature
from numba.extending import models, register_model

from planner.kernels.numba.jit import FASTMATH
from planner.kernels.numba.lanes import (
    OPERANDS,
    V4,
    VECTOR,
    LaneType,
    PointerType,
    as_lanes,
    define_entry,
    infer_global,
)

_ENTRY = ir.ArrayType(VECTOR, 2)
_INDEX = ir.IntType(32)


class _DualType(types.Type):
    holds_lanes = True

    def __init__(self) -> None:
        super().__init__(name="D4")


D4 = _DualType()


@register_model(_DualType)
class _DualModel(models.StructModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, [("value", V4), ("derivative", V4)])


def _made(context: Any, builder: Any, value: Any, derivative: Any) -> Any:
    proxy = cgutils.create_struct_proxy(D4)(context, builder)
    proxy.value, proxy.derivative = value, derivative
    return proxy._getvalue()


def _parts(context: Any, builder: Any, x: Any, numba_type: Any) -> tuple[Any, Any]:
    """Value and derivative; None for the derivative of a constant."""
    if isinstance(numba_type, _DualType):
        return value_of(context, builder, x), cgutils.create_struct_proxy(D4)(context, builder, value=x).derivative
    return as_lanes(context, builder, x, numba_type), None


def value_of(context: Any, builder: Any, x: Any) -> Any:
    """The lanes of a dual's value."""
    return cgutils.create_struct_proxy(D4)(context, builder, value=x).value


def _zero() -> Any:
    return ir.Constant(VECTOR, [0.0] * VECTOR.count)


class _DualPointerType(PointerType):
    @property
    def entry(self) -> Any:
        return D4

    def takes(self, value: Any) -> Any:
        return value

    def read(self, builder: Any, address: Any) -> Any:
        halves = [builder.load(_half(builder, address, i), align=8) for i in range(2)]
        dual = ir.Constant(ir.LiteralStructType([VECTOR, VECTOR]), ir.Undefined)
        for i, half in enumerate(halves):
            dual = builder.insert_value(dual, half, i)
        return dual

    def write(self, context: Any, builder: Any, address: Any, value: Any, numba_type: Any) -> None:
        x, dx = _parts(context, builder, value, numba_type)
        builder.store(x, _half(builder, address, 0), align=8)
        builder.store(_zero() if dx is None else dx, _half(builder, address, 1), align=8)


def _half(builder: Any, address: Any, i: int) -> Any:
    return builder.gep(address, [ir.Constant(_INDEX, 0), ir.Constant(_INDEX, i)])


_DUALS = _DualPointerType("Dual")
duals = define_entry(_DUALS)


@register_model(_DualPointerType)
class _DualPointerModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, ir.PointerType(_ENTRY))


@lower_cast(LaneType, _DualType)
def _constant_dual(context: Any, builder: Any, fromty: Any, toty: Any, value: Any) -> Any:
    return _made(context, builder, value, _zero())


def _sum(builder: Any, a: Any, da: Any, b: Any, db: Any) -> tuple[Any, Any]:
    value = builder.fadd(a, b, flags=FASTMATH)
    if da is None or db is None:
        return value, db if da is None else da
    return value, builder.fadd(da, db, flags=FASTMATH)


def _difference(builder: Any, a: Any, da: Any, b: Any, db: Any) -> tuple[Any, Any]:
    value = builder.fsub(a, b, flags=FASTMATH)
    if db is None:
        return value, da
    return value, builder.fsub(_zero() if da is None else da, db, flags=FASTMATH)


def _product(builder: Any, a: Any, da: Any, b: Any, db: Any) -> tuple[Any, Any]:
    value = builder.fmul(a, b, flags=FASTMATH)
    first = None if da is None else builder.fmul(da, b, flags=FASTMATH)
    second = None if db is None else builder.fmul(a, db, flags=FASTMATH)
    if first is None or second is None:
        return value, second if first is None else first
    return value, builder.fadd(first, second, flags=FASTMATH)


def _quotient(builder: Any, a: Any, da: Any, b: Any, db: Any) -> tuple[Any, Any]:
    value = builder.fdiv(a, b, flags=FASTMATH)
    if db is None:
        return value, builder.fdiv(da, b, flags=FASTMATH)
    change = builder.fmul(value, db, flags=FASTMATH)  # d(a/b) = (da - (a/b) db) / b
    change = builder.fsub(_zero() if da is None else da, change, flags=FASTMATH)
    return value, builder.fdiv(change, b, flags=FASTMATH)


def _define_operator(function: Any, rule: Any) -> None:
    class Template(AbstractTemplate):
        key = function

        def generic(self, args: Any, kws: Any) -> Any:
            if len(args) == 2 and D4 in args and all(isinstance(a, (_DualType, *OPERANDS)) for a in args):
                return signature(D4, *args)
            return None

    infer_global(function)(Template)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        (a, da), (b, db) = (_parts(context, builder, x, t) for x, t in zip(args, sig.args, strict=True))
        return _made(context, builder, *rule(builder, a, da, b, db))

    for other in (_DualType, *OPERANDS):
        lower_builtin(function, _DualType, other)(lower)
        if other is not _DualType:
            lower_builtin(function, other, _DualType)(lower)


for _function, _rule in (
    (operator.add, _sum), (operator.iadd, _sum), (operator.sub, _difference), (operator.isub, _difference),
    (operator.mul, _product), (operator.truediv, _quotient),
):  # fmt: skip
    _define_operator(_function, _rule)
