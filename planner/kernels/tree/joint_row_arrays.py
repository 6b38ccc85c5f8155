"""The arrays of kernels.tree.mechanism_table for what has a joint's acceleration in it: friction loss and stops."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.kernels.tree.contact_tables import LEAD_LAW_SIZE, lead_numbers

STOP_END, STOP_LAW, STOP_SIZE = 0, 1, 1 + LEAD_LAW_SIZE  # offsets in a stop's numbers, and how many there are
LOWER, ROW_SIZE = 3, 3 + 2 * STOP_SIZE  # of a row: loss, inertia and rate of friction, the stops below and above


def joint_row_arrays(mechanism: Any, losses: np.ndarray, stops: Any) -> dict[str, np.ndarray]:
    """Per joint with friction loss or stops with a lead: its degree of freedom, and the numbers of both.

    A stop's are where it begins and those of its law; a stiffness of 0 stands for none.
    """
    dofs = sorted({*map(int, np.flatnonzero(losses)), *(stop.dof for stop in stops)})
    value = np.zeros((len(dofs), ROW_SIZE))
    rubs = losses > 0.0
    friction = np.column_stack([losses, *(rubs * x for x in (mechanism.friction_inertia, mechanism.friction_rate))])
    value[:, :LOWER] = friction[dofs]
    for stop in stops:
        o = LOWER + STOP_SIZE * (stop.side > 0)
        own = value[dofs.index(stop.dof), o : o + STOP_SIZE]
        own[:] = stop.end - stop.side * stop.law.reach, *lead_numbers(stop.law)
    return {"row_dof": np.array(dofs, dtype=np.int64), "row_value": value}
