"""The shapes of a MuJoCo model that have a contact of the plan, and the force between them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.contact.body_contact import BodyContact
from planner.model.contact.laws import Contact
from planner.model.mechanism import Mechanism
from planner.model.mjcf.contact_shapes import are_capsules, capsule_of, part_name, plane_and_spheres
from planner.model.mjcf.model_index import ModelIndex, named


class ContactGeoms(NamedTuple):
    """The geoms of a model that meet at a contact of the plan."""

    own: int  # with the sphere, or the first body's
    other: int  # with the plane, or the second body's
    name: str  # e.g. "left foot on floor"


def shapes_of(mechanism: Mechanism, survey: ModelIndex) -> list[ContactGeoms | None]:
    """The geoms of every contact of a mechanism, planes first; None where the model has no such pair.

    Names decide, and where they do not, places: a contact that is elsewhere is the same one, and differs.
    """
    flat, round_ = list(_with_planes(survey)), list(_of_bodies(survey))
    return [_nearest(one, flat) for one in mechanism.contacts] + [
        _nearest(one, round_) for one in mechanism.body_contacts
    ]


class _Candidate(NamedTuple):
    shapes: ContactGeoms
    links: tuple[int, ...]
    label: str  # as the plan's contacts are named
    place: np.ndarray  # numbers that are the same for the same shapes


def _with_planes(survey: ModelIndex) -> Iterator[_Candidate]:
    model, links = survey.model, survey.carriers[0]
    for pair in survey.pairs:
        match = plane_and_spheres(survey, pair.geoms)
        if match is None:
            continue
        plane, spheres = match
        for k, sphere in enumerate(spheres):
            other = pair.geoms[0] if pair.geoms[1] == sphere.geom else pair.geoms[1]
            part = part_name("", spheres, k)
            name = f"{shape_name(model, sphere.geom)}{part} on {shape_name(model, other)}"
            centre = (survey.geoms[sphere.geom] @ np.append(sphere.centre, 1.0))[:3]
            label = part_name(named(model, "geom", sphere.geom), spheres, k)
            place = np.array([*centre, sphere.radius, *plane.normal, plane.offset])
            yield _Candidate(
                ContactGeoms(sphere.geom, other, name), (int(links[model.geom_bodyid[sphere.geom]]),), label, place
            )


def _of_bodies(survey: ModelIndex) -> Iterator[_Candidate]:
    model = survey.model
    for pair in survey.pairs:
        if plane_and_spheres(survey, pair.geoms) is None and are_capsules(model, pair.geoms):
            first, second = (capsule_of(survey, geom) for geom in pair.geoms)
            label = " and ".join(named(model, "geom", geom) for geom in pair.geoms)
            name = " on ".join(shape_name(model, geom) for geom in pair.geoms)
            place = np.array([*first.middle, *second.middle, first.radius, second.radius])
            yield _Candidate(ContactGeoms(*pair.geoms, name), (first.link, second.link), label, place)


def _nearest(contact: Contact | BodyContact, candidates: list[_Candidate]) -> ContactGeoms | None:
    if isinstance(contact, Contact):
        links, plane = (contact.link,), contact.plane
        place = np.array([*contact.centre, contact.radius, *plane.normal, plane.offset])
    else:
        first, second = contact.first, contact.second
        links, place = (first.link, second.link), np.array([*first.middle, *second.middle, first.radius, second.radius])
    fits = [one for one in candidates if one.links == links]
    best = min(fits, key=lambda one: (one.label != contact.name, np.linalg.norm(one.place - place)), default=None)
    return None if best is None else best.shapes


def shape_name(model: Any, geom: int) -> str:
    """A geom by its own name or its body's."""
    return model.geom(geom).name or model.body(int(model.geom_bodyid[geom])).name or f"geom {geom}"


def contact_name(contact: Contact | BodyContact) -> str:
    """A contact by the name that its file gave it, without "geom" and quotation marks."""
    return re.sub(r"geom '([^']*)'", r"\1", contact.name) or "a contact"


def force_between(
    model: Any, data: Any, shapes: ContactGeoms, at: np.ndarray | None = None, within: float = np.inf
) -> np.ndarray:
    """(3,) N on the own shape, as `data` has it; NaN where the shapes do not touch.

    Of their contact nearest to the point `at` (3,), and `within` m of it; without a point, of all their contacts
    together: two bodies that touch at several have one contact in the plan.
    """
    mujoco, wrench = load_mujoco(), np.empty(6)
    forces, distances = [], []
    pairs = np.sort(data.contact.geom, axis=1)  # all at once: feet of many points have hundreds
    for c in np.flatnonzero(np.all(pairs == sorted((shapes.own, shapes.other)), axis=1)):
        contact = data.contact[int(c)]
        distance = 0.0 if at is None else float(np.linalg.norm(contact.pos - at))
        if distance > within:
            continue
        mujoco.mj_contactForce(model, data, int(c), wrench)
        sign = 1.0 if int(contact.geom[1]) == shapes.own else -1.0
        forces.append(sign * contact.frame.reshape(3, 3).T @ wrench[:3])
        distances.append(distance)
    if not forces:
        return np.full(3, np.nan)
    return np.sum(forces, axis=0) if at is None else forces[int(np.argmin(distances))]
