"""The kinds of residuals that are compiled: what is known of each, its value and its derivative.

To add one: a file beside this one with its number, value and derivative, its three lines here, and the quantity that
asks for it, with its NumPy twin, in problem.constraints.quantities.
"""

from __future__ import annotations

from typing import NamedTuple

from planner.kernels.numba.jit import part
from planner.kernels.numba.lanes import integers, load
from planner.kernels.tree.residuals import frames
from planner.kernels.tree.residuals.foot_slip import SLIP, slip_rows, slip_value
from planner.kernels.tree.residuals.frames import ANGULAR, LINEAR, POINTING, POSITION, TILT
from planner.kernels.tree.residuals.layout import RESIDUALS
from planner.kernels.tree.residuals.mass_centre import MASS_CENTRE, mass_centre_rows, mass_centre_value
from planner.kernels.tree.residuals.orientation import ORIENTATION, POSE, orientation_rows, orientation_value
from planner.kernels.tree.residuals.scalars import DISTANCE, HEIGHT, VELOCITY, scalar_row, scalar_value, velocity_row
from planner.kernels.tree.residuals.solids import BOXES, LINE_BOX, OVER_PLANE, solid_row, solid_value


class Kind(NamedTuple):
    """What is known of a kind."""

    rows: int = 1
    references: int = 0  # numbers per stage
    fast: bool = False  # whether it depends on velocities
    turned: int = 0  # how many of its first constants are an axis (3) or a rotation (9) in the frame of its first point


KINDS = {
    HEIGHT: Kind(), DISTANCE: Kind(), VELOCITY: Kind(fast=True),
    POSITION: Kind(3), POINTING: Kind(3, turned=3), LINEAR: Kind(3, fast=True), ANGULAR: Kind(3, fast=True),
    ORIENTATION: Kind(3, 9, turned=9), POSE: Kind(6, 12, turned=9), MASS_CENTRE: Kind(3), TILT: Kind(turned=3),
    SLIP: Kind(3, fast=True), LINE_BOX: Kind(), BOXES: Kind(), OVER_PLANE: Kind(),
}  # fmt: skip
FAST = tuple(number for number, kind in KINDS.items() if kind.fast)
SOLIDS = (LINE_BOX, BOXES, OVER_PLANE)  # kinds of two solids


@part
def measure(m, p, q, ws, t, n, knots, solids):
    """The rows of term t's value, in RESIDUALS.value."""
    kind = load(integers(p, RESIDUALS.kind), t)
    if solids is not None:  # noqa: SIM102 - Numba leaves out what hangs on this alone
        if kind >= LINE_BOX and kind <= OVER_PLANE:
            solid_value(p, ws, t, kind, n, knots)
            return
    if kind <= VELOCITY:
        scalar_value(p, t, kind)
    elif kind <= ANGULAR:
        frames.frame_value(p, ws, t, kind)
    elif kind <= POSE:
        orientation_value(p, ws, t, kind, n, knots)
    elif kind == MASS_CENTRE:
        mass_centre_value(m, p, q, ws, t)
    elif kind == TILT:
        frames.tilt_value(p, ws, t)
    elif kind == SLIP:
        slip_value(p, ws, t)


@part
def differentiate(m, p, ws, t, solids):
    """The derivative of term t's value, in RESIDUALS.row, which was zero; after measure."""
    kind = load(integers(p, RESIDUALS.kind), t)
    if solids is not None:  # noqa: SIM102 - Numba leaves out what hangs on this alone
        if kind >= LINE_BOX and kind <= OVER_PLANE:
            solid_row(m, p, ws, t)
            return
    if kind < VELOCITY:
        scalar_row(m, p, ws, t, kind)
    elif kind == VELOCITY:
        velocity_row(m, p, ws, t)
    elif kind <= POINTING:
        frames.place_rows(m, p, ws, t, kind)
    elif kind <= ANGULAR:
        frames.speed_rows(m, p, ws, t, kind)
    elif kind <= POSE:
        orientation_rows(m, p, ws, t, kind)
    elif kind == MASS_CENTRE:
        mass_centre_rows(m, p, ws, t)
    elif kind == TILT:
        frames.tilt_row(m, p, ws, t)
    elif kind == SLIP:
        slip_rows(m, p, ws, t)
