"""Contacts and joint stops of an MJCF: those in which MuJoCo computes the law of model.contact.laws are read as that.

MuJoCo's constraints tend to plain springs and dampers when their impedance d is next to nothing (solimp="1e-4 1e-4"):
then R >> A in its problem, and with solref in the direct format and A the constant invweight0 of the two bodies

    solref = (-K A (1-d), -B A (1-d)),   solreffriction = (-K A (1-d), -c_t A (1-d) / impratio)

are the K, B and c_t of a force K e - B v_n with friction c_t v_t, cut off at mu f_n (elliptic cone, ContactLaw.exact).
`contact_attributes` and `stop_attributes` write them. How much of it is smoothed for planning is no part of
MuJoCo's model, so the file says it in numbers of its own:

    <custom><numeric name="contact_ramp" data="0.002 1 0.5"/> <numeric name="stop_ramp" data="0.03"/></custom>

a ramp in m (stops: of their joint's coordinate), one of the force, and how gradually friction bends; the last two may
be left out, and without any there is no smoothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import number
from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.contact.between_bodies import BodyContact
from planner.model.contact.laws import BEND, Contact, ContactLaw, Law, Stop
from planner.model.contact.shapes import are_capsules, at_home, capsule_of, part_name, plane_and_spheres
from planner.model.mjcf.refuse import Refusal, contact_pairs, disabled, named

SOFT = 1e-4  # the impedance d, the least that MuJoCo knows
SOFTEST = 1e-3  # up to here R is still a thousand times A, and the forces differ by less than a percent
LEAST_IMPRATIO = 100.0  # of smoothed friction, which knows no projection
CONTACT_RAMP, STOP_RAMP = "contact_ramp", "stop_ramp"


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
    touch = ContactLaw.exact(stiffness, damping, slip_damping, friction, impratio)
    per = number("invweight", invweight, above=0.0) * (1.0 - SOFT)
    mu = touch.friction
    if mu == 0.0 or touch.slip_damping == 0.0:
        return {"condim": "1", **_direct(touch, per, "")}
    slip = touch.slip_damping / touch.impratio
    return {
        "condim": "3",
        "friction": _text(mu, mu, 0.005, 0.0001, 0.0001),
        **_direct(touch, per, ""),
        "solreffriction": _text(-touch.stiffness * per, -slip * per),
    }


def stop_attributes(stiffness: float, damping: float, invweight: float) -> dict[str, str]:
    """The attributes of a <joint> with a range at whose ends MuJoCo computes a spring and damper.

    Args:
        stiffness: N m/rad or N/m.
        damping: N m s/rad or N s/m.
        invweight: The joint's dof_invweight0.

    Raises:
        PlannerError: A number that cannot be.
    """
    per = number("invweight", invweight, above=0.0) * (1.0 - SOFT)
    return {"limited": "true", **_direct(Law(stiffness, damping), per, "limit")}


def _direct(law: Law, per: float, of: str) -> dict[str, str]:
    solref = _text(-law.stiffness * per, -law.damping * per)
    return {f"solref{of}": solref, f"solimp{of}": _text(SOFT, SOFT, 1.0, 0.5, 2.0)}


def _text(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)


class Pair(NamedTuple):
    """Two geoms that may touch, and how, as MuJoCo's compiler has it."""

    geoms: tuple[int, int]
    condim: int
    friction: np.ndarray  # (5,)
    solref: np.ndarray  # (2,)
    solreffriction: np.ndarray  # (2,) zeros where it is solref's
    solimp: np.ndarray  # (5,)
    margin: float


def pairs(model: Any) -> list[Pair]:
    """Every pair that MuJoCo would test, with its parameters: those of <pair>, or both geoms' combined."""
    explicit = {}
    for k in range(model.npair):
        geoms = (int(model.pair_geom1[k]), int(model.pair_geom2[k]))
        explicit[frozenset(geoms)] = Pair(
            geoms, int(model.pair_dim[k]), model.pair_friction[k], model.pair_solref[k], model.pair_solreffriction[k],
            model.pair_solimp[k], float(model.pair_margin[k] + model.pair_gap[k]),
        )  # fmt: skip
    return [explicit.get(frozenset(geoms)) or _combined(model, *geoms) for geoms in contact_pairs(model)]


def _combined(model: Any, first: int, second: int) -> Pair:
    """MuJoCo's mj_contactParam."""
    a, b = first, second
    margin = float(max(model.geom_margin[a], model.geom_margin[b]) + max(model.geom_gap[a], model.geom_gap[b]))
    higher = np.sign(int(model.geom_priority[a]) - int(model.geom_priority[b]))
    mix = {1: 1.0, -1: 0.0}.get(int(higher), _mix(float(model.geom_solmix[a]), float(model.geom_solmix[b])))
    solref = mix * model.geom_solref[a] + (1.0 - mix) * model.geom_solref[b]
    condim, friction = max(model.geom_condim[a], model.geom_condim[b]), np.maximum(*model.geom_friction[[a, b]])
    if higher:
        one = a if higher > 0 else b
        condim, friction = model.geom_condim[one], model.geom_friction[one]
    elif np.any(model.geom_solref[[a, b], 0] <= 0.0):  # of direct formats the lesser numbers
        solref = np.minimum(*model.geom_solref[[a, b]])
    solimp = mix * model.geom_solimp[a] + (1.0 - mix) * model.geom_solimp[b]
    return Pair((a, b), int(condim), friction[[0, 0, 1, 2, 2]], solref, np.zeros(2), solimp, margin)


def _mix(a: float, b: float) -> float:
    return a / (a + b) if a + b > 0.0 else 0.5


def shapes_fit(model: Any, home: Any, pair: Pair) -> bool:
    """Whether the shapes of a pair are modelled, whatever their force."""
    return bool(plane_and_spheres(model, home, pair.geoms)) or are_capsules(model, pair.geoms)


def _reason(model: Any, home: Any, pair: Pair) -> str:
    """Why a pair is not modelled; "" where it is."""
    if shapes_fit(model, home, pair):
        return _law_reason(model, pair)
    kinds = load_mujoco().mjtGeom
    shapes = [kinds(int(model.geom_type[g])).name.removeprefix("mjGEOM_").lower() for g in pair.geoms]
    moving = "" if any(model.body_weldid[model.geom_bodyid[g]] == 0 for g in pair.geoms) else " that both move"
    expected = "a plane or box at rest and a sphere, capsule or box, or two spheres or capsules"
    return f"{shapes[0]} and {shapes[1]}{moving}, expected {expected}"


def _law_reason(model: Any, pair: Pair) -> str:
    """Why MuJoCo's force is not a law of ours; "" where it is."""
    if pair.condim not in (1, 3):
        return f"condim {pair.condim}, expected 1 or 3"
    if pair.margin != 0.0:
        return f"margin {pair.margin:g}, expected 0"
    reason = _direct_reason(pair.solref, pair.solimp)
    if reason or pair.condim == 1:
        return reason
    if pair.friction[0] != pair.friction[1]:
        return "other friction along than across, expected one number"
    if model.opt.cone != int(load_mujoco().mjtCone.mjCONE_ELLIPTIC):
        return "a pyramidal cone, expected cone='elliptic'"
    if np.any(pair.solreffriction) and not np.all(pair.solreffriction <= 0.0):
        return "solreffriction is a time constant, expected the direct format"
    ramp = _smoothing(model, CONTACT_RAMP)[0]
    if ramp > 0.0 and model.opt.impratio < LEAST_IMPRATIO:
        return f"impratio {model.opt.impratio:g}, expected at least {LEAST_IMPRATIO:g} for smoothed friction"
    return ""


def _direct_reason(solref: np.ndarray, solimp: np.ndarray) -> str:
    if not (solref[0] < 0.0 and solref[1] <= 0.0):
        return "solref is a time constant, expected the direct format of contact_attributes()"
    if not (solimp[0] == solimp[1] <= SOFTEST):
        return f"solimp {solimp[0]:g} {solimp[1]:g}, expected one impedance of at most {SOFTEST:g}"
    return ""


def contact_refusals(model: Any) -> Iterator[Refusal]:
    """The contacts that are not modelled, in one phrase."""
    home = at_home(model)
    wrong = [(pair, reason) for pair in pairs(model) if (reason := _reason(model, home, pair))]
    if wrong:
        first = " and ".join(named(model, "geom", i) for i in wrong[0][0].geoms)
        more = "" if len(wrong) == 1 else f" and {len(wrong) - 1} more pairs"
        yield Refusal("contacts", f"contacts of {first}{more} ({wrong[0][1]})")


def read_contacts(model: Any, links: np.ndarray, geoms: np.ndarray) -> tuple[Contact, ...]:
    """The contacts of a model with planes but for those that are not modelled.

    Args:
        model: Compiled.
        links: (nbody,) of each body, -1 for the world.
        geoms: (ngeom, 4, 4) the geoms' poses in those links.
    """
    found, home = [], at_home(model)
    for pair in pairs(model):
        match = plane_and_spheres(model, home, pair.geoms)
        if match is None or _law_reason(model, pair):
            continue
        plane, spheres = match
        touch = _touch(model, pair)
        for number_, sphere in enumerate(spheres):
            name = part_name(named(model, "geom", sphere.geom), spheres, number_)
            centre = (geoms[sphere.geom] @ np.append(sphere.centre, 1.0))[:3]
            link = int(links[model.geom_bodyid[sphere.geom]])
            found.append(Contact(link, centre, sphere.radius, plane, touch, name))
    return tuple(found)


def read_body_contacts(model: Any, links: np.ndarray, geoms: np.ndarray) -> tuple[BodyContact, ...]:
    """The contacts of spheres and capsules of a model with each other, with the arguments of read_contacts."""
    found, home = [], at_home(model)
    for pair in pairs(model):
        if plane_and_spheres(model, home, pair.geoms) or _reason(model, home, pair):
            continue
        first, second = (capsule_of(model, geom, links, geoms) for geom in pair.geoms)
        name = " and ".join(named(model, "geom", geom) for geom in pair.geoms)
        found.append(BodyContact(first, second, _touch(model, pair), name))
    return tuple(found)


def _touch(model: Any, pair: Pair) -> ContactLaw:
    weight = float(np.sum(model.body_invweight0[model.geom_bodyid[list(pair.geoms)], 0])) * (1.0 - pair.solimp[0])
    K, B = -pair.solref / weight
    impratio = float(model.opt.impratio)
    slips = -pair.solreffriction[1] / weight if np.any(pair.solreffriction) else B
    mu, ct = (float(pair.friction[0]), impratio * slips) if pair.condim == 3 else (0.0, 0.0)
    ramp, force_ramp, bend = _smoothing(model, CONTACT_RAMP)
    if ramp == 0.0:
        return ContactLaw.exact(K, B, ct, mu, impratio)
    return ContactLaw(K, B, ramp, force_ramp, ct, mu, bend=bend)


def read_stops(model: Any) -> tuple[Stop, ...]:
    """The ends of ranges at which MuJoCo computes the law; other limits push in no plan."""
    if disabled(model, "constraint", "limit"):
        return ()
    joints, found = load_mujoco().mjtJoint, []
    for j in np.flatnonzero(model.jnt_limited):
        screw = model.jnt_type[j] in (int(joints.mjJNT_HINGE), int(joints.mjJNT_SLIDE))
        solref, solimp = model.jnt_solref[j], model.jnt_solimp[j]
        if not screw or _direct_reason(solref, solimp) or model.jnt_margin[j] != 0.0:
            continue
        dof = int(model.jnt_dofadr[j])
        weight = float(model.dof_invweight0[dof]) * (1.0 - solimp[0])
        K, B = -solref / weight
        law = Law(K, B, *_smoothing(model, STOP_RAMP)[:2])
        found += [Stop(dof, float(end), side, law) for end, side in zip(model.jnt_range[j], (-1, 1), strict=True)]
    return tuple(found)


def _smoothing(model: Any, name: str) -> tuple[float, float | None, float]:
    """What the file's numeric of that name says: a ramp, one of the force or None, and of a contact its bend.

    Raises:
        ModelError: It is none of that.
    """
    mujoco = load_mujoco()
    k = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if k < 0:
        return 0.0, 0.0, BEND
    start = int(model.numeric_adr[k])
    data = [float(x) for x in model.numeric_data[start : start + int(model.numeric_size[k])]]
    most, more = (3, ", and a bend within 0 to 1") if name == CONTACT_RAMP else (2, "")
    if not (1 <= len(data) <= most and all(0.0 <= x < math.inf for x in data) and max(data[2:], default=0.0) <= 1.0):
        raise ModelError(f"numeric {name!r} is {data}, expected a length and perhaps a force, of at least 0{more}.")
    return data[0], data[1] if len(data) > 1 else None, data[2] if len(data) > 2 else BEND
