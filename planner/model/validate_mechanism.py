"""Check the numbers of a mechanism, and that its contacts, stops and curves fit its links."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.errors import ModelError, PlannerError
from planner.model.contact.body_contact import check_body_contact
from planner.model.contact.laws import slide_direction
from planner.model.exponential_torques import check_curve


def validate_mechanism(mechanism: Any) -> None:
    """Raise a sentence for the first part of a mechanism that is wrong.

    Raises:
        ModelError: A number of a joint or an actuator is not finite, or negative where it must not be.
        PlannerError: A contact, a stop or a curve is of a link or a degree of freedom that cannot have it.
    """
    for name in ("armature", "damping", "stiffness", "friction_loss", "friction_rate"):
        values = getattr(mechanism, name)
        wrong = np.flatnonzero(~(np.isfinite(values) & (values >= 0.0)))
        if len(wrong):
            i = int(wrong[0])
            joint = next(j for j, links in enumerate(mechanism.joint_links) if links.start <= i < links.stop)
            where = f"joint {mechanism.joint_names[joint]!r} has {name} {values[i]:g}"
            raise ModelError(f"{where}, expected a finite number of at least 0.")
    for name in ("moment", "gain", "bias"):
        wrong = np.argwhere(~np.isfinite(getattr(mechanism.actuators, name)))
        if len(wrong):
            actuator = mechanism.actuators.names[int(wrong[0][0])]
            raise ModelError(f"actuator {actuator!r} has a {name} that is not finite, expected finite numbers.")
    screws = mechanism.kind == 0  # SCREW
    carriers = sorted({body.link for body in mechanism.bodies} - {-1})
    for k, contact in enumerate(mechanism.contacts):
        if contact.link not in carriers:  # of several joints of a body, the last one carries it
            raise PlannerError(f"contacts[{k}] is of link {contact.link}, expected one with a body: {carriers}.")
        slide_direction(mechanism, contact.plane)
    for k, pair in enumerate(mechanism.body_contacts):
        check_body_contact(pair, carriers, f"body_contacts[{k}]")
    for k, stop in enumerate(mechanism.stops):
        if not (stop.dof < mechanism.nv and screws[stop.dof]):
            raise PlannerError(
                f"stops[{k}] is of dof {stop.dof}, expected one of a hinge or slide, below {mechanism.nv}."
            )
    for k, curve in enumerate(mechanism.curves):
        check_curve(curve, screws, f"curves[{k}]")
