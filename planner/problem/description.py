"""Description of a user's model: its parts, the modelled and the omitted features, and likely errors.

Records are plain (dicts, lists, numbers, text), for a table or for JSON.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import ModelError
from planner.dynamics.kinematics import frame_pose
from planner.model.mechanism import Mechanism
from planner.model.mjcf.facts import (
    Record,
    actuator_records,
    body_records,
    free_bases,
    has_moving_base,
    joint_records,
    moving_mass,
)
from planner.model.mjcf.model_file import ModelFile
from planner.model.mjcf.model_index import gravity_of
from planner.model.mjcf.read import read_opened
from planner.model.mjcf.unmodelled_features import UnmodelledFeatures
from planner.model.mjcf.unsupported import KINDS, unsupported_elements
from planner.problem.model_lint import ModelWarning, lint_model


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
