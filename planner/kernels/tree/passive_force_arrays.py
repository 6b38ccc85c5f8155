"""The arrays of kernels.tree.mechanism_table for tendons, gravity compensation, drag, friction loss and stops."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.kernels.tree.contact_tables import LEAD_LAW_SIZE, lead_numbers

TENDON_SIZE, LIFTED_SIZE, DRAG_SIZE = 4, 4, 8  # numbers of a tendon, a link, a drag


def tendon_arrays(tendons: Any) -> dict[str, np.ndarray]:
    """Per tendon: its degrees of freedom with their factors from tendon_start on, and the four numbers of its force."""
    numbers = [(tendon.stiffness, *tendon.rest, tendon.damping) for tendon in tendons]
    return {
        "tendon_start": np.cumsum([0, *(len(tendon.dofs) for tendon in tendons)]),
        "tendon_dof": np.array([dof for tendon in tendons for dof in tendon.dofs], dtype=np.int64),
        "tendon_factor": np.array([factor for tendon in tendons for factor in tendon.coefficients], dtype=float),
        "tendon_value": np.array(numbers, dtype=float).reshape(-1, TENDON_SIZE),
    }


def gravcomp_arrays(mechanism: Any, frames: np.ndarray) -> dict[str, np.ndarray]:
    """Per link: the mass that gravity compensation carries and its first moment (3) in the kernels' frames.

    And that mass of the link and all beyond it.
    """
    mass = mechanism.gravcomp_mass
    moment = np.einsum(
        "nji,nj->ni", frames[:, :3, :3], mechanism.gravcomp_first_moment - mass[:, None] * frames[:, :3, 3]
    )
    beyond = mass.copy()
    for i in reversed(range(len(mass))):
        if mechanism.parent[i] >= 0:
            beyond[mechanism.parent[i]] += beyond[i]
    return {"gravcomp_value": np.column_stack([mass, moment]), "gravcomp_mass": beyond}


def drag_arrays(drags: Any, frames: np.ndarray) -> dict[str, np.ndarray]:
    """Per term of drag: its link, and its direction (moment, force) in the kernels' frame and its coefficients."""
    values = np.zeros((len(drags), DRAG_SIZE))
    for value, drag in zip(values, drags, strict=True):
        R, place = frames[drag.link, :3, :3], frames[drag.link, :3, 3]
        moment, force = drag.screw[:3], drag.screw[3:]
        value[:3], value[3:6] = R.T @ (moment - np.cross(place, force)), R.T @ force
        value[6:] = drag.linear, drag.quadratic
    return {"drag_link": np.array([drag.link for drag in drags], dtype=np.int64), "drag_value": values}


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
