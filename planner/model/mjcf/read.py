"""Mechanism.from_mjcf: convert the model that MuJoCo's compiler makes of a file to links and screws.

MuJoCo moves the frame of a body joint by joint, every joint being given in that frame: so the links of a body with
several joints all have its frame, and only the first is displaced from the link that carries it. What is welded to a
link is part of it.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.arguments import choice, first_of, short_repr
from planner.base.errors import ModelError, PlannerError
from planner.base.gl import load_mujoco
from planner.model.capabilities import rolling_radii
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import BALL, BALL_NEXT, SCREW, Frame, Mechanism
from planner.model.mjcf.contact_edits import give_law, keep_time_constants, let_float, read_stops
from planner.model.mjcf.contact_mode import (
    MODES,
    STANDING,
    ContactMode,
    file_pairs,
    ground_pairs,
    select_contact_mode,
    stationary_roots,
)
from planner.model.mjcf.contacts import CONTACT_RAMP, CONTACT_UNCERTAINTY, contact_refusals, phrase_of, read_contacts
from planner.model.mjcf.equalities import harden, read_cams, read_couplings, read_loops, read_tendons
from planner.model.mjcf.file_law import FILE_SMOOTHING, file_law
from planner.model.mjcf.ground_law import UNCERTAINTY, laws_of_ground
from planner.model.mjcf.joint_forces import actuators_of, armature_and_damping, joint_friction
from planner.model.mjcf.model_file import ModelFile, mjcf_source, open_model_file
from planner.model.mjcf.model_index import (
    EDITED,
    LEFT_OUT,
    ModelIndex,
    Pair,
    compile_model,
    disabled,
    field,
    gravity_of,
    names_of,
    pose,
    ranges_of,
    texts_of,
    velocity_limits,
)
from planner.model.mjcf.obstacles import edits_of
from planner.model.mjcf.text import written
from planner.model.mjcf.unsupported import (  # fmt: skip
    KINDS,
    UnsupportedElement,
    modelled,
    no_compensation,
    passive_off,
    take_out,
    unsupported_elements,
)
from planner.model.passive_forces import drags_of
from planner.model.space import unit
from planner.model.twin import origin_of

MAX_PHRASES = 30  # in one sentence
MAX_DOFS = 1000  # gains of a stage have as many rows as columns, and a plan has hundreds of stages
LARGEST = 1e15
"""Of the compiled numbers that a plan computes with, in SI units: their products must not overflow."""
_NUMBERS = (
    "qpos0", "qpos_spring", "body_pos", "body_ipos", "body_mass", "body_inertia", "jnt_pos", "jnt_stiffness",
    "dof_armature", "dof_damping", "actuator_gear", "actuator_gainprm", "actuator_biasprm", "geom_pos", "site_pos",
    "key_qpos", "key_qvel", "key_act", "wrap_prm", "dof_frictionloss", "body_gravcomp", "tendon_stiffness",
    "tendon_damping",
)  # fmt: skip


def read(
    model: Any, *, ignore: Collection[str] | None = (), contacts: str | ContactLaw = "auto",
    assets: dict[str, bytes] | None = None, name: str = "", attach: Any = None, obstacles: Any = None,
    exclude: Any = None,
) -> Mechanism:  # fmt: skip
    """A mechanism of an MJCF file, text or spec, and of the files that it names; see Mechanism.from_mjcf.

    With `assets` nothing is read from disk. Messages call the model `name`, by default after its file.
    """
    edited = edits_of(attach, obstacles, exclude)
    model, assets = mjcf_source(model, assets)
    mechanism = read_opened(lambda: edited(open_model_file(model, assets, name)), ignore=ignore, contacts=contacts)
    return mechanism if assets is not None else replace(mechanism, origin=origin_of(model, attach, obstacles, exclude))


def read_opened(
    file: Callable[[], ModelFile], *, ignore: Collection[str] | None = (), contacts: str | ContactLaw = "auto"
) -> Mechanism:
    """A mechanism of a file that is opened once the other arguments are checked, or that was opened before."""
    if not isinstance(ignore, Collection | None):
        raise PlannerError(f"ignore is {short_repr(ignore)}, expected some of: {', '.join(KINDS)}.")
    ignored = (ignore,) if isinstance(ignore, str) else tuple(ignore or ())
    for kind in ignored:
        choice("ignore", kind, KINDS)
    law = contacts if isinstance(contacts, ContactLaw) else None
    asked = "law" if law is not None else choice("contacts", _renamed(contacts), MODES)
    given, files, survey, name, is_compiled, payloads = file()
    root = copy.deepcopy(given)
    original = ElementTree.tostring(root, encoding="unicode")
    if payloads:  # they touch in the user's file alone
        for geom in root.iter("geom"):
            if geom.get("name") in payloads:
                geom.attrib.update(contype="0", conaffinity="0")
        survey = ModelIndex(compile_model(root, files, name))
    mode, phrase = ContactMode(asked) if asked in ("law", "off") else select_contact_mode(survey, asked)
    if asked in STANDING and mode != asked:
        meets = "falls on a plane or box" if asked == "ground" else "meets a plane, or the top of a box, that rests"
        words = f"contacts is {asked!r}, but nothing in {name} {meets}"
        raise ModelError(f'{words}: write contacts = "avoid".')
    found = [*unsupported_elements(survey.model), *contact_refusals(survey, all_of_them=mode in ("off", "avoid"))]
    unmatched: list[Pair] = []
    kept = stationary_roots(survey, mode) if mode in ("avoid", *STANDING) else []
    if mode in ("law", *STANDING):
        found = [one for one in found if one.kind != "contacts"]
        laws = _file_laws(survey) if mode == "file" else _laws(survey, law)
        unmatched = give_law(root, survey, *laws, own=mode == "file")
    taken_out = {*ignored, *(["contacts"] if mode != "model" else [])}
    _refuse([one for one in found if one.kind not in taken_out], name, survey)
    found += [one for one in modelled(survey.model) if one.kind in taken_out]
    if found:
        take_out(root, found, survey.model)
    if kept:
        let_float(root, survey.model, kept)
    phrases = ["contacts" if refusal.kind == "contacts" else refusal.phrase for refusal in found]
    phrases += [f"contacts of {payload}" for payload in payloads]
    if unmatched:
        phrases.append(phrase_of(survey.model, unmatched))
    if found or unmatched or kept or payloads:
        _mark_edited(root, phrases)
    if not is_compiled or ElementTree.tostring(root, encoding="unicode") != original:
        # Compiled once for coarser meshes and edits together, which may not do what they meant.
        survey = ModelIndex(compile_model(root, files, name))
        _refuse([*unsupported_elements(survey.model), *contact_refusals(survey)], name, survey)
    harden(root, survey.model)
    keep_time_constants(root, survey.model, read_stops(survey.model, _undriven(survey.model, actuators_of(survey))))
    text = ElementTree.tostring(root, encoding="unicode")
    mechanism = _mechanism(survey, text, files, (*texts_of(survey.model, LEFT_OUT), *phrases), name)
    if asked == "auto" and mode == "file" and np.any(rolling_radii(mechanism)):  # see contact_mode
        return read_opened(file, ignore=ignore, contacts="ground")
    mechanism = replace(mechanism, contacts_mode=mode, contacts_choice=phrase)
    return mechanism if text == original else replace(mechanism, original=original)


def _mark_edited(root: ElementTree.Element, phrases: list[str]) -> None:
    """Say in a text what was taken out of it, since its original may get lost."""
    mark = root.find(f"custom/text[@name='{EDITED}']")
    if mark is None:
        mark = ElementTree.SubElement(ElementTree.SubElement(root, "custom"), "text", {"name": EDITED, "data": ""})
    known = list(filter(None, mark.get("data", "").split("; ")))
    mark.set("data", "; ".join(dict.fromkeys([*known, *phrases])) or "contacts")


def _renamed(contacts: object) -> object:
    if contacts == "on":
        raise PlannerError("contacts is 'on', expected one of: " + ", ".join(MODES) + ". Did you mean 'model'?")
    return contacts


def _laws(
    survey: ModelIndex, law: ContactLaw | None
) -> tuple[Callable[[Pair], ContactLaw | None], dict[str, str], dict[tuple[int, int], float] | None]:
    """The law of each pair, that of the ground by default, the numbers they share and their recesses, for give_law."""
    if law is not None:
        smoothing = f"{law.ramp!r} {law.force_ramp!r} {law.bend!r}"
        return (lambda _: law), {CONTACT_RAMP: smoothing, CONTACT_UNCERTAINTY: repr(law.uncertainty)}, None
    grounds = laws_of_ground(survey, ground_pairs(survey))
    recesses = {geoms: ground.contact_offset for geoms, ground in grounds.items()}
    laws = {geoms: ground.law for geoms, ground in grounds.items()}
    one = next(iter(laws.values()))
    numbers = {CONTACT_RAMP: repr(one.ramp), CONTACT_UNCERTAINTY: repr(one.uncertainty)}
    return (lambda pair: laws.get(pair.geoms)), numbers, recesses


def _file_laws(survey: ModelIndex) -> tuple[Callable[[Pair], ContactLaw | None], dict[str, str], None]:
    """The file's own law of each pair with a plane, and the smoothing that they share, for give_law."""
    laws = {pair.geoms: file_law(survey.model, pair) for pair in file_pairs(survey)}
    numbers = {CONTACT_RAMP: written(*FILE_SMOOTHING), CONTACT_UNCERTAINTY: repr(UNCERTAINTY)}
    return (lambda pair: laws.get(pair.geoms)), numbers, None


def _refuse(found: list[UnsupportedElement], name: str, survey: ModelIndex) -> None:
    """Raise ModelError for what is not modelled, with the keys that load the model."""
    if not found:
        return
    kinds = dict.fromkeys(refusal.kind for refusal in found)
    options = [f'"{kind}"' for kind in kinds if kind in KINDS]
    ways = [f"ignore = [{', '.join(options)}]"] if options else []
    ways += [f'contacts = "{select_contact_mode(survey).mode}"'] if "contacts" in kinds else []
    firm = [kind for kind in kinds if kind not in KINDS and kind != "contacts"]
    what = first_of([refusal.phrase for refusal in found], MAX_PHRASES)
    if firm:
        advice = f"nothing takes a {' or '.join(firm)} out"
        raise ModelError(f"{name} has what changes its motion and is not modelled: {what}; {advice}.")
    driving = sum(refusal.kind == "actuator" and not refusal.feature for refusal in found)
    left = ""
    if 0 < driving == survey.model.nu:
        left = " That leaves no actuator: put motors or servos on joints or fixed tendons, or prescribe accelerations."
    raise ModelError(
        f"{name} has what changes its motion and is not modelled: {what}; {' and '.join(ways)} loads it without.{left}"
    )


def mechanism_of_model(model: Any) -> Mechanism:
    """Convert an MjModel to a Mechanism and ignore unsupported elements; `mjcf` stays empty."""
    return _mechanism(ModelIndex(model), "", {}, (), "the model")


def _mechanism(
    survey: ModelIndex, text: str, files: dict[str, bytes], ignored: tuple[str, ...], name: str
) -> Mechanism:
    model = survey.model
    if model.nv == 0:
        raise ModelError(f"{name} has no joints, expected at least one.")
    _check_sizes(model, name)
    links, poses = survey.carriers
    screws = _screws(model)
    parent = np.array(model.dof_parentid, dtype=np.int64)
    kind = screws["kind"]
    T_home = np.tile(np.eye(4), (model.nv, 1, 1))
    for body in np.flatnonzero(model.body_dofnum):
        first = model.body_dofadr[body]
        if model.jnt_type[model.body_jntadr[body]] != load_mujoco().mjtJoint.mjJNT_FREE:  # where qpos says it is
            T_home[first] = poses[model.body_parentid[body]] @ pose(model.body_pos[body], model.body_quat[body])
    base = parent.copy()
    for i in np.flatnonzero(kind == BALL_NEXT):
        base[i] = base[i - 1]
    balls = np.flatnonzero(kind == BALL)
    springs = not disabled(model, "spring", "passive")
    stiffness = model.jnt_stiffness[model.dof_jntid] * springs
    rest = np.where(kind == SCREW, model.qpos_spring[screws["q_address"]], 0.0)
    armature, damping = armature_and_damping(model)
    dofs = [int(address) for address in model.jnt_dofadr] + [int(model.nv)]
    contacts, body_contacts = read_contacts(survey)
    actuators = actuators_of(survey)
    sites = {
        site: Frame(int(links[body]), poses[body] @ pose(model.site_pos[i], model.site_quat[i]))
        for i, (site, body) in enumerate(zip(names_of(model, "site", model.nsite), model.site_bodyid, strict=True))
        if site
    }
    states = np.concatenate([model.key_qpos, model.key_qvel, model.key_act], axis=1)
    keyframes = {key: state for key, state in zip(names_of(model, "key", model.nkey), states, strict=True) if key}
    return Mechanism(
        nq=int(model.nq), parent=parent, base=base, **screws, T_home=T_home, qpos0=np.array(model.qpos0),
        **_masses(model, links, poses), armature=armature, damping=damping,
        stiffness=np.where(kind == SCREW, stiffness, 0.0), spring_rest=rest, ball_stiffness=stiffness[balls],
        ball_rest=unit(np.array([model.qpos_spring[a : a + 4] for a in screws["q_address"][balls]]).reshape(-1, 4)),
        gravity=gravity_of(model), actuators=actuators,
        joint_names=names_of(model, "joint", model.njnt), joint_range=_joint_ranges(model),
        joint_links=tuple(slice(a, b) for a, b in itertools.pairwise(dofs)),
        joint_force_range=ranges_of(model.jnt_actfrclimited, model.jnt_actfrcrange)[model.dof_jntid],
        velocity_limit=velocity_limits(model), **joint_friction(model), **_lifted(model, links, poses),
        body_names=("world", *names_of(model, "body", model.nbody)[1:]),
        bodies=tuple(Frame(int(link), T) for link, T in zip(links, poses, strict=True)),
        contacts=contacts, body_contacts=body_contacts, tendons=read_tendons(model),
        stops=read_stops(model, _undriven(model, actuators)), sites=sites, keyframes=keyframes,
        mjcf=text, assets=files, ignored=ignored, couplings=read_couplings(model),
        drags=() if passive_off(model) else drags_of(model, links, _inertial_frames(model, poses)),
        loops=read_loops(model, links, poses), polynomial_couplings=read_cams(model),
    )  # fmt: skip


def _undriven(model: Any, actuators: Any) -> set[int]:
    """The degrees of freedom that neither an actuator moves nor an equality of joints ties to another."""
    tied = {dof for coupling in read_couplings(model) for dof in coupling.dofs}
    tied |= {dof for cam in read_cams(model) for dof in cam.dofs}
    return set(range(model.nv)) - tied - {*map(int, np.flatnonzero(actuators.acts_on.any(axis=0)))}


def _check_sizes(model: Any, name: str) -> None:
    """Raise ModelError for more degrees of freedom or larger numbers than the plan's arithmetic has room for."""
    if model.nv > MAX_DOFS:
        raise ModelError(f"{name} has {model.nv} degrees of freedom, expected at most {MAX_DOFS}.")
    for field_name in _NUMBERS:
        values = np.abs(field(model, field_name, 0))
        if not np.all(values <= LARGEST):
            largest = values[~(values <= LARGEST)][0]
            raise ModelError(f"{name} has {largest:g} in {field_name}, expected numbers of at most {LARGEST:g}.")
    if not np.all(np.abs(model.opt.gravity) <= LARGEST):
        raise ModelError(f"the gravity of {name} is {model.opt.gravity}, expected numbers of at most {LARGEST:g}.")


def _screws(model: Any) -> dict[str, Any]:
    """kind, q_address, q_home and S of every degree of freedom."""
    joints = load_mujoco().mjtJoint
    kind, address = np.full(model.nv, SCREW, dtype=np.int64), np.zeros(model.nv, dtype=np.int64)
    S, home = np.zeros((model.nv, 6)), np.zeros(model.nv)
    for joint in range(model.njnt):
        i, a = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
        anchor, axis = model.jnt_pos[joint], model.jnt_axis[joint]
        if model.jnt_type[joint] == joints.mjJNT_HINGE:
            S[i, :3], S[i, 3:] = axis, np.cross(anchor, axis)
        elif model.jnt_type[joint] == joints.mjJNT_SLIDE:
            S[i, 3:] = axis
        else:
            if model.jnt_type[joint] == joints.mjJNT_FREE:
                S[i : i + 3, 3:], address[i : i + 3] = np.eye(3), [a, a + 1, a + 2]
                i, a, anchor = i + 3, a + 3, np.zeros(3)
            S[i : i + 3, :3], S[i : i + 3, 3:] = np.eye(3), np.cross(anchor, np.eye(3))
            kind[i : i + 3], address[i : i + 3] = [BALL, BALL_NEXT, BALL_NEXT], a
            continue
        address[i], home[i] = a, model.qpos0[a]
    return {"kind": kind, "q_address": address, "q_home": home, "S": S}


def _masses(model: Any, links: np.ndarray, poses: np.ndarray) -> dict[str, Any]:
    """Mass, centre and inertia of every link: its bodies together, by the parallel axis theorem."""
    mass, com, inertia = np.zeros(model.nv), np.zeros((model.nv, 3)), np.zeros((model.nv, 3, 3))
    frames = _inertial_frames(model, poses)
    for link in np.unique(links[links >= 0]):
        bodies = np.flatnonzero(links == link)
        m, centres = model.body_mass[bodies], frames[bodies, :3, 3]
        mass[link] = np.sum(m)
        if mass[link] > 0.0:
            com[link] = m @ centres / mass[link]
        for body, d in zip(bodies, centres - com[link], strict=True):
            R = frames[body, :3, :3]
            inertia[link] += R @ np.diag(model.body_inertia[body]) @ R.T
            inertia[link] += model.body_mass[body] * (d @ d * np.eye(3) - np.outer(d, d))
    return {"mass": mass, "com": com, "inertia": inertia}


def _inertial_frames(model: Any, poses: np.ndarray) -> np.ndarray:
    """(nbody, 4, 4) frames of the bodies' inertias in the frames of their links."""
    return poses @ np.array([pose(model.body_ipos[b], model.body_iquat[b]) for b in range(model.nbody)])


def _lifted(model: Any, links: np.ndarray, poses: np.ndarray) -> dict[str, Any]:
    """The mass of every link that gravity compensation carries, and its first moment."""
    mass, moment = np.zeros(model.nv), np.zeros((model.nv, 3))
    for body in () if no_compensation(model) else np.flatnonzero((model.body_gravcomp != 0.0) & (links >= 0)):
        share = model.body_gravcomp[body] * model.body_mass[body]
        mass[links[body]] += share
        moment[links[body]] += share * (poses[body] @ np.append(model.body_ipos[body], 1.0))[:3]
    return {"gravcomp_mass": mass, "gravcomp_first_moment": moment}


def _joint_ranges(model: Any) -> np.ndarray:
    """(nv, 2) of hinges and slides; the first of a ball has that of its angle. A stop acts from its margin on."""
    limited = model.jnt_limited * (not disabled(model, "constraint", "limit"))
    half = 0.5 * np.ptp(model.jnt_range, axis=1)
    margin = np.minimum(model.jnt_margin, np.where(half > 0.0, half, np.inf))
    ranges = ranges_of(limited, model.jnt_range + margin[:, None] * np.array([1.0, -1.0]))
    result = np.tile([-np.inf, np.inf], (model.nv, 1))
    result[model.jnt_dofadr] = ranges
    return result
