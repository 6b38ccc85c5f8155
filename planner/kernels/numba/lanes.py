"""V4: four doubles that behave like one float in Numba.

A kernel is written once, as if for one float, and runs on four knots or on four line-search candidates at once:
LLVM lowers <4 x double> to one ymm or two xmm or NEON registers. A plain inner loop over four does not vectorize
(unknown aliasing), hence the explicit type. Four, not eight: with the 16 registers of AVX2 eight spill, and of eight
step lengths the last four are hardly ever wanted.

    p = doubles(a)        the raw pointer of the floats of an array of any shape
    p = pointer(a)        a raw pointer: (K, 4) float64 arrays give lanes, (K,) arrays give floats or integers
    load(p, k)            a[k, :] as V4, or a[k]
    store(p, k, v)        a[k, :] = v (a float is spread), or a[k] = v
    load4(p, k)           four consecutive doubles of a (K,) array, as V4
    store4(p, k, v)
    at(p, k)              the pointer to entry k
    t[k]                  entry k of a table: integers that no kernel writes
    lanes(t, k), floats(t, k), integers(t, k)      the pointer whose address is t[k], t an array or its pointer

Pointers are taken once, at a kernel's entry: arrays used inside loops are reference counted, which spills every
vector register around each use. A table of addresses in one int64 array carries all memory of a solve across the
boundary from Python at the price of one argument (thirty arrays cost 4 us a call); what Python calls takes its
pointer, so that inner calls pass one word. Integers are constant to all kernels, and LLVM is told: it need not read
them again after each store.
"""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import extending, types
from numba.core.imputils import lower_builtin
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing import templates
from numba.core.typing.templates import AbstractTemplate, signature
from numba.extending import models, register_model

from planner.kernels.numba.jit import FASTMATH

# Untyped: Numba passes the typing context itself.
intrinsic: Any = extending.intrinsic
infer_global: Any = templates.infer_global

WIDTH = 4
_LINE = 8  # doubles of a cache line
VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)
_INT32 = ir.IntType(32)


def padded(n: int) -> int:
    """The smallest multiple of the lane width that holds n."""
    return -(-n // WIDTH) * WIDTH


def lane_array(*shape: int) -> np.ndarray:
    """A zero float64 array that starts on a cache line."""
    count = math.prod(shape)
    buffer = np.zeros(count + _LINE)
    start = -buffer.ctypes.data // 8 % _LINE
    return buffer[start : start + count].reshape(shape)


def neighbors(**counts: int) -> dict[str, np.ndarray]:
    """Zero float64 arrays of so many entries, by name, that lie one behind the other, each from a cache line on.

    A processor takes addresses with the same last 12 bits for one at first, and waits: small arrays that are written
    and read in turn are faster side by side than wherever chance puts them.
    """
    starts = np.cumsum([0, *(-(-count // _LINE) * _LINE for count in counts.values())])
    block = lane_array(int(starts[-1]))
    return {name: block[start : start + counts[name]] for name, start in zip(counts, starts[:-1], strict=True)}


class LaneType(types.Type):
    """Four doubles."""

    def __init__(self) -> None:
        super().__init__(name="V4")

    def can_convert_to(self, typingctx: Any, other: Any) -> Any:
        """Where two branches meet, lanes become what holds more (see duals)."""
        return Conversion.safe if getattr(other, "holds_lanes", False) else None


V4 = LaneType()


@register_model(LaneType)
class _LaneModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, VECTOR)


class PointerType(types.Type):
    """A raw pointer, by the kind of its entries."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        super().__init__(name=f"{kind}Pointer")

    @property
    def lanes(self) -> bool:
        """Whether an entry is a V4."""
        return self.kind == "Lane"

    @property
    def entry(self) -> Any:
        """The type of an entry."""
        return {"Lane": V4, "Float": types.float64, "Integer": types.int64}[self.kind]

    def takes(self, value: Any) -> Any:
        """The type that `store` is to be given for a value of this type."""
        return value if self.lanes else self.entry

    def read(self, builder: Any, address: Any) -> Any:
        """An entry's value."""
        value = builder.load(address, align=8)
        return _constant(builder, value) if self.kind == "Integer" else value

    def write(self, context: Any, builder: Any, address: Any, value: Any, numba_type: Any) -> None:
        """Set an entry."""
        builder.store(as_lanes(context, builder, value, numba_type) if self.lanes else value, address, align=8)


_LANES, _FLOATS, _INTEGERS = PointerType("Lane"), PointerType("Float"), PointerType("Integer")
_ENTRY = {"Lane": VECTOR, "Float": ir.DoubleType(), "Integer": ir.IntType(64)}


@register_model(PointerType)
class _PointerModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, ir.PointerType(_ENTRY[fe_type.kind]))


def _spread(builder: Any, x: Any) -> Any:
    undefined = ir.Constant(VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, x, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_INT32, WIDTH), [0] * WIDTH))


def as_lanes(context: Any, builder: Any, value: Any, numba_type: Any) -> Any:
    """A number of any type, in all four lanes."""
    if isinstance(numba_type, LaneType):
        return value
    return _spread(builder, context.cast(builder, value, numba_type, types.float64))


OPERANDS = (LaneType, types.Float, types.Integer)


def _define_operator(function: Any, instruction: str) -> None:
    class Template(AbstractTemplate):
        key = function

        def generic(self, args: Any, kws: Any) -> Any:
            lanes = any(isinstance(a, LaneType) for a in args)
            if len(args) == 2 and lanes and all(isinstance(a, OPERANDS) for a in args):
                return signature(V4, *args)
            return None

    infer_global(function)(Template)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b = (as_lanes(context, builder, x, t) for x, t in zip(args, sig.args, strict=True))
        return getattr(builder, instruction)(a, b, flags=FASTMATH)

    for left in OPERANDS:
        for right in OPERANDS:
            if LaneType in (left, right):
                lower_builtin(function, left, right)(lower)


for _function, _instruction in (
    (operator.add, "fadd"), (operator.iadd, "fadd"), (operator.sub, "fsub"), (operator.isub, "fsub"),
    (operator.mul, "fmul"), (operator.truediv, "fdiv"),
):  # fmt: skip
    _define_operator(_function, _instruction)


@intrinsic
def pointer(typingctx: Any, array: Any) -> Any:
    """The raw pointer of a C-contiguous array: of lanes if it is (K, 4), else of floats or integers."""
    result = _LANES if array.ndim == 2 else _INTEGERS if isinstance(array.dtype, types.Integer) else _FLOATS

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.bitcast(data, context.get_value_type(result))

    return result(array), lower


@intrinsic
def doubles(typingctx: Any, array: Any) -> Any:
    """The raw pointer of the floats of a C-contiguous array of any shape."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return context.make_array(sig.args[0])(context, builder, args[0]).data

    return _FLOATS(array), lower


def _constant(builder: Any, value: Any) -> Any:
    """A loaded value, as one that nothing overwrites."""
    value.set_metadata("invariant.load", builder.module.add_metadata([]))
    return value


@intrinsic
def load(typingctx: Any, p: Any, k: Any) -> Any:
    """Entry k of a pointer: V4, float64 or int64."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return sig.args[0].read(builder, builder.gep(args[0], [args[1]]))

    return p.entry(p, types.intp), lower


@intrinsic
def store(typingctx: Any, p: Any, k: Any, value: Any) -> Any:
    """Write entry k of a pointer; a float is spread over the lanes."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        sig.args[0].write(context, builder, builder.gep(args[0], [args[1]]), args[2], sig.args[2])
        return context.get_dummy_value()

    return types.void(p, types.intp, p.takes(value)), lower


@intrinsic
def at(typingctx: Any, p: Any, k: Any) -> Any:
    """The pointer to entry k."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.gep(args[0], [args[1]])

    return p(p, types.intp), lower


@intrinsic
def as_floats(typingctx: Any, p: Any) -> Any:
    """The doubles of lanes, four to an entry."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.bitcast(args[0], context.get_value_type(_FLOATS))

    return _FLOATS(p), lower


@infer_global(operator.getitem)
class _GetItem(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        if args[0] == _INTEGERS and isinstance(args[1], types.Integer):
            return signature(types.int64, _INTEGERS, types.intp)
        return None


@lower_builtin(operator.getitem, PointerType, types.Integer)
def _get_item(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return _constant(builder, builder.load(builder.gep(args[0], [args[1]]), align=8))


def define_entry(result: PointerType) -> Any:
    """The intrinsic that makes a pointer of a table's address."""

    @intrinsic
    def entry(typingctx: Any, table: Any, k: Any) -> Any:
        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            start = args[0]
            if isinstance(sig.args[0], types.Array):
                start = context.make_array(sig.args[0])(context, builder, start).data
            address = _constant(builder, builder.load(builder.gep(start, [args[1]]), align=8))
            return builder.inttoptr(address, context.get_value_type(result))

        return result(table, types.intp), lower

    return entry


lanes, floats, integers = (define_entry(kind) for kind in (_LANES, _FLOATS, _INTEGERS))


def _wide(builder: Any, args: Any) -> Any:
    return builder.bitcast(builder.gep(args[0], [args[1]]), ir.PointerType(VECTOR))


@intrinsic
def load4(typingctx: Any, p: Any, k: Any) -> Any:
    """Four consecutive doubles of a float pointer, from offset k."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_wide(builder, args), align=8)

    return V4(p, types.intp), lower


@intrinsic
def store4(typingctx: Any, p: Any, k: Any, value: Any) -> Any:
    """Write four consecutive doubles of a float pointer, from offset k."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _wide(builder, args), align=8)
        return context.get_dummy_value()

    return types.void(p, types.intp, V4), lower


@intrinsic
def spread(typingctx: Any, x: Any) -> Any:
    """A float in all four lanes."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return as_lanes(context, builder, args[0], sig.args[0])

    return V4(x), lower


def _define_choice(comparison: str) -> Any:
    """Max or min that lets a NaN of the first argument through (LLVM's maxnum would swallow it)."""

    @intrinsic
    def choose(typingctx: Any, a: Any, b: Any) -> Any:
        result = V4 if V4 in (a, b) else types.float64

        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            if result is V4:
                x, y = (as_lanes(context, builder, v, t) for v, t in zip(args, sig.args, strict=True))
            else:
                x, y = (context.cast(builder, v, t, types.float64) for v, t in zip(args, sig.args, strict=True))
            return builder.select(builder.fcmp_ordered(comparison, x, y), y, x)

        return result(a, b), lower

    return choose


maximum = _define_choice("<")
minimum = _define_choice(">")


@intrinsic
def select(typingctx: Any, a: Any, b: Any, x: Any, y: Any) -> Any:
    """In each lane, x where a < b, else y."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b, x, y = (as_lanes(context, builder, v, t) for v, t in zip(args, sig.args, strict=True))
        return builder.select(builder.fcmp_ordered("<", a, b), x, y)

    return V4(a, b, x, y), lower


@intrinsic
def any_less(typingctx: Any, a: Any, b: Any) -> Any:
    """Whether a < b in any lane, or either is NaN."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x, y = (as_lanes(context, builder, v, t) for v, t in zip(args, sig.args, strict=True))
        mask = builder.bitcast(builder.fcmp_unordered("<", x, y), ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", mask, ir.Constant(ir.IntType(WIDTH), 0))

    return types.boolean(a, b), lower
