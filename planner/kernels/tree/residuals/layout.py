"""Where kernels of residuals find what they read and write: one int64 table of sizes and addresses."""

from __future__ import annotations

from planner.kernels.numba.layout import Layout

RESIDUALS = Layout(
    "points terms stride constants columns ld moved fast massive bending works",
    "links point_link point_address point_value world active kind ends first_row constant first_reference reference "
    "on bound weight law start dof tree_address places value kept factor curvature row scaled moments gradient hessian "
    "side rates bent bend bends work way turns work_slopes through",
)
MAX_ROWS = 6  # of a term
PARALLEL = 1e-12
"""Share of the squared lengths that keeps the nearest points of parallel lines in their middles."""
TINY = 1e-40  # added to squares before their root or a division by them: a distance of zero has no direction
POINT_SIZE = 4  # of a point's constants: its place in the link's frame (3), share
PLACE_SIZE = 9  # of a point where it is: about its tree's origin (3), as terms see it (3); how its link moves it (3)
LAW_SIZE = 3  # of a row: side (0 for a target, 1 for most, -1 for least), ramp and its inverse
RATE_SIZE = 9  # of a dof: how it turns a distance's direction, and how it changes its moment about either shape's tree
WORK_SIZE = 3  # of a cost of work: weight per J, smoothing in W, length of a stage in s
TURN_SIZE = 21  # of a ball: minus its displacement (3), how that depends on its start (9) and on its end (9)
KEPT_SIZE = 32  # lanes that a term's value leaves for its derivative
