"""What ranges of joints leave of each other where couplings tie them: nothing, where a file contradicts itself.

Of a coupling sum c_k q_k = constant each coordinate keeps what the ranges of the others leave it. That is repeated
until nothing changes: a bound that is never too narrow, and exact for couplings of two coordinates.
"""

from __future__ import annotations

from typing import Any

import numpy as np

_ROUNDS = 50
_SLIGHT = 1e-6  # rad or m: a contradiction by less is none


def narrowed(mechanism: Any, ranges: np.ndarray) -> np.ndarray:
    """The ranges (nv, 2) that the couplings leave of `ranges`, lower ends first."""
    return _narrowed(mechanism, ranges)[0]


def contradiction(mechanism: Any, ranges: np.ndarray) -> str:
    """A sentence where no pose within the ranges (nv, 2) keeps all couplings; "" where the ranges leave one.

    It names the coupling, and the range of its first coordinate that would do.
    """
    left, at = _narrowed(mechanism, ranges)
    if at is None:
        return ""
    coupling = mechanism.couplings[at]
    name = mechanism.joint_of(coupling.dofs[0])
    low, high = _of_others(coupling, 0, left)
    terms = " + ".join(
        f"{c:g} {_name(mechanism, d)}" for c, d in zip(coupling.coefficients, coupling.dofs, strict=True)
    )
    own = ", ".join(f"{_name(mechanism, d)} {ranges[d, 0]:.6g} ... {ranges[d, 1]:.6g}" for d in coupling.dofs)
    said = f"the file contradicts itself: {coupling.name} asks {terms.replace('+ -', '- ')} = {coupling.constant:.6g}"
    said += f", which its ranges never give ({own}), expected ranges with a pose that keeps it: write "
    if np.isfinite([low, high]).all():
        said += f'range="{low:.6g} {high:.6g}" for {name} in the file, '
    return f'{said}active="false" for the equality, or angle="radian" in <compiler> if radians are meant.'


def _narrowed(mechanism: Any, ranges: np.ndarray) -> tuple[np.ndarray, int | None]:
    left = np.array(ranges, dtype=float)
    for _ in range(_ROUNDS):
        before = left.copy()
        for at, coupling in enumerate(mechanism.couplings):
            for k, dof in enumerate(coupling.dofs):
                low, high = _of_others(coupling, k, left)
                if low > left[dof, 1] + _SLIGHT or high < left[dof, 0] - _SLIGHT:
                    return before, at
                ends = np.clip([low, high], *left[dof])
                left[dof] = ends
        if np.array_equal(before, left):
            break
    return left, None


def _of_others(coupling: Any, k: int, ranges: np.ndarray) -> tuple[float, float]:
    """What the others leave coordinate k of a coupling."""
    low = high = coupling.constant
    for j, (dof, c) in enumerate(zip(coupling.dofs, coupling.coefficients, strict=True)):
        if j != k:
            ends = sorted(float(c * end) for end in ranges[dof])
            low, high = low - ends[1], high - ends[0]
    first, last = sorted((low / coupling.coefficients[k], high / coupling.coefficients[k]))
    return first, last


def _name(mechanism: Any, dof: int) -> str:
    return mechanism.joint_of(dof).removeprefix("joint ").strip("'")
