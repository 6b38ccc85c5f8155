"""Arrays of kernels.tree.mechanism_table for sphere-plane contacts, joint stops and contacts of two bodies."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from planner.model.contact.body_contact import common_carrier
from planner.model.contact.laws import slide_direction

CONTACT_SIZE, STOP_SIZE = 25, 8  # numbers of a contact and of a stop: see contact_arrays
SOFT_SIZE = 36  # of a soft contact: see soft_arrays
LEAD_LAW_SIZE = 11  # of a law with a lead: see lead_numbers
MIN_BEND = 1e-9  # of the elliptic cone, so that no number is divided by 0
PAIR_SIZE, PAIR_LINKS_SIZE = 32, 5  # numbers and links of a contact of two bodies: see pair_arrays


def contact_arrays(contacts: Any, mechanism: Any, tree: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Per contact: centre (3), normal (3), level, arm, surface velocity (3), slide (3), eleven numbers of its force.

    With the centre c in the kernels' frames and about the tree's origin, e = level - n'c and p = c - (arm - e/2) n.
    """
    link = np.array([contact.link for contact in contacts], dtype=np.int64)
    value = np.zeros((len(contacts), CONTACT_SIZE))
    for row, contact in zip(value, contacts, strict=True):
        row[:11] = _geometry(contact, tree)
        row[11:14], row[14:] = slide_direction(mechanism, contact.plane), _contact_law_numbers(contact.law)
    slide = np.array([contact.plane.slide for contact in contacts], dtype=np.int64)
    address = tree["floating_address"][link]
    return {"contact_link": link, "contact_address": address, "contact_slide": slide, "contact_value": value}


def _geometry(contact: Any, tree: dict[str, np.ndarray]) -> np.ndarray:
    """(11,) centre, normal, level, arm and surface velocity of a contact: see contact_arrays."""
    plane, i = contact.plane, contact.link
    centre = np.linalg.inv(tree["frames"][i]) @ np.append(contact.centre, 1.0)
    level = contact.radius + contact.law.reach + plane.offset - plane.normal @ tree["origin"][i]
    arm = contact.radius + 0.5 * contact.law.reach
    return np.concatenate([centre[:3], plane.normal, [level, arm], plane.velocity])


def soft_arrays(contacts: Any, tree: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Per soft contact: centre (3), normal (3), level, arm, surface velocity (3), two tangents (3), its law (19).

    The first eleven as in contact_arrays. Of the law: eleven of lead_numbers, friction, the root of impratio, the
    smoothing of the cone, whether the cone is elliptic, the share of each edge, of an elliptic cone spinning/mu and
    rolling/mu, of a pyramid spinning and rolling, m, and the inverse of the longer one, 0 without any.
    """
    link = np.array([contact.link for contact in contacts], dtype=np.int64)
    value = np.zeros((len(contacts), SOFT_SIZE))
    for row, contact in zip(value, contacts, strict=True):
        law, elliptic = contact.law, contact.law.is_round
        root = math.sqrt(law.impratio) if elliptic else 1.0
        row[:11], row[11:17] = _geometry(contact, tree), np.concatenate(tangents(contact.plane.normal))
        row[17:28] = lead_numbers(law)
        bend = max(law.bend, MIN_BEND) * law.friction / root
        arms = np.array([law.spinning, law.rolling]) / (law.friction if elliptic else 1.0)
        longest = arms.max()
        row[28:] = law.friction, root, bend, elliptic, 1.0 / law.edges, *arms, 1.0 / longest if longest > 0.0 else 0.0
    return {"soft_link": link, "soft_address": tree["floating_address"][link], "soft_value": value}


def tangents(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two directions (3,) of a contact's frame across its normal, as mju_makeFrame chooses them."""
    first = np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.5 else np.array([0.0, 0.0, 1.0])
    first -= normal * (normal @ first)
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def stop_arrays(stops: Any) -> dict[str, np.ndarray]:
    """Per stop: its side, where it begins, and the six numbers of its force."""
    rows = [[stop.side, stop.end - stop.side * stop.law.reach, *_law_numbers(stop.law)] for stop in stops]
    return {
        "stop_dof": np.array([stop.dof for stop in stops], dtype=np.int64),
        "stop_value": np.array(rows, dtype=float).reshape(-1, STOP_SIZE),
    }


def pair_arrays(pairs: Any, parent: np.ndarray, tree: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Per contact of two bodies: both links, their last common one, where qpos has their floating trees' places.

    And of each part its middle (3), axis (3) and half length, then from the second's origin to the first's (3),
    r_1 + r_2 + reach, (r_1 - r_2)/2, b, the determinant for parallel axes, eleven numbers of the force.
    """
    links = np.full((len(pairs), PAIR_LINKS_SIZE), -1, dtype=np.int64)
    value = np.zeros((len(pairs), PAIR_SIZE))
    for link, row, pair in zip(links, value, pairs, strict=True):
        parts, b, origins = (pair.first, pair.second), pair.axis_regularization, np.zeros((2, 3))
        link[:3] = pair.first.link, pair.second.link, common_carrier(parent, pair)
        for k, part in enumerate(parts):
            own = np.linalg.inv(tree["frames"][part.link]) if part.link >= 0 else np.eye(4)
            row[7 * k : 7 * k + 3] = (own @ np.append(part.middle, 1.0))[:3]
            row[7 * k + 3 : 7 * k + 6], row[7 * k + 6] = own[:3, :3] @ part.axis, part.length
            if part.link >= 0:
                origins[k], link[3 + k] = tree["origin"][part.link], tree["floating_address"][part.link]
        if link[3] == link[4]:  # of one tree
            link[3:] = -1
        radii = [part.radius for part in parts]
        row[14:17] = origins[0] - origins[1]
        reach = sum(radii) + pair.law.reach
        row[17:21] = reach, 0.5 * (radii[0] - radii[1]), b, b * (2.0 + b) if b > 0.0 else 1.0
        row[21:] = _contact_law_numbers(pair.law)
    return {"pair_links": links, "pair_value": value}


def _contact_law_numbers(law: Any) -> list[float]:
    """Those of _law_numbers, and five of friction."""
    raised = law.friction / law.impratio  # MuJoCo's projection, see planner.model.contact.laws
    share = 1.0 / (1.0 + law.friction * raised)
    return [*_law_numbers(law), law.slip_damping, law.friction, raised, share, law.bend]


def lead_numbers(law: Any) -> list[float]:
    """(11,) of a law with a lead: those of _law_numbers, lead, and impedance: first, last, 1/width, midpoint."""
    first, last, width, midpoint = law.impedance
    return [*_law_numbers(law), law.lead, first, last, 1.0 / width, midpoint]


def _law_numbers(law: Any) -> list[float]:
    """Stiffness, damping and the two ramps with their inverses, so large for none that all is beyond its end."""
    ramps = (law.ramp, law.force_ramp)
    return [law.stiffness, law.damping, *(x for a in ramps for x in (a, 1.0 / a if a > 0.0 else 1e300))]
