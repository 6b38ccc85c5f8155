"""Description of a user's model: its parts, the modelled and the omitted features, and likely errors.

Records are plain (dicts, lists, numbers, text), for a table or for JSON.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import first_of, toml_key
from planner.base.errors import ModelError
from planner.dynamics.joint_forces import actuator_forces, actuator_lengths
from planner.dynamics.kinematics import frame_pose
from planner.dynamics.quasi_static import quasi_static_controls
from planner.model.actuators import INTEGRATOR
from planner.model.couplings import contradiction, fixed_dofs
from planner.model.mechanism import Mechanism
from planner.model.mjcf.contact_mode import machine_roots
from planner.model.mjcf.facts import (
    Record,
    actuator_records,
    body_records,
    free_bases,
    has_ground,
    has_moving_base,
    joint_records,
    moving_mass,
    overlaps,
)
from planner.model.mjcf.model_file import ModelFile
from planner.model.mjcf.model_index import ModelIndex, gravity_of
from planner.model.mjcf.read import read_opened
from planner.model.mjcf.unmodelled_features import UnmodelledFeatures
from planner.model.mjcf.unsupported import KINDS, unsupported_elements

_LIGHT = 1e-4  # share of the median inertia of joints of a kind; a joint with less makes the dynamics stiff
_MENDED = 1e-2  # share of that median: the proposed armature
_SHALLOW = 1e-3  # share of the machine's size: overlap without a warning, about that of feet in the ground
_DEGREES = math.radians(2.0 * math.pi)  # rad: 2 pi, read as degrees
_ROUNDING = 1e-9  # relative to a control or force, and absolute below 1
_SPARE = 1.5  # the proposed range over the static control or force
_MAX_PER_KIND = 4  # warnings of one kind that are listed


class ModelWarning(NamedTuple):
    """A likely error in a model."""

    problem: str  # One sentence
    fix: str  # The key or edit


def lint_model(
    model: Any, mechanism: Mechanism | None, joints: list[Record], keyframes: dict[str, np.ndarray]
) -> list[ModelWarning]:
    """Warnings about a compiled model, in a fixed order, the most serious first."""
    found = [*_actuation(model, joints), *_surroundings(model)]
    ranges = [joint["range"] for joint in joints if joint["unit"] == "rad" and joint["range"]]
    found += [*ranges_in_degrees(np.reshape(ranges, (-1, 2))), *_light(joints)]
    found += _outside(joints, np.array(model.qpos0), "the start that the file describes", _to_start)
    for name, qpos in keyframes.items():
        found += _outside(joints, qpos, f"keyframe {name!r}", _to_key)
    found += _overlapping(model) + ([] if mechanism is None else _coupled(mechanism))
    if mechanism is not None and not free_bases(model):
        pose = next(iter(keyframes.values()), np.array(model.qpos0))
        found += _weak(mechanism, pose)
    return found


def _actuation(model: Any, joints: list[Record]) -> list[ModelWarning]:
    found: list[ModelWarning] = []
    single = [joint["name"] for joint in joints if joint["unit"] and joint["name"]]
    if model.nu == 0:
        motors = f'<actuator><motor joint="{single[0] if single else "..."}" ctrlrange="-10 10"/></actuator>'
        prescribed = f", or prescribed = {_listed(single)} to plan accelerations" if single else ""
        found.append(ModelWarning("there are no actuators, so nothing moves the machine", f"add {motors}{prescribed}"))
    machines = machine_roots(ModelIndex(model))
    owned = [int(model.body_rootid[body]) in machines for body in model.jnt_bodyid]
    unnamed = [joint["label"] for joint, own in zip(joints, owned, strict=True) if own and not joint["name"]]
    if unnamed:
        which = f"{first_of(unnamed, _MAX_PER_KIND)} {'has' if len(unnamed) == 1 else 'have'} no name"
        found.append(ModelWarning(
            f"{which}, so a table of joints cannot name {'it' if len(unnamed) == 1 else 'them'}",
            'name="..." in the file, or start and goal as lists of all positions',
        ))  # fmt: skip
    return found


def _surroundings(model: Any) -> list[ModelWarning]:
    found: list[ModelWarning] = []
    if not np.any(gravity_of(model)):
        found.append(ModelWarning("gravity is 0", '<option gravity="0 0 -9.81"/>, unless that is meant'))
    elif (free := free_bases(model)) and not has_ground(model):
        floor = '<geom name="floor" type="plane" size="0 0 1"/> in <worldbody>'
        falls = f"{first_of(free, _MAX_PER_KIND)} hangs on nothing and there is no floor, so it falls for ever"
        found.append(ModelWarning(falls, floor))
    return found


def ranges_in_degrees(ranges: np.ndarray) -> list[ModelWarning]:
    """Ranges (J, 2) rad of hinges, meant in radians, that MuJoCo reads as degrees, its default: a warning, or none."""
    widths = ranges[:, 1] - ranges[:, 0]
    widest = widths[np.isfinite(widths)].max(initial=0.0)
    if not 0.0 < widest <= _DEGREES:
        return []
    words = f"no hinge may turn by more than {widest:.3g} rad, as if its range in radians were read as degrees"
    return [ModelWarning(words, '<compiler angle="radian"/>, if that is so')]


def angles_in_degrees(mechanism: Mechanism, named: Sequence[tuple[str, Any]]) -> str:
    """A sentence about a hinge that a table of joints' positions has more than a turn from zero; "" for none.

    Args:
        mechanism: The machine.
        named: What each table is, and the table; what is no table is left out.
    """
    places = {name: links.start for name, links in zip(mechanism.joint_names, mechanism.joint_links, strict=True)}
    for what, table in named:
        for name, angle in table.items() if isinstance(table, Mapping) else ():
            turns = mechanism.S[places[name], :3].any() if name in places else False
            if turns and isinstance(angle, (int, float)) and abs(angle) > 2.0 * np.pi:
                count, degrees = abs(angle) / (2.0 * np.pi), f"{angle:.6g} degrees are {np.radians(angle):.6g}"
                return f"{what} has joint {name!r} at {angle:.6g} rad, which is {count:.3g} turns; {degrees}."
    return ""


def _light(joints: list[Record]) -> list[ModelWarning]:
    """Joints with much less inertia than the median of their kind."""
    found: list[ModelWarning] = []
    for unit, quantity in (("rad", "kg m^2"), ("m", "kg")):
        alike = [joint for joint in joints if joint["unit"] == unit]
        median = float(np.median([joint["inertia"] for joint in alike])) if alike else 0.0
        tiny = [joint for joint in alike if joint["inertia"] < _LIGHT * median]
        for joint in tiny[:_MAX_PER_KIND]:
            found.append(ModelWarning(
                f"the inertia at {joint['label']} is {joint['inertia']:.2g} {quantity}, "
                f"{joint['inertia'] / median:.1g} of the median joint's, so its motion is very stiff",
                f'armature="{_MENDED * median:.2g}" at the joint',
            ))  # fmt: skip
    return found


def _outside(joints: list[Record], qpos: np.ndarray, whose: str, mend: Any) -> list[ModelWarning]:
    """Hinges and slides outside of their ranges in a pose."""
    found: list[ModelWarning] = []
    for joint in joints:
        if joint["range"] is None or not joint["unit"]:
            continue
        (low, high), q = joint["range"], float(qpos[joint["position"]])
        if not low - 1e-9 <= q <= high + 1e-9:
            nearest = min(max(q, low), high)
            found.append(ModelWarning(
                f"{whose} has {joint['label']} at {q:.4g} {joint['unit']}, outside of its range {low:.4g} to "
                f"{high:.4g}",
                mend(joint, nearest),
            ))  # fmt: skip
    more = len(found) - _MAX_PER_KIND
    return found[:_MAX_PER_KIND] + ([ModelWarning(f"so have {more} more joints", "the same")] if more > 0 else [])


def _to_start(joint: Record, nearest: float) -> str:
    name = joint["name"]
    return f"start = {{ {toml_key(name)} = {nearest:.4g} }}" if name else f"{nearest:.4g} for it in the list of start"


def _to_key(joint: Record, nearest: float) -> str:
    return f"{nearest:.4g} for it in the keyframe's qpos, or another start"


def _overlapping(model: Any) -> list[ModelWarning]:
    deep = [one for one in overlaps(model, model.qpos0) if one.depth > _SHALLOW * float(model.stat.extent)]
    found = [
        ModelWarning(
            f"{one.shapes} are {1000.0 * one.depth:.3g} mm within each other at the start",
            f'<contact><exclude body1="{one.bodies[0]}" body2="{one.bodies[1]}"/></contact>, or another start'
            if all(one.bodies) and "world" not in one.bodies else "a start in which they are apart",
        )
        for one in deep[:_MAX_PER_KIND]
    ]  # fmt: skip
    more = len(deep) - _MAX_PER_KIND
    return found + ([ModelWarning(f"so are {more} more pairs of bodies", "the same")] if more > 0 else [])


def _coupled(mechanism: Mechanism) -> list[ModelWarning]:
    """Joints that equalities and ranges together fix, or for which they are infeasible."""
    if not mechanism.couplings:
        return []
    ranges = np.array(mechanism.joint_range)
    if contradicted := contradiction(mechanism, ranges):
        return [ModelWarning(f"{contradicted.cause}, expected ranges with a pose that keeps it", contradicted.fix)]
    names = [mechanism.joint_of(int(i)) for i in np.flatnonzero(fixed_dofs(mechanism, ranges))]
    words = f"equalities and ranges together hold {first_of(names, _MAX_PER_KIND)} at one place, so nothing moves there"
    return [ModelWarning(words, "a wider range in the file, or goals that leave them there")] if names else []


def _weak(mechanism: Mechanism, qpos: np.ndarray) -> list[ModelWarning]:
    """Actuators whose ranges exclude static equilibrium at a pose (nq,) of a machine with a fixed base."""
    found: list[ModelWarning] = []
    needed, actuators = holding(mechanism, qpos), mechanism.actuators
    for name, u, force, controls, forces in zip(
        actuators.names, *needed, actuators.control_range, actuators.force_range, strict=True
    ):
        for value, (low, high), attribute in ((u, controls, "ctrlrange"), (force, forces, "forcerange")):
            if within(value, low, high):
                continue
            wide = min(low, _SPARE * value), max(high, _SPARE * value)
            found.append(ModelWarning(
                f"actuator {name!r} needs {value:.3g} to hold the start against gravity, and its {attribute} is "
                f"{low:.3g} to {high:.3g}",
                f'{attribute}="{wide[0]:.3g} {wide[1]:.3g}", or a start that takes less to hold',
            ))  # fmt: skip
    return found[: 2 * _MAX_PER_KIND]


def holding(mechanism: Mechanism, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Controls (nu,) and actuator forces (nu,) for static equilibrium of the actuated joints at a pose (nq,).

    Without contacts. The controls have minimum norm; 0 for an actuator that integrates its control or has no gain.
    """
    actuators = mechanism.actuators
    u = quasi_static_controls(mechanism, qpos, contacts=False, keep_activations=False)
    force = actuator_forces(actuators, u, actuator_lengths(mechanism, qpos))
    return np.where(actuators.dynamics == INTEGRATOR, 0.0, u), force


def within(values: Any, low: Any, high: Any) -> Any:
    """Whether values are within their ranges up to rounding; arrays of one shape, or numbers."""
    room = _ROUNDING * np.maximum(np.abs(values), 1.0)
    return (low - room <= values) & (values <= high + room)


def _listed(names: list[str]) -> str:
    """Names as a TOML list, the first few of them."""
    few = ", ".join(f'"{name}"' for name in names[:_MAX_PER_KIND])
    return f"[{few}, ...]" if len(names) > _MAX_PER_KIND else f"[{few}]"


class Loaded(NamedTuple):
    """A mechanism that the planner supports, and the keys of a problem file that it needs."""

    mechanism: Mechanism | None  # None if no keys make the file supported
    keys: dict[str, Any]  # ignore and inertia, where elements are refused
    refusal: str  # why the file is refused without keys; "" if it is not


@dataclass(frozen=True)
class Description:
    """Facts about a model file."""

    name: str  # The model's own name
    joints: list[Record]  # One record per joint
    bodies: list[Record]  # One record per body with mass
    actuators: list[Record]  # One record per actuator
    # Pairs of shapes that may collide, those that the plan models, the contact mode and its description
    contacts: Record
    gravity: list[float]  # (3,) m/s^2
    mass: float  # Total moving mass, kg
    free_bases: list[str]  # Names of bodies with a free joint
    moving_base: bool  # Whether a base moves in space or in a plane
    degrees_of_freedom: int  # nv
    planned: list[str]  # Features that the plan models, a phrase each
    left_out: list[str]  # Features that the plan omits, a phrase each
    loaded: Loaded  # The mechanism and the keys that it needs
    poses: dict[str, np.ndarray]  # qpos (nq,) by the keyframe's name; the home pose if the file has no keyframe
    troubles: list[ModelWarning]  # Likely errors, with fixes
    # World positions, m, of sites and of bodies without children, at the first of the poses
    frames: dict[str, list[float]]

    @property
    def keyframes(self) -> list[str]:
        """Names of the file's keyframes."""
        return [] if list(self.poses) == [HOME] else list(self.poses)

    def to_dict(self) -> Record:
        """As JSON values."""
        return {
            "name": self.name, "degrees_of_freedom": self.degrees_of_freedom, "mass": self.mass,
            "gravity": self.gravity, "free_bases": self.free_bases, "joints": self.joints, "bodies": self.bodies,
            "actuators": self.actuators, "contacts": self.contacts,
            "keyframes": self.keyframes, "frames": self.frames,
            "planned": self.planned, "left_out": self.left_out, "refused": self.loaded.refusal,
            "keys": self.loaded.keys, "problems": [trouble._asdict() for trouble in self.troubles],
        }  # fmt: skip


_FORCES = ("damping", "armature", "stiffness", "friction_loss")
"""Arrays (nv,) of a mechanism that act in the plan."""
HOME = "home"
"""Name of the pose qpos0, for a file without keyframes."""


def describe(file: ModelFile, keys: dict[str, Any] | None = None) -> Description:
    """Describe a machine, also one that cannot be planned with; `keys` are those of the problem file that opened it.

    Raises:
        ModelError: It has no joints.
    """
    model = file.survey.model
    if model.nv == 0:
        raise ModelError("the model has no joints, expected at least one.")
    loaded = load_somehow(file)
    loaded.keys.update(keys or {})
    joints, actuators = joint_records(model), actuator_records(model)
    mechanism = loaded.mechanism
    for j, joint in enumerate(joints):
        limit = np.inf if mechanism is None else float(np.min(mechanism.velocity_limit[mechanism.joint_links[j]]))
        joint["velocity_limit"] = limit if np.isfinite(limit) else None
    keyframes = {model.key(k).name or f"keyframe {k}": np.array(model.key_qpos[k]) for k in range(model.nkey)}
    poses = keyframes or {HOME: np.array(model.qpos0)}
    return Description(
        name=file.root.get("model", ""), joints=joints, bodies=body_records(model), actuators=actuators,
        contacts=_contacts(file, mechanism), gravity=[float(g) for g in gravity_of(model)], mass=moving_mass(model),
        free_bases=free_bases(model), moving_base=has_moving_base(file.survey), degrees_of_freedom=int(model.nv),
        planned=_planned(mechanism, joints),
        left_out=_left_out(file, mechanism), loaded=loaded, poses=poses,
        troubles=lint_model(model, mechanism, joints, keyframes), frames=_frames(model, mechanism, poses),
    )  # fmt: skip


def _frames(model: Any, mechanism: Mechanism | None, poses: dict[str, np.ndarray]) -> dict[str, list[float]]:
    """World positions, m, by name of frame: sites, and bodies without children."""
    if mechanism is None:
        return {}
    carriers, q = set(map(int, model.body_parentid)), next(iter(poses.values()))
    leaves = [name for b, name in enumerate(mechanism.body_names) if b and b not in carriers and name]
    names = [*mechanism.sites, *(name for name in leaves if name not in mechanism.sites)]
    return {name: np.round(frame_pose(mechanism, q, name)[:3, 3], 4).tolist() for name in names}


def load_somehow(file: ModelFile) -> Loaded:
    """Load the machine as it is, else without the refused kinds of elements."""
    kinds, refusal = dict.fromkeys(one.kind for one in unsupported_elements(file.survey.model)), ""
    for keys in ({}, {"ignore": [kind for kind in kinds if kind in KINDS]}):  # in the order of the refusal
        try:
            return Loaded(read_opened(lambda: file, ignore=keys.get("ignore", ())), keys, refusal)
        except ModelError as error:
            refusal = refusal or str(error)
    return Loaded(None, {}, refusal)


def _contacts(file: ModelFile, mechanism: Mechanism | None) -> Record:
    model, pairs = file.survey.model, file.survey.pairs
    return {
        "pairs": len(pairs), "mode": "" if mechanism is None else mechanism.contacts_mode,
        "choice": "" if mechanism is None else mechanism.contacts_choice,
        "shapes": [" and ".join(model.geom(g).name or f"geom number {g}" for g in pair.geoms) for pair in pairs],
        "with_planes": 0 if mechanism is None else len(mechanism.contacts),
        "between_bodies": 0 if mechanism is None else len(mechanism.body_contacts),
    }  # fmt: skip


def _planned(mechanism: Mechanism | None, joints: list[Record]) -> list[str]:
    """Phrases for the features of the mechanism."""
    if mechanism is None:
        return []
    counts = [
        (mechanism.nv, "degree", " of freedom"), (mechanism.nu, "actuator", ""),
        (sum(joint["range"] is not None for joint in joints), "joint range", ""),
        (len(mechanism.stops), "spring", " at ends of joint ranges"),
        (len(mechanism.couplings), "coupling", " of joints"),
        (len(mechanism.loops), "closed chain", ""),
        (len(mechanism.polynomial_couplings), "polynomial coupling", " of two joints"),
        (len(mechanism.tendons), "fixed tendon", ""),
        (len(mechanism.contacts), "contact", " with the ground"),
        (len(mechanism.body_contacts), "contact", " between bodies"),
    ]  # fmt: skip
    phrases = [f"{count} {noun}{'s' * (count != 1)}{more}" for count, noun, more in counts if count]
    arrays = [(name.replace("_", " "), np.asarray(getattr(mechanism, name))) for name in _FORCES]
    phrases += [
        f"{name} of {n} joint{'s' * (n != 1)}" for name, values in arrays if (n := int(np.count_nonzero(values)))
    ]
    phrases += ["gravity compensation"] if np.any(mechanism.gravcomp_mass) else []
    return [*phrases, *(["drag of a fluid"] if mechanism.drags else [])]


def _left_out(file: ModelFile, mechanism: Mechanism | None) -> list[str]:
    """Phrases for features of the file that the plan omits."""
    refused = tuple(unsupported_elements(file.survey.model))
    if mechanism is None:
        return list(UnmodelledFeatures(refused).phrases)
    pairs = len(file.survey.pairs)
    contacts = [f"contacts of all {pairs} pairs of shapes that may touch"] if "contacts" in mechanism.ignored else []
    refused = tuple(one for one in refused if one.phrase in mechanism.ignored)
    told = {"contacts", *(one.phrase for one in refused)}
    return [
        *contacts,
        *UnmodelledFeatures(refused).phrases,
        *(phrase for phrase in mechanism.ignored if phrase not in told),
    ]
