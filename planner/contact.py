"""Contact: what a machine touches, how, and the stops of its joints. Public names; planner.model has the code.

A user writes a ContactLaw (`Mechanism.from_mjcf(..., contacts=law)`), ExponentialTorques
(`Mechanism.with_curves`) and, into an MJCF, what contact_attributes and stop_attributes return. Contact, Plane,
BodyContact, Capsule, Stop and its Law are read from an MJCF.
"""

from planner.model.contact.body_contact import BodyContact, Capsule
from planner.model.contact.laws import Contact, ContactLaw, Law, Plane, Stop
from planner.model.mjcf.contacts import contact_attributes, stop_attributes
from planner.model.passive_forces import ExponentialTorque

__all__ = [
    "BodyContact",
    "Capsule",
    "Contact",
    "ContactLaw",
    "ExponentialTorque",
    "Law",
    "Plane",
    "Stop",
    "contact_attributes",
    "stop_attributes",
]
