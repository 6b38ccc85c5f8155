"""Sample states with one contact of a plan at a given penetration depth, and find its geoms in a MuJoCo model."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from planner.base.gl import load_mujoco
from planner.dynamics.contact_kinematics import BodyContactKinematics, contact_kinematics
from planner.dynamics.kinematics import LinkPlaces
from planner.model.contact.body_contact import BodyContact
from planner.model.contact.laws import Contact, Law, slide_direction
from planner.model.mechanism import Mechanism
from planner.model.mjcf.contact_shapes import are_capsules, capsule_of, part_name, plane_and_spheres
from planner.model.mjcf.model_index import ModelIndex, named

AnyContact = Contact | BodyContact

_ITERATIONS, _STEP = 25, 0.5  # Iterations of Newton's method; largest joint displacement per iteration, rad or m
_ARRIVED, _ALMOST = 1e-6, 1e-3  # Tolerances of the depth, relative: to end the iteration, to accept a state
_ENOUGH = 3  # Number of converged states that ends the iteration
_CORNERS = 4  # Smallest number of other contacts on the same link and plane that identifies a corner of a box
_SLIGHT = 1e-9  # Jacobian entries, relative to the largest, and distances, m, that count as zero
_SHARE = 0.05  # Penetration depth relative to the radius, unless the law's smoothing needs more
_POINT = 0.02  # Penetration depth of a corner relative to the distance between corners, likewise


class ContactStateSampler:
    """Samples states in which one contact of a mechanism has a given penetration depth.

    Attributes:
        depth: Penetration depth, m: beyond the law's smoothing, else the static depth, limited relative to the radius.
        lowest_only: Whether the contact is a corner of a box, of which MuJoCo may report only the deepest.
        spacing: Smallest distance to another contact of the same link, m; infinite for a single one.
    """

    def __init__(self, mechanism: Mechanism, contact: AnyContact) -> None:
        self.mechanism, self.contact = mechanism, contact
        self._others = [one for one in mechanism.contacts if self._beside(one)]
        away = [float(np.linalg.norm(one.centre - contact.centre)) for one in self._others]  # type: ignore[union-attr]
        corner = isinstance(contact, Contact) and contact.radius == 0.0
        self.lowest_only = corner and len(away) >= _CORNERS
        self.spacing = min((distance for distance in away if distance > _SLIGHT), default=np.inf)
        weight = self._mass() * float(np.linalg.norm(mechanism.gravity))
        radius = contact.radius if isinstance(contact, Contact) else contact.first.radius + contact.second.radius
        wishes = [contact.law.rest_depth(weight), _SHARE * radius if radius > 0.0 else _POINT * self.spacing]
        self.depth = max(beyond_ramps(contact.law), min(wish for wish in wishes if wish > 0.0))

    def _beside(self, other: Contact) -> bool:
        """Whether another contact is of the same link and plane, and so may be of the same shape."""
        own = self.contact
        return isinstance(own, Contact) and other is not own and other.link == own.link and (
            other.plane.offset == own.plane.offset and bool(np.all(other.plane.normal == own.plane.normal))
        )  # fmt: skip

    def _mass(self) -> float:
        """Mass of the kinematic tree that contains the body in contact, kg."""
        parent = self.mechanism.parent
        root = np.arange(len(parent))
        for i, above in enumerate(parent):
            root[i] = root[above] if above >= 0 else i
        own = self.contact
        link = own.link if isinstance(own, Contact) else max(own.first.link, own.second.link)
        return float(self.mechanism.mass[root == root[link]].sum())

    @property
    def speed(self) -> float:
        """Impact speed at which that mass on the contact's spring reaches this depth, m/s."""
        return self.depth * float(np.sqrt(self.contact.law.stiffness / self._mass()))

    def place(self, x: np.ndarray) -> Any:
        """Kinematics of the contact at states (K, nx)."""
        m = self.mechanism
        return contact_kinematics(LinkPlaces(m, x[:, : m.nq]), self.contact, x[:, m.velocities])

    def matters(self, x: np.ndarray, fixed: np.ndarray) -> bool:
        """Whether a degree of freedom outside `fixed` changes the contact at states (K, nx)."""
        J = np.abs(self.place(x).J).max(axis=(0, 1))
        return bool(np.any(np.delete(J, fixed) > _SLIGHT * max(J.max(), 1.0)))

    def pressed(
        self, starts: np.ndarray, depth: float, middle: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Move the joints of states (K, nx) until the contact is `depth` m deep, at zero velocity.

        Newton's method with minimum-norm joint displacements. With `middle` (3,), the point of the plane's shape
        where the file has it, the contact is moved along the plane to that point too.

        Returns:
            The converged states (k, nx), and (k,) whether no other contact of the same link is deeper; all true
            unless `lowest_only`.
        """
        m, contact = self.mechanism, self.contact
        x = starts.copy()
        x[:, m.velocities] = 0.0
        aside = np.zeros((len(x), 3))
        for _ in range(_ITERATIONS):
            place = self.place(x)
            rows, missing = -np.einsum("ka,kaj->kj", place.n, place.J)[:, None], self._missing(place, depth)[:, None]
            if middle is not None and isinstance(contact, Contact):
                across = np.eye(3) - np.outer(contact.plane.normal, contact.plane.normal)
                aside = (_carried(m, contact, x, middle) - place.p) @ across
                rows, missing = np.concatenate([rows, across @ place.J], 1), np.concatenate([missing, aside], 1)
            arrived = (np.abs(missing[:, 0]) <= _ARRIVED * depth) & np.all(np.abs(aside) <= depth, axis=1)
            if arrived.all() or (arrived.sum() >= _ENOUGH and not self.lowest_only):
                break
            step = np.einsum("kja,ka->kj", np.linalg.pinv(rows, rcond=1e-6), missing)
            step *= np.minimum(1.0, _STEP / np.maximum(np.abs(step).max(axis=1, keepdims=True), _STEP))
            change = np.zeros((len(x), m.space.ndx))
            change[:, : m.nv] = step
            x = m.space.integrate(x, change)
        place = self.place(x)
        there = (np.abs(self._missing(place, depth)) <= _ALMOST * depth) & np.all(np.abs(aside) <= 2.0 * depth, axis=1)
        x = x[there]
        if isinstance(place, BodyContactKinematics):  # where axes cross, closest points change abruptly
            x = x[np.argsort(-place.crossing[there], kind="stable")]
        lowest = self._lowest(x) if self.lowest_only else np.ones(len(x), dtype=bool)
        lowest_first = np.argsort(~lowest, kind="stable")
        return x[lowest_first], lowest[lowest_first]

    def _missing(self, place: Any, depth: float) -> np.ndarray:
        """(K,) remaining penetration to the wanted depth, m."""
        return depth + self.contact.law.surface_offset - place.e

    def _lowest(self, x: np.ndarray) -> np.ndarray:
        m = self.mechanism
        at, qd = LinkPlaces(m, x[:, : m.nq]), x[:, m.velocities]
        own, *others = (contact_kinematics(at, one, qd).e for one in (self.contact, *self._others))
        return np.all([own >= e - _ALMOST * self.depth for e in others], axis=0) if others else np.ones(len(x), bool)

    def moving(self, place: Any, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Minimum-norm joint velocities (nv,) for a contact velocity (3,), at one state, and the attained velocity."""
        drift = self.contact.plane.velocity if isinstance(self.contact, Contact) else np.zeros(3)
        qd = np.linalg.pinv(place.J[0], rcond=1e-6) @ (velocity + drift)
        return qd, place.J[0] @ qd - drift


def beyond_ramps(law: Law) -> float:
    """Twice the depth beyond which a law is linear, without smoothing, in m or rad."""
    return 2.0 * max(law.ramp - law.surface_offset, 0.5 * float(law.force_ramp or 0.0) / law.stiffness)


def _carried(mechanism: Mechanism, contact: Contact, x: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """(K, 3) a point of the plane's shape, which may be fixed to a moving slide joint."""
    i = contact.plane.slide
    if i < 0:
        return np.broadcast_to(middle, (len(x), 3))
    address = mechanism.q_address[i]
    return middle + (x[:, address] - mechanism.qpos0[address])[:, None] * slide_direction(mechanism, contact.plane)


class ContactGeoms(NamedTuple):
    """The two geoms of a model that form a contact of the plan."""

    own: int  # with the sphere, or the first body's
    other: int  # with the plane, or the second body's
    name: str  # e.g. "left foot on floor"


def shapes_of(mechanism: Mechanism, survey: ModelIndex) -> list[ContactGeoms | None]:
    """The geoms of every contact of a mechanism, planes first; None where the model has no such pair.

    Matched by name, else by position; a contact of the same name at another position is matched, and differs.
    """
    flat, round_ = list(_with_planes(survey)), list(_of_bodies(survey))
    return [_nearest(one, flat) for one in mechanism.contacts] + [
        _nearest(one, round_) for one in mechanism.body_contacts
    ]


class _Candidate(NamedTuple):
    shapes: ContactGeoms
    links: tuple[int, ...]
    label: str  # name in the format of the plan's contacts
    place: np.ndarray  # position and size, equal for equal shapes


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
    """A geom's name, or its body's."""
    return model.geom(geom).name or model.body(int(model.geom_bodyid[geom])).name or f"geom {geom}"


def contact_name(contact: Contact | BodyContact) -> str:
    """Name of a contact from its file, without "geom" and quotation marks."""
    return re.sub(r"geom '([^']*)'", r"\1", contact.name) or "a contact"


def wrench_between(
    model: Any, data: Any, shapes: ContactGeoms, at: np.ndarray | None = None, within: float = np.inf
) -> np.ndarray:
    """(6,) force, N, and torque, N m, on the geom `shapes.own` from the contacts in `data`; NaN where they are apart.

    Those of their contact nearest to the point `at` (3,), if within `within` m; without a point, the sum over
    all their contacts, since two bodies in contact at several points have one contact in the plan.
    """
    mujoco, wrench = load_mujoco(), np.empty(6)
    forces, distances = [], []
    pairs = np.sort(data.contact.geom, axis=1)  # vectorized: meshes may have hundreds of contact points
    for c in np.flatnonzero(np.all(pairs == sorted((shapes.own, shapes.other)), axis=1)):
        contact = data.contact[int(c)]
        distance = 0.0 if at is None else float(np.linalg.norm(contact.pos - at))
        if distance > within:
            continue
        mujoco.mj_contactForce(model, data, int(c), wrench)
        sign = 1.0 if int(contact.geom[1]) == shapes.own else -1.0
        forces.append(sign * (wrench.reshape(2, 3) @ contact.frame.reshape(3, 3)).ravel())
        distances.append(distance)
    if not forces:
        return np.full(6, np.nan)
    return np.sum(forces, axis=0) if at is None else forces[int(np.argmin(distances))]
