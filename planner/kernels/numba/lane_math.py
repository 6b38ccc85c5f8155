"""Functions of floats, V4 and (but for root and exponential) D4 alike: rounding, root, sines, exponential.

And the angle of a point, on lanes alone.
"""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from planner.kernels.numba.duals import D4, value_of
from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import V4, WIDTH, intrinsic, select


def _define_function(name: str, steps: bool) -> Any:
    """An LLVM intrinsic of one argument. A function of steps takes duals too, and gives lanes: it has no slope."""

    @intrinsic
    def function(typingctx: Any, x: Any) -> Any:
        if x is D4 and not steps:
            return None
        result = V4 if x is D4 else x
        suffix = f"v{WIDTH}f64" if result is V4 else "f64"

        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            value = value_of(context, builder, args[0]) if sig.args[0] is D4 else args[0]
            kind = ir.FunctionType(value.type, [value.type])
            called = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.{suffix}")
            return builder.call(called, [value])

        return result(x), lower

    return function


rint, floor, sqrt = _define_function("rint", True), _define_function("floor", True), _define_function("sqrt", False)

# pi in two parts, so that subtracting multiples of it loses nothing.
_PI, _PI_REST, _INVERSE_PI = math.pi, 1.2246467991473532e-16, 1.0 / math.pi
# Taylor coefficients: on |r| <= pi/2 the first term left out is below 1e-18.
_S2, _S3, _S4, _S5, _S6, _S7, _S8, _S9, _S10, _S11 = ((-1) ** k / math.factorial(2 * k + 1) for k in range(1, 11))
_C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8, _C9, _C10, _C11 = ((-1) ** k / math.factorial(2 * k) for k in range(1, 12))


@inline
def sincos(x):
    """Sine and cosine, to about one unit in the last place of 1."""
    k = rint(x * _INVERSE_PI)
    r = (x - k * _PI) - k * _PI_REST
    sign = 1.0 - 2.0 * (k - 2.0 * floor(k * 0.5))
    z = r * r
    # Estrin's scheme: what waits for a link's pose waits for this, and Horner's chain is twice as long
    z2 = z * z
    z4 = z2 * z2
    z8 = z4 * z4
    s = (_S2 + _S3 * z) + (_S4 + _S5 * z) * z2 + ((_S6 + _S7 * z) + (_S8 + _S9 * z) * z2) * z4 + (_S10 + _S11 * z) * z8
    c = (_C2 + _C3 * z) + (_C4 + _C5 * z) * z2 + ((_C6 + _C7 * z) + (_C8 + _C9 * z) * z2) * z4 + (_C10 + _C11 * z) * z8
    s = s * z
    c = (c * z + _C1) * z
    return sign * (r + r * s), sign * (1.0 + c)


# Rational approximation of (atan(x) - x) / x^3 on |x| <= 0.66, to 2e-16 of atan (Moshier, Cephes, atan.c).
_P0, _P1, _P2, _P3, _P4 = (
    -6.485021904942025371773e1, -1.228866684490136173410e2, -7.500855792314704667340e1, -1.615753718733365076637e1,
    -8.750608600031904122785e-1,
)  # fmt: skip
_Q0, _Q1, _Q2, _Q3, _Q4 = (
    1.945506571482613964425e2, 4.853903996359136964868e2, 4.328810604912902668951e2, 1.650270098316988542046e2,
    2.485846490142306297962e1,
)  # fmt: skip


@inline
def quarter_angle(y, x):
    """The angle from 0 to pi/2 of the point (x, y), on lanes; neither is negative and one is above 0."""
    small, large = select(y, x, y, x), select(y, x, x, y)
    above, below = select(0.66 * large, small, small - large, small), select(0.66 * large, small, small + large, large)
    t = above / below
    z = t * t
    upper = _P0 + z * (_P1 + z * (_P2 + z * (_P3 + z * _P4)))
    lower = _Q0 + z * (_Q1 + z * (_Q2 + z * (_Q3 + z * (_Q4 + z))))
    angle = select(0.66 * large, small, 0.25 * _PI, 0.0) + (t + t * z * (upper / lower))
    return select(y, x, angle, 0.5 * _PI - angle)


@intrinsic
def _power_of_two(typingctx: Any, k: Any) -> Any:
    """2^k of whole numbers from -1022 to 1023."""
    if k is D4:
        return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = args[0]
        wide = isinstance(value.type, ir.VectorType)
        whole = ir.VectorType(ir.IntType(64), WIDTH) if wide else ir.IntType(64)

        def constant(kind: Any, number: float) -> ir.Constant:
            return ir.Constant(kind, [number] * WIDTH if wide else number)

        # Beside 1.5 2^52 the last bits of a float are the whole number: moved up, they are an exponent.
        bits = builder.bitcast(builder.fadd(value, constant(value.type, 1.5 * 2.0**52 + 1023.0)), whole)
        return builder.bitcast(builder.shl(bits, constant(whole, 52)), value.type)

    return k(k), lower


_INVERSE_LN2 = 1.0 / math.log(2.0)
_LN2, _LN2_REST = 6.93147180369123816490e-01, 1.90821492927058770002e-10  # k times the first is exact
# Taylor coefficients: on |r| <= ln(2) / 2 the first term left out is below 1e-17.
_E = tuple(1.0 / math.factorial(k) for k in range(14))
_E2, _E3, _E4, _E5, _E6, _E7, _E8, _E9, _E10, _E11, _E12, _E13 = _E[2:]


@inline
def exp(x):
    """The exponential of -708 to 709, to about two units in the last place."""
    k = rint(x * _INVERSE_LN2)
    r = (x - k * _LN2) - k * _LN2_REST
    r2 = r * r
    r4 = r2 * r2
    low = (_E2 + _E3 * r) + (_E4 + _E5 * r) * r2
    middle = (_E6 + _E7 * r) + (_E8 + _E9 * r) * r2
    high = (_E10 + _E11 * r) + (_E12 + _E13 * r) * r2
    return _power_of_two(k) * (1.0 + (r + r2 * (low + r4 * (middle + r4 * high))))


@intrinsic
def transpose(typingctx: Any, rows: Any) -> Any:
    """Four V4 with rows and lanes exchanged."""
    result = types.UniTuple(V4, WIDTH)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        def shuffled(a: Any, b: Any, order: list[int]) -> Any:
            return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), order))

        r = [builder.extract_value(args[0], i) for i in range(WIDTH)]
        size = 1
        while size < WIDTH:  # exchange the off-diagonal blocks of growing size
            low = [j if not j & size else WIDTH + j - size for j in range(WIDTH)]
            high = [j + size if not j & size else WIDTH + j for j in range(WIDTH)]
            for i in range(WIDTH):
                if not i & size:
                    a, b = r[i], r[i + size]
                    r[i], r[i + size] = shuffled(a, b, low), shuffled(a, b, high)
            size *= 2
        return context.make_tuple(builder, result, r)

    return result(rows), lower
