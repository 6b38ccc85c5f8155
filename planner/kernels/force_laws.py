"""Force laws of actuators that are more than gain u + bias, with exact derivatives, on lanes and in NumPy.

A law adds a force to that of its actuator: a function of what it is given (control or activation), its length and its
length rate, affine in what it is given. It is a function of these three and of LAW_SIZE numbers p. It returns

    force, d force/d given, d force/d length, d force/d rate

by arithmetic alone, so that one source is compiled for lanes and called with arrays. A new law is such a function, its
entry of LAWS and its branch in `evaluate`; planner.model.mjcf.joint_forces reads it from a model.
"""

from __future__ import annotations

from typing import Any

from planner.kernels.numba.jit import inline
from planner.kernels.numba.lanes import spread

LAW_SIZE = 4  # numbers of a law; those that it does not have are 0


def affine_gain(given, length, rate, p):
    """(p0 length + p1 rate) given: what of MuJoCo's affine gain depends on the state."""
    gain = p[0] * length + p[1] * rate
    return gain * given, gain, p[0] * given, p[1] * given


LAWS = {"affine gain": affine_gain}  # by the kind of a planner.model.actuators.ForceLaw
_affine_gain = inline(affine_gain)


def law_terms(law: Any, given: Any, length: Any, rate: Any) -> tuple[Any, Any, Any, Any]:
    """Force and derivatives of a ForceLaw at arrays of one shape, real or complex."""
    return LAWS[law.kind](given, length, rate, law.numbers)


@inline
def evaluate(kind, given, length, rate, p):
    """The same on lanes, of the law that has place `kind` in LAWS."""
    zero = spread(0.0)  # makes lanes of a derivative that is a constant
    force, by_given, by_length, by_rate = _affine_gain(given, length, rate, p)
    return zero + force, zero + by_given, zero + by_length, zero + by_rate
