"""The walker of the case human-step: a person over a treadmill, whose legs are passive, as a model.

    number                          value                                   from
    masses, lengths, radii          parts of mass and height                Winter, see anthropometry.py
    inertia along a limb            shares of that across it                ours
    hip joints                      half of Winter's hip breadth apart      ours: the breadth is that of the outside
    foot                            HEEL behind the ankle, TOE ahead of it  ours: the toe point is between ball and
                                    tip, since a foot of one piece would dig its tip in
    pelvis, trunk, arms, head       .678 of the mass, one rigid body        Winter; its inertia is ours
    passive joints                  PASSIVE: spring, damper, angle at rest  ours: of the size of pendulum tests
    or, of the joints of CURVED     exponentials instead of springs         Riener and Edrich, see riener_edrich.py
    knee                            stops where it is straight              ours; with exponentials it needs no stop

x is ahead, y to the left, z up; angles have the signs of OpenSim's gait models. All angles zero is standing. The feet
touch the belt at z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from xml.etree import ElementTree

import numpy as np

from planner.base.arguments import choice, number
from planner.base.errors import PlannerError
from planner.cases import anthropometry as winter
from planner.cases.anthropometry import Segment
from planner.cases.human_step.riener_edrich import CURVED, curves
from planner.dynamics.algorithms import jacobian, mass_matrix
from planner.model.contact.laws import ContactLaw, Law
from planner.model.mechanism import Frame, Mechanism
from planner.model.mjcf.contacts import contact_attributes, stop_attributes
from planner.model.mjcf.text import edited, model_path, model_text, written
from planner.problem.costs.jerk import driven_by_jerk

FILE_MASS, FILE_HEIGHT = 70.0, 1.75  # kg, m, of the person that mjcf/human_step/human_step.xml is written for
SIDES = ("right", "left")
PELVIS = ("pelvis_x", "pelvis_y", "pelvis_z", "pelvis_tilt", "pelvis_list", "pelvis_rotation")
LEG = ("hip_flexion", "hip_adduction", "hip_rotation", "knee", "ankle")

HIPS_APART = 0.5 * winter.HIP_WIDTH  # H
HEEL, TOE = 0.055 / FILE_HEIGHT, 0.165 / FILE_HEIGHT  # H, of the ankle
ABOVE_MASS, ABOVE_COM = 0.678, 0.15 / FILE_HEIGHT  # M and H, of pelvis and all above it
ABOVE_INERTIA = (1.5, 1.5, 0.6)  # kg m^2, of the person in the file

PASSIVE = {  # N m/rad, N m s/rad, rad at rest
    "hip_flexion": (10.0, 1.0, np.radians(5.0)),
    "hip_adduction": (20.0, 1.0, 0.0),
    "hip_rotation": (10.0, 0.5, 0.0),
    "knee": (5.0, 0.5, np.radians(-10.0)),
    "ankle": (15.0, 0.5, np.radians(-5.0)),
}
RESISTANCES = ("table", "riener-edrich")
BRACES = {"ankle": (40.0, 0.5, 0.0)}  # the same, of a joint in an orthosis

TOUCH = ContactLaw(stiffness=5e3, damping=60.0, ramp=5e-3, force_ramp=5.0, slip_damping=150.0, friction=0.6, bend=0.75)
"""Of heel and toe on the belt: so soft that a touch-down takes several stages, and a light stance sinks in by mm. With
this bend of friction stages of 10, 5 and 2.5 ms lead to the same minimum of a cycle; with less some lead to others, 4 %
higher."""
IMPRATIO = 1000.0  # of MuJoCo's, at which its friction is that of TOUCH
POINT = 5e-4  # m, radius of the spheres at heel and toe, points but for MuJoCo
STOP = Law(stiffness=1e3, damping=20.0, ramp=0.03, force_ramp=0.1)
"""Of a straight knee: 200 N m/rad let it bend backwards by 7 degrees. It damps only while it pushes, so it needs twice
the 10 N m s/rad of a damper in both directions; with 10 a swing has two minima, one of which bounces."""
KNEE_RANGE = (-2.6, 0.0)  # rad

LIGHTEST, HEAVIEST = 20.0, 300.0  # kg
SHORTEST, TALLEST = 1.0, 2.5  # m
LEANEST, STOUTEST = 8.0, 80.0  # kg/m^2, body mass indices beyond what is known of people
STIFFEST = 20.0  # times PASSIVE
LEGS = (0.3, 3.0)  # times Winter's


@dataclass(frozen=True)
class Walker:
    """A person, what his joints resist with, and what of him and the treadmill is modelled. Checked.

    Attributes:
        mass: kg.
        height: m.
        stiffness: Of the passive joints, times PASSIVE.
        damping: The same.
        brace: A joint in an orthosis, of BRACES, or None.
        passive: What the passive joints resist with, of RESISTANCES.
        legs: Some of SIDES.
        belt: Whether there is a belt and contact with it.
        motors: Whether the pelvis has six motors, of forces.
        leg_mass: Of the legs, times Winter's share of the mass: less where muscles have wasted.
        jerked: Whether the accelerations of the pelvis are states, which its motors change.
    """

    mass: float = FILE_MASS
    height: float = FILE_HEIGHT
    stiffness: float = 1.0
    damping: float = 1.0
    brace: str | None = None
    passive: str = "table"
    legs: tuple[str, ...] = SIDES
    belt: bool = True
    motors: bool = False
    leg_mass: float = 1.0
    jerked: bool = False

    def __post_init__(self) -> None:
        ranges = {
            "mass": (LIGHTEST, HEAVIEST), "height": (SHORTEST, TALLEST), "stiffness": (0.0, STIFFEST),
            "damping": (0.0, STIFFEST), "leg_mass": LEGS,
        }  # fmt: skip
        for name, (least, most) in ranges.items():
            object.__setattr__(self, name, number(name, getattr(self, name), least=least, most=most))
        if self.brace is not None:
            choice("brace", self.brace, BRACES)
        choice("passive", self.passive, RESISTANCES)
        bulk = self.mass / self.height**2
        if not LEANEST <= bulk <= STOUTEST:
            raise PlannerError(
                f"mass {self.mass:g} kg and height {self.height:g} m make {bulk:.3g} kg/m^2, expected a person's body "
                f"mass index of {LEANEST:g} to {STOUTEST:g}."
            )

    @property
    def scale(self) -> float:
        """Lengths over those of the person in the file."""
        return self.height / FILE_HEIGHT

    @property
    def leg_length(self) -> float:
        """Of a straight leg from hip to ankle, m."""
        return (winter.THIGH + winter.SHANK) * self.height

    @property
    def curved(self) -> tuple[str, ...]:
        """The joints of a leg whose springs are exponentials; an orthosis has one of its own."""
        return () if self.passive == "table" else tuple(joint for joint in CURVED if joint != self.brace)

    @property
    def springs(self) -> dict[str, tuple[float, float, float]]:
        """Of the joints of a leg: N m/rad, N m s/rad, rad at rest."""
        own = {
            joint: (0.0 if joint in self.curved else self.stiffness * k, self.damping * b, rest)
            for joint, (k, b, rest) in PASSIVE.items()
        }
        return own if self.brace is None else own | {self.brace: BRACES[self.brace]}

    @property
    def segments(self) -> dict[str, Segment]:
        """The bodies by name: pelvis (with all above it), thigh, shank, foot."""
        bulk = self.mass * self.height**2 / (FILE_MASS * FILE_HEIGHT**2)
        ix, iy, iz = (bulk * inertia for inertia in ABOVE_INERTIA)
        above = Segment(ABOVE_MASS * self.mass, (0.0, 0.0, ABOVE_COM * self.height), (ix, iy, iz))
        return {"pelvis": above, **winter.leg_segments(self.leg_mass * self.mass, self.height)}

    @cached_property
    def mechanism(self) -> Mechanism:
        """The model, read from the very text that a replay uses; exponentials, which no text holds, beside it."""
        machine = Mechanism.from_mjcf(self.text)
        legs = [{joint: machine.joint(f"{side}_{joint}").start for joint in CURVED} for side in self.legs]
        machine = machine.with_curves(curve for leg in legs for curve in curves(leg, self.curved, self.stiffness))
        return driven_by_jerk(machine, PELVIS) if self.jerked else machine

    @cached_property
    def text(self) -> str:
        """The MJCF text: the file with this person's masses, lengths and joints, without keyframes.

        What MuJoCo makes of the numbers of a contact or stop depends on the inertia of the whole machine: so these are
        written last.
        """
        text = ElementTree.tostring(self._root(), encoding="unicode")
        bare = Mechanism.from_mjcf(text, contacts="off")
        weights = _InverseWeights(bare)
        edits: dict[str, dict[str, str]] = {}
        for side in self.legs:
            knee = stop_attributes(STOP.stiffness, STOP.damping, weights.of_joint(f"{side}_knee"))
            if "knee" not in self.curved:
                edits[f".//joint[@name='{side}_knee']"] = {**knee, "range": written(*stop_range())}
            for end in ("heel", "toe") if self.belt else ():
                edits[f"contact/pair[@geom2='{side}_{end}']"] = contact_attributes(
                    TOUCH.stiffness, TOUCH.damping, TOUCH.slip_damping, TOUCH.friction,
                    weights.of_joint("belt") + weights.of_body(f"{side}_foot"), IMPRATIO,
                )  # fmt: skip
        for name, law, more in (("contact_ramp", TOUCH, [TOUCH.bend]), ("stop_ramp", STOP, [])):
            edits[f"custom/numeric[@name='{name}']"] = {"data": written(law.ramp, law.force_ramp or 0.0, *more)}
        return edited(text, edits)

    def _root(self) -> ElementTree.Element:
        """The file's root with masses, lengths and springs of this person, and without what is not modelled."""
        root = ElementTree.fromstring(model_text(model_path("human_step") / "scene.xml"))
        contact = root.find("contact")
        assert contact is not None  # the file has one
        named = {body.attrib["name"]: (parent, body) for parent in root.iter() for body in parent.findall("body")}
        absent = [f"{side}_thigh" for side in SIDES if side not in self.legs] + ([] if self.belt else ["belt"])
        for name in absent:
            parent, body = named[name]
            parent.remove(body)
        for pair in contact.findall("pair"):
            if not (self.belt and pair.attrib["geom2"].split("_")[0] in self.legs):
                contact.remove(pair)
        for section in root.findall("keyframe") + ([] if self.motors else root.findall("actuator")):
            root.remove(section)
        pelvis, segments = named["pelvis"][1], self.segments
        for element in pelvis.iter():
            point = element.get("class") == "contact"  # whose radius is no length of the person
            for key in ("pos",) if point else ("pos", "fromto", "size"):
                if key in element.attrib and element.tag != "inertial":
                    sizes = map(float, element.attrib[key].split())
                    element.set(key, written(*(self.scale * size for size in sizes)))
        for body in pelvis.iter("body"):
            segment, inertial = segments[_sideless(body.attrib["name"])], body.find("inertial")
            assert inertial is not None  # every moving body of the file has one
            numbers = {"pos": written(*segment.com), "diaginertia": written(*segment.inertia)}
            inertial.attrib.update(numbers, mass=written(segment.mass))
        for joint in pelvis.iter("joint"):
            spring = self.springs.get(_sideless(joint.attrib["name"]))
            if spring is not None:
                values = zip(("stiffness", "damping", "springref"), spring, strict=True)
                joint.attrib.update({key: written(value) for key, value in values})
        return root


def stop_range() -> tuple[float, float]:
    """Of the knee for MuJoCo, rad: its plain spring begins where the smooth stop has come to the same force."""
    return KNEE_RANGE[0] - STOP.lift, KNEE_RANGE[1] + STOP.lift


def belt_height() -> float:
    """Of the belt for MuJoCo, m: the smooth contact of points begins at 0."""
    return -TOUCH.lift - POINT


class _InverseWeights:
    """MuJoCo's body_invweight0 and dof_invweight0 of a mechanism: what a unit force does where the file puts it."""

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism, self.q = mechanism, mechanism.qpos0
        self.inverse = np.linalg.inv(mass_matrix(mechanism, self.q))

    def of_joint(self, name: str) -> float:
        """Of a hinge or slide."""
        i = self.mechanism.joint(name).start
        return float(self.inverse[i, i])

    def of_body(self, name: str) -> float:
        """Of its centre of mass, the mean over the three directions."""
        link = self.mechanism.frame(name).link
        T = np.eye(4)
        T[:3, 3] = self.mechanism.com[link]
        J = jacobian(self.mechanism, self.q, Frame(link, T))[:3]
        return float(np.trace(J @ self.inverse @ J.T)) / 3.0


def _sideless(name: str) -> str:
    return name.removeprefix("left_").removeprefix("right_")


