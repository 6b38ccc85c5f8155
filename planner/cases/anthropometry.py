"""The rigid bodies of a person, from mass and height alone.

    D. A. Winter, Biomechanics and Motor Control of Human Movement, 4th ed., Wiley 2009:
    table 4.1 (after Dempster): masses, centres of mass, radii of gyration, densities of segments;
    figure 4.1 (after Drillis and Contini): lengths of segments as parts of the height.

Masses are shares of the body mass M, lengths are shares of the height H. Values that are not in the book are ours:

    about a segment's long axis     a cylinder of its mass, length and density: I = m^2 / (2 pi density length)
    thorax and abdomen, pelvis      no radius of gyration there: elliptic cylinders of their mass, length and density
    L4-L5 above the hips            where the parts of the trunk have the centre of mass of the row "trunk"
    ear canal, C7-T1                at eye height (figure 4.1), and a little above the shoulders

Each body's frame is at the joint that carries it; x is ahead, y left, z up for a person who stands with hanging arms.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from planner.model.mjcf.text import written

SHOULDER_HEIGHT, HIP_HEIGHT, EYE_HEIGHT = 0.818, 0.530, 0.936  # H, figure 4.1
UPPER_ARM, FOREARM, HAND, THIGH, SHANK = 0.186, 0.146, 0.108, 0.245, 0.246  # H, figure 4.1
FOOT_HEIGHT, FOOT_LENGTH = 0.039, 0.152  # H, figure 4.1
C7_HEIGHT = 0.830  # H, ours: a little above the shoulders

TRUNK_MASS, TRUNK_COM = 0.497, 0.50  # table 4.1, greater trochanter to glenohumeral joint
PELVIS_MASS, PELVIS_COM = 0.142, 0.105  # table 4.1, L4-L5 to greater trochanter
CHEST_MASS, CHEST_COM = 0.355, 0.63  # table 4.1, thorax and abdomen, C7-T1 to L4-L5
HEAD_MASS, HEAD_RADIUS = 0.081, 0.495  # table 4.1, head and neck, C7-T1 to ear canal, where its centre of mass is

TRUNK_DENSITY, HEAD_DENSITY = 1030.0, 1110.0  # kg/m^3, table 4.1
BREADTH = 1.5  # of the trunk over its depth, ours


def waist_height() -> float:
    """Height of L4-L5 above the hips, H: it gives pelvis, thorax and abdomen the trunk's centre of mass."""
    trunk = TRUNK_MASS * TRUNK_COM * (SHOULDER_HEIGHT - HIP_HEIGHT)
    c7 = C7_HEIGHT - HIP_HEIGHT
    # trunk = PELVIS_MASS (1 - PELVIS_COM) y + CHEST_MASS (c7 - CHEST_COM (c7 - y))
    return (trunk - CHEST_MASS * (1.0 - CHEST_COM) * c7) / (PELVIS_MASS * (1.0 - PELVIS_COM) + CHEST_MASS * CHEST_COM)


@dataclass(frozen=True)
class Segment:
    """A rigid body."""

    mass: float  # kg
    com: tuple[float, float, float]  # m, centre of mass in the body's frame
    inertia: tuple[float, float, float]  # kg m^2, about the body's axes through the centre of mass


@dataclass(frozen=True)
class _Limb:
    """A row of table 4.1: mass in M; com and radius in segment lengths; length in H; density in kg/m^3."""

    mass: float
    com: float
    radius: float
    length: float
    density: float


_LIMBS = {
    "upper_arm": _Limb(0.028, 0.436, 0.322, UPPER_ARM, 1070.0),
    "forearm": _Limb(0.022, 0.682, 0.468, FOREARM, 1140.0),  # "forearm and hand", elbow axis to ulnar styloid
    "thigh": _Limb(0.100, 0.433, 0.323, THIGH, 1050.0),
    "shank": _Limb(0.061, 0.606, 0.416, SHANK, 1090.0),  # "foot and leg", femoral condyles to medial malleolus
}
LEG_MASS, LEG_COM, LEG_RADIUS = 0.0465, 0.433, 0.302  # table 4.1, "leg", femoral condyles to medial malleolus
FOOT_MASS, FOOT_COM, FOOT_RADIUS = 0.0145, 0.50, 0.475  # table 4.1, "foot"
HEEL_END = 0.065 / 1.75  # H, from the ankle back to the end of the heel, ours
_ALONG = {"thigh": 0.25, "shank": 0.20, "foot": 0.25}  # of the inertia across, ours: see leg_segments


def segments(mass: float, height: float) -> dict[str, Segment]:
    """Bodies of a person of a mass in kg and a height in m: pelvis, chest (with head), upper_arm, ... shank."""
    waist = waist_height()
    bodies = {name: _limb(limb, mass, height) for name, limb in _LIMBS.items()}
    bodies["pelvis"] = _trunk_part(PELVIS_MASS * mass, waist * height, (1.0 - PELVIS_COM) * waist * height)
    reach = C7_HEIGHT - HIP_HEIGHT - waist  # of thorax and abdomen, above L4-L5
    chest = _trunk_part(CHEST_MASS * mass, reach * height, (1.0 - CHEST_COM) * reach * height)
    bodies["chest"] = _joined(chest, _head(mass, height, waist))
    return bodies


def leg_segments(mass: float, height: float) -> dict[str, Segment]:
    """Thigh, shank and foot of a leg whose foot is a body of its own; segments() joins the foot to the shank.

    The inertia about the long axis is a share of the inertia across it, and larger than that of a cylinder.
    """
    thigh = _LIMBS["thigh"]
    rows = {"thigh": (thigh.mass, thigh.com, thigh.radius, THIGH), "shank": (LEG_MASS, LEG_COM, LEG_RADIUS, SHANK)}
    found = {}
    for name, (share, com, radius, length) in rows.items():
        across = share * mass * (radius * length * height) ** 2
        inertia = (across, across, _ALONG[name] * across)
        found[name] = Segment(share * mass, (0.0, 0.0, -com * length * height), inertia)
    across = FOOT_MASS * mass * (FOOT_RADIUS * FOOT_LENGTH * height) ** 2
    com = ((FOOT_COM * FOOT_LENGTH - HEEL_END) * height, 0.0, -0.5 * FOOT_HEIGHT * height)
    found["foot"] = Segment(FOOT_MASS * mass, com, (_ALONG["foot"] * across, across, across))
    return found


def sideless(name: str) -> str:
    """The name of a body or joint without left_ or right_."""
    return name.removeprefix("left_").removeprefix("right_")


def fit(pelvis: ElementTree.Element, bodies: Mapping[str, Segment], scale: float) -> None:
    """Fit a person's MJCF tree in place: bodies by name without side, and all lengths times `scale`."""
    for element in pelvis.iter():
        # the radius of a contact point is not a length of the person
        lengths = ("pos",) if element.get("class") == "contact" else ("pos", "fromto", "size")
        for key in lengths if element.tag != "inertial" else ():
            if key in element.attrib:
                element.set(key, written(*(scale * float(length) for length in element.attrib[key].split())))
    for body in pelvis.iter("body"):
        segment, inertial = bodies[sideless(body.attrib["name"])], body.find("inertial")
        assert inertial is not None  # every moving body of the file has one
        inertial.attrib.update(
            pos=written(*segment.com), mass=written(segment.mass), diaginertia=written(*segment.inertia)
        )


def _about_length(mass: float, length: float, density: float) -> float:
    """Moment of inertia of a round cylinder about its axis, kg m^2."""
    return mass**2 / (2.0 * np.pi * density * length)


def _limb(limb: _Limb, mass: float, height: float) -> Segment:
    m, length = limb.mass * mass, limb.length * height
    across = m * (limb.radius * length) ** 2
    return Segment(m, (0.0, 0.0, -limb.com * length), (across, across, _about_length(m, length, limb.density)))


def _trunk_part(m: float, length: float, com: float) -> Segment:
    """An elliptic cylinder with the trunk's density; its centre of mass is that of the table."""
    area = m / (TRUNK_DENSITY * length)
    depth2, width2 = area / np.pi / BREADTH, area / np.pi * BREADTH  # squares of the half axes
    across = m * length**2 / 12.0
    inertia = (across + m * width2 / 4.0, across + m * depth2 / 4.0, m * (depth2 + width2) / 4.0)
    return Segment(m, (0.0, 0.0, com), inertia)


def _head(mass: float, height: float, waist: float) -> Segment:
    m, length = HEAD_MASS * mass, (EYE_HEIGHT - C7_HEIGHT) * height
    across = m * (HEAD_RADIUS * length) ** 2
    com = (EYE_HEIGHT - HIP_HEIGHT - waist) * height
    return Segment(m, (0.0, 0.0, com), (across, across, _about_length(m, 2.0 * length, HEAD_DENSITY)))


def _joined(a: Segment, b: Segment) -> Segment:
    """Two segments on one vertical line as one body (parallel-axis theorem)."""
    m = a.mass + b.mass
    steiner = a.mass * b.mass / m * (a.com[2] - b.com[2]) ** 2
    x, y, z = (p + q for p, q in zip(a.inertia, b.inertia, strict=True))
    return Segment(m, (0.0, 0.0, (a.mass * a.com[2] + b.mass * b.com[2]) / m), (x + steiner, y + steiner, z))
