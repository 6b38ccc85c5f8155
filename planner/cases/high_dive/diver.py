"""The diver: the model for a person's mass and height, the take-off and the time of flight.

number                       value             from
masses, lengths, inertias    shares of M, H    Winter, see anthropometry.py
ranges of the joints         RANGES            ours: usual ranges of motion, rounded
straight body                arms overhead     ours: all other joint angles are zero

The frames of the bodies are those of anthropometry.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from xml.etree import ElementTree

import numpy as np

from planner.base.arguments import number
from planner.cases import anthropometry as winter
from planner.dynamics.momentum import center_of_mass
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import edited, model_path, model_text, written

RANGES = {
    "waist": (-0.4, 1.0), "waist_side": (-0.5, 0.5), "shoulder": (-0.8, 3.3), "shoulder_side": (-0.5, 1.1),
    "elbow": (0.0, 2.5), "hip": (-0.3, 2.2), "hip_side": (-0.2, 0.7), "knee": (0.0, 2.4),
}  # fmt: skip
"""rad, of the joints of both sides, with the signs of the model; arms overhead are pi at the shoulder. The range of the
shoulder to the side ends before the arm points sideways: there it is singular and the arm spins freely about itself."""

FILE_HEIGHT = 1.75  # m, of the person that mjcf/high_dive/high_dive.xml is written for
_MAX_VALUE = 1e6  # of speeds and heights


@dataclass(frozen=True)
class Diver:
    """A person on a tower, with checked values."""

    mass: float  # kg
    height: float  # m
    tower: float  # m, height of the platform above the water
    gravity: float  # m/s^2

    def __post_init__(self) -> None:
        for name, least, most in (("mass", 1.0, 1e3), ("height", 0.1, 10.0), ("gravity", 1e-3, 1e3)):
            object.__setattr__(self, name, number(name, getattr(self, name), minimum=least, maximum=most))
        object.__setattr__(self, "tower", number("tower", self.tower, greater_than=0.0, maximum=_MAX_VALUE))

    @cached_property
    def mechanism(self) -> Mechanism:
        """The model, read from the same text that the replay uses."""
        return Mechanism.from_mjcf(self.text)

    @property
    def text(self) -> str:
        """The MJCF text: the file with this person's masses and lengths, on this tower."""
        root = ElementTree.fromstring(model_text(model_path("high_dive") / "scene.xml"))
        pelvis = next(body for body in root.iter("body") if body.get("name") == "pelvis")
        winter.fit(pelvis, winter.segments(self.mass, self.height), self.height / FILE_HEIGHT)
        keys = {"start": (self.standing, (1.0, 0.0, 0.0, 0.0)), "goal": (self.reach, (0.0, 0.0, 1.0, 0.0))}
        edits = {
            f"keyframe/key[@name='{name}']": {"qpos": written(0.0, 0.0, z, *turn, *straight(root))}
            for name, (z, turn) in keys.items()
        }
        edits["option"] = {"gravity": written(0.0, 0.0, -self.gravity)}
        edits[".//body[@name='tower']"] = {"pos": written(0.0, 0.0, self.tower)}
        return edited(ElementTree.tostring(root, encoding="unicode"), edits)

    @property
    def standing(self) -> float:
        """Height of the hips above the water on the tower, m."""
        return self.tower + winter.HIP_HEIGHT * self.height

    @property
    def reach(self) -> float:
        """From the hips to the finger tips of raised arms, m: the hips' height when the hands touch the water."""
        trunk = winter.SHOULDER_HEIGHT - winter.HIP_HEIGHT
        return (trunk + winter.UPPER_ARM + winter.FOREARM + winter.HAND) * self.height

    def take_off(self, up: float, ahead: float, rate: float) -> np.ndarray:
        """The state (nx,) at take-off of a straight body that turns like a rigid body about its centre of mass.

        `up` and `ahead` are speeds of the centre of mass, m/s; `rate` of the somersault, rad/s, is positive forward.
        """
        x, nq = self.mechanism.keyframe("start"), self.mechanism.nq
        turning = np.array([0.0, rate, 0.0])
        arm = x[:3] - center_of_mass(self.mechanism, x[:nq])
        x[nq : nq + 3] = np.array([ahead, 0.0, up]) + np.cross(turning, arm)
        x[nq + 3 : nq + 6] = turning
        return x

    def flight(self, up: float) -> float:
        """Time until the hands of a straight diver, head down, touch the water, s."""
        x = self.mechanism.keyframe("start")
        above = center_of_mass(self.mechanism, x[: self.mechanism.nq])[2] - self.standing  # the hips
        fall = self.standing + above - (self.reach - above)
        return float((up + np.sqrt(up**2 + 2.0 * self.gravity * fall)) / self.gravity)

    def ranges(self) -> np.ndarray:
        """(nv - 6, 2) lowest and highest angle of each joint, rad."""
        return np.array([RANGES[winter.sideless(name)] for name in self.mechanism.joint_names[1:]])


def straight(root: ElementTree.Element) -> list[float]:
    """The joint angles of a straight body with the arms overhead, in the order of the model's hinges."""
    names = [joint.attrib["name"] for joint in root.find("worldbody").iter("joint")]  # type: ignore[union-attr]
    return [np.pi if winter.sideless(name) == "shoulder" else 0.0 for name in names]
