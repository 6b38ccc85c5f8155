"""SlipCost: feet that slide, or swing close to the ground; one term of a cost.

    J = sum over stages and contacts of dt w |s(h) v_t|^2 / 2

with v_t the tangential velocity of a contact's lowest point, h its height and s the share of kernels.tree.residuals
.foot_slip, 1 on the ground and 0 from the clearance on. A foot may stand, roll, or swing higher than the clearance;
sliding, landing with tangential speed and shuffling cost. Friction alone does not tell these apart: a foot that is
dragged with little load loses nothing in the plan, and is elsewhere when another ground has another friction.
(Kim et al. 2023, "Contact-implicit model predictive control: controlling diverse quadruped motions without pre-planned
contact modes or trajectories", foot slip and clearance cost.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from planner.base.arguments import number
from planner.kernels.tree.residuals.kinds import SLIP
from planner.model.contact.laws import Contact
from planner.problem.costs.residuals.arrays import ResidualList
from planner.problem.costs.residuals.cost import ResidualCost
from planner.problem.costs.tracking import mechanism_and_step

CLEARANCE = 0.06  # m: default of a foot that is lifted enough; a foot at 5 m/s crosses it in a stage, not unseen


class SlipCost(ResidualCost):
    """Slip of contacts with planes at rest, for any horizon. With RigidBodyDynamics it is part of the compiled solver.

    Args:
        machine: RigidBodyDynamics or a Mechanism.
        weight: w, per second and (m/s)^2.
        contacts: By default all of the machine with planes at rest.
        dt: s; that of the dynamics by default.
        clearance: Height from which a foot costs nothing, m.
    """

    def __init__(
        self, machine: Any, weight: float, contacts: Sequence[Contact] | None = None, dt: float | None = None,
        clearance: float = CLEARANCE,
    ) -> None:  # fmt: skip
        mechanism, dt = mechanism_and_step(machine, dt)
        rows, terms = dt * number("weight", weight, minimum=0.0), ResidualList(1)
        for one in mechanism.contacts if contacts is None else contacts:
            if np.any(one.plane.velocity) or one.plane.slide >= 0:
                continue  # a belt, or a box that moves: slip is relative to it
            constant = (*one.plane.normal, one.plane.offset + one.radius + one.law.margin, one.radius, 1.0 / clearance)
            terms.add(SLIP, [terms.point(one.link, one.centre)], (rows, 0.0), constant=constant)
        super().__init__(mechanism, terms.arrays(), None)
