"""Read the contacts of an MJCF in which MuJoCo computes the law of model.contact.laws.

MuJoCo's constraints tend to plain springs and dampers when their impedance d is next to nothing (solimp="1e-4 1e-4"):
then R >> A in its problem, and with solref in the direct format and A the constant invweight0 of the two bodies

    solref = (-K A (1-d), -B A (1-d)),   solreffriction = (-K A (1-d), -c_t A (1-d) / impratio)

are the K, B and c_t of a force K e - B v_n with friction c_t v_t, cut off at mu f_n (elliptic cone, ContactLaw.exact).
`contact_attributes` and `stop_attributes` write them. How much of it is smoothed for planning is no part of
MuJoCo's model, so the file says it in numbers of its own:

    <custom><numeric name="contact_ramp" data="0.002 1 0.5"/> <numeric name="stop_ramp" data="0.03"/></custom>

a ramp in m (stops: of their joint's coordinate), one of the force, and how gradually friction bends; the last two may
be left out, and without any there is no smoothing. That named contact_uncertainty says how many times softer
contacts may be.

A file whose custom text named contact_law is "file" asks for MuJoCo's law as it is, a law with a lead (file_law).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from planner.base.arguments import number
from planner.base.errors import ModelError, PlannerError
from planner.base.gl import load_mujoco
from planner.model.contact.body_contact import BodyContact
from planner.model.contact.laws import BEND, Contact, ContactLaw, Law
from planner.model.mjcf.contact_shapes import are_capsules, capsule_of, part_name, plane_and_spheres
from planner.model.mjcf.file_law import (
    MAX_IMPEDANCE,
    MIN_FRICTION,
    MIN_IMPEDANCE,
    edge_weight,
    file_law,
    file_law_reason,
    force_begins,
)
from planner.model.mjcf.model_index import ModelIndex, Pair, named, texts_of
from planner.model.mjcf.unsupported import UnsupportedElement

SOFT = 1e-4  # the impedance d, the least that MuJoCo knows
SOFTEST = 1e-3  # up to here R is still a thousand times A, and the forces differ by less than a percent
MIN_IMPRATIO = 100.0  # of smoothed friction, which knows no projection
CONTACT_RAMP, STOP_RAMP = "contact_ramp", "stop_ramp"
CONTACT_UNCERTAINTY = "contact_uncertainty"
CONTACT_LAW, OF_FILE = "contact_law", "file"


def contact_attributes(
    stiffness: float, damping: float, slip_damping: float, friction: float, invweight: float, impratio: float = 1000.0
) -> dict[str, str]:
    """The attributes of a <pair> in which MuJoCo computes a contact with these coefficients.

    The model also needs <option cone="elliptic" impratio="..."><flag refsafe="disable"/></option>.

    Args:
        stiffness: K, N/m.
        damping: B, N s/m.
        slip_damping: c_t, N s/m.
        friction: mu.
        invweight: Sum of the two bodies' body_invweight0[0], 1/kg; mj_setConst knows it, the world's is 0.
        impratio: The model's.

    Raises:
        PlannerError: A number that cannot be.
    """
    law = ContactLaw.exact(stiffness, damping, slip_damping, friction, impratio)
    per = number("invweight", invweight, greater_than=0.0) * (1.0 - SOFT)
    mu = law.friction
    if mu == 0.0 or law.slip_damping == 0.0:
        return {"condim": "1", **_direct(law, per, "")}
    slip = law.slip_damping / law.impratio
    rubs = {"condim": "3", "friction": _text(mu, mu, 0.005, 0.0001, 0.0001)}
    return {**rubs, **_direct(law, per, ""), "solreffriction": _text(-law.stiffness * per, -slip * per)}


def law_attributes(law: ContactLaw, invweight: float, impratio: float = 1000.0) -> dict[str, str]:
    """The attributes of a <pair> in which MuJoCo computes a law; see contact_attributes.

    Of a law with a lead the option's cone and impratio are the law's, which file_law reads again from these numbers.

    Raises:
        PlannerError: A law with a lead whose impedance rises, or is none of MuJoCo's.
    """
    if law.lead == 0.0:
        return contact_attributes(law.stiffness, law.damping, law.slip_damping, law.friction, invweight, impratio)
    if law.impedance[0] != law.impedance[1]:
        raise PlannerError(f"impedance is {law.impedance}, expected a constant one of a law with a lead that is given.")
    mu, pyramidal = law.friction, law.cone == "pyramidal" and law.friction > 0.0
    per = number("invweight", invweight, greater_than=0.0)
    per *= edge_weight(mu, law.impratio if math.isfinite(law.impratio) else impratio) / law.edges if pyramidal else 1.0
    share = per * law.damping * law.lead  # d/(1 - d)
    d = share / (1.0 + share)
    if not MIN_IMPEDANCE <= d <= MAX_IMPEDANCE:
        raise PlannerError(f"damping * lead is {law.damping * law.lead:g} kg, which MuJoCo has no impedance for.")
    solref = _text(-law.stiffness / law.damping / law.lead * d, -d / law.lead)
    spinning, rolling = max(law.spinning, MIN_FRICTION), max(law.rolling, MIN_FRICTION)
    rubs = {"friction": _text(mu, mu, spinning, rolling, rolling)} if mu > 0.0 else {}
    return {"condim": str(law.condim), **rubs, "solref": solref, "solimp": _text(d, d, 1.0, 0.5, 2.0)}


def stop_attributes(stiffness: float, damping: float, invweight: float) -> dict[str, str]:
    """The attributes of a <joint> with a range at whose ends MuJoCo computes a spring and damper.

    Args:
        stiffness: N m/rad or N/m.
        damping: N m s/rad or N s/m.
        invweight: The joint's dof_invweight0.

    Raises:
        PlannerError: A number that cannot be.
    """
    per = number("invweight", invweight, greater_than=0.0) * (1.0 - SOFT)
    return {"limited": "true", **_direct(Law(stiffness, damping), per, "limit")}


def _direct(law: Law, per: float, of: str) -> dict[str, str]:
    solref = _text(-law.stiffness * per, -law.damping * per)
    return {f"solref{of}": solref, f"solimp{of}": _text(SOFT, SOFT, 1.0, 0.5, 2.0)}


def _text(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)


def shapes_fit(survey: ModelIndex, pair: Pair) -> bool:
    """Whether the shapes of a pair are modelled, whatever their force."""
    return bool(plane_and_spheres(survey, pair.geoms)) or are_capsules(survey.model, pair.geoms)


def is_modelled(survey: ModelIndex, pair: Pair) -> bool:
    """Whether the plan computes a pair's contact with the law that the file gives it."""
    return not _reason(survey, pair)


def _reason(survey: ModelIndex, pair: Pair) -> str:
    """The reason why a pair is not modelled; "" where it is."""
    model = survey.model
    if shapes_fit(survey, pair):
        return _law_reason(model, pair)
    kinds = load_mujoco().mjtGeom
    shapes = [kinds(int(model.geom_type[g])).name.removeprefix("mjGEOM_").lower() for g in pair.geoms]
    moving = "" if any(model.body_weldid[model.geom_bodyid[g]] == 0 for g in pair.geoms) else " that both move"
    expected = "a plane or box at rest and a sphere, capsule or box, or two spheres or capsules"
    return f"{shapes[0]} and {shapes[1]}{moving}, expected {expected}"


def _law_reason(model: Any, pair: Pair) -> str:
    """The reason why MuJoCo's force is not a law of ours; "" where it is."""
    if has_file_laws(model):
        return file_law_reason(model, pair)
    if pair.condim not in (1, 3):
        return f"condim {pair.condim}, expected 1 or 3"
    if force_begins(model, pair) < 0.0:
        return f"margin {pair.margin:g}, expected at least 0"
    reason = direct_reason(pair.solref, pair.solimp)
    if reason or pair.condim == 1:
        return reason
    if pair.friction[0] != pair.friction[1]:
        return "other friction along than across, expected one number"
    if model.opt.cone != int(load_mujoco().mjtCone.mjCONE_ELLIPTIC):
        return "a pyramidal cone, expected cone='elliptic'"
    if np.any(pair.solreffriction) and not np.all(pair.solreffriction <= 0.0):
        return "solreffriction is a time constant, expected the direct format"
    ramp = smoothing_of(model, CONTACT_RAMP)[0]
    if ramp > 0.0 and model.opt.impratio < MIN_IMPRATIO:
        return f"impratio {model.opt.impratio:g}, expected at least {MIN_IMPRATIO:g} for smoothed friction"
    return ""


def direct_reason(solref: np.ndarray, solimp: np.ndarray) -> str:
    """The reason why these numbers do not make a plain spring and damper; "" where they do."""
    if not (solref[0] < 0.0 and solref[1] <= 0.0):
        return "solref is a time constant, expected the direct format of contact_attributes()"
    if not (solimp[0] == solimp[1] <= SOFTEST):
        return f"solimp {solimp[0]:g} {solimp[1]:g}, expected one impedance of at most {SOFTEST:g}"
    return ""


def contact_refusals(survey: ModelIndex, all_of_them: bool = False) -> Iterator[UnsupportedElement]:
    """The contacts that are not modelled, or all of them, in one phrase."""
    reasons = {pair.geoms: "" if all_of_them else _reason(survey, pair) for pair in survey.pairs}
    wrong = [pair for pair in survey.pairs if all_of_them or reasons[pair.geoms]]
    if wrong:
        why = "" if all_of_them else f" ({reasons[wrong[0].geoms]})"
        yield UnsupportedElement("contacts", f"{phrase_of(survey.model, wrong)}{why}")


def phrase_of(model: Any, pairs: Sequence[Pair]) -> str:
    """Contacts in a phrase: the name of the first and the number of the others."""
    first = " and ".join(named(model, "geom", i) for i in pairs[0].geoms)
    return f"contacts of {first}" + ("" if len(pairs) == 1 else f" and {len(pairs) - 1} more pairs")


def read_contacts(survey: ModelIndex) -> tuple[tuple[Contact, ...], tuple[BodyContact, ...]]:
    """The contacts of a model with planes, and of spheres and capsules with each other, that are modelled."""
    model, links = survey.model, survey.carriers[0]
    with_planes, of_bodies = [], []
    for pair in survey.pairs:
        if _reason(survey, pair):
            continue
        law = _law_of(model, pair)
        match = plane_and_spheres(survey, pair.geoms)
        if match is None:
            name = " and ".join(named(model, "geom", geom) for geom in pair.geoms)
            first, second = (capsule_of(survey, geom) for geom in pair.geoms)
            of_bodies.append(BodyContact(first, second, law, name))
            continue
        plane, spheres = match
        for k, sphere in enumerate(spheres):
            name = part_name(named(model, "geom", sphere.geom), spheres, k)
            centre = (survey.geoms[sphere.geom] @ np.append(sphere.centre, 1.0))[:3]
            link = int(links[model.geom_bodyid[sphere.geom]])
            with_planes.append(Contact(link, centre, sphere.radius, plane, law, name))
    return tuple(with_planes), tuple(of_bodies)


def has_file_laws(model: Any) -> bool:
    """Whether a file asks for the law with a lead that MuJoCo computes from its numbers."""
    return OF_FILE in texts_of(model, CONTACT_LAW)


def _law_of(model: Any, pair: Pair) -> ContactLaw:
    law = file_law(model, pair) if has_file_laws(model) else _exact_law(model, pair)
    ramp, force_ramp, bend = smoothing_of(model, CONTACT_RAMP)
    uncertainty, *_ = _numbers(model, CONTACT_UNCERTAINTY) or [1.0]
    if not 1.0 <= uncertainty < math.inf:
        raise ModelError(f"numeric {CONTACT_UNCERTAINTY!r} is {uncertainty:g}, expected a factor of at least 1.")
    if ramp == 0.0:
        return replace(law, uncertainty=uncertainty)
    impratio = law.impratio if law.lead > 0.0 else math.inf
    return replace(law, ramp=ramp, force_ramp=force_ramp, bend=bend, impratio=impratio, uncertainty=uncertainty)


def _exact_law(model: Any, pair: Pair) -> ContactLaw:
    """The law of a pair whose impedance is next to nothing."""
    weight = float(np.sum(model.body_invweight0[model.geom_bodyid[list(pair.geoms)], 0])) * (1.0 - pair.solimp[0])
    K, B = -pair.solref / weight
    impratio = float(model.opt.impratio)
    slips = -pair.solreffriction[1] / weight if np.any(pair.solreffriction) else B
    mu, ct = (float(pair.friction[0]), impratio * slips) if pair.condim == 3 else (0.0, 0.0)
    return replace(ContactLaw.exact(K, B, ct, mu, impratio), margin=force_begins(model, pair))


def smoothing_of(model: Any, name: str) -> tuple[float, float | None, float]:
    """Read the smoothing from the file's <numeric> of that name: ramp, force ramp (None by default) and bend."""
    data = _numbers(model, name)
    if data is None:
        return 0.0, 0.0, BEND
    most, more = (3, ", and a bend within 0 to 1") if name == CONTACT_RAMP else (2, "")
    if not (1 <= len(data) <= most and all(0.0 <= x < math.inf for x in data) and max(data[2:], default=0.0) <= 1.0):
        raise ModelError(f"numeric {name!r} is {data}, expected a length and perhaps a force, of at least 0{more}.")
    return data[0], data[1] if len(data) > 1 else None, data[2] if len(data) > 2 else BEND


def _numbers(model: Any, name: str) -> list[float] | None:
    """The numbers of the file's <numeric> of that name; None where it has none."""
    mujoco = load_mujoco()
    k = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if k < 0:
        return None
    start = int(model.numeric_adr[k])
    return [float(x) for x in model.numeric_data[start : start + int(model.numeric_size[k])]]
