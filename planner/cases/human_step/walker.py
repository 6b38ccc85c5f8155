"""The walker, a model of a person with passive legs over a treadmill, and the planned part of his cycle.

    number                          value                                   from
    masses, lengths, radii          parts of mass and height                Winter, see anthropometry.py
    inertia along a limb            shares of that across it                ours
    hip joints                      half of Winter's hip breadth apart      ours: Winter measures the outside
    foot                            heel 0.055 m behind the ankle, toe      ours: the toe point is between ball and tip,
                                    0.165 m ahead, at 1.75 m                because a rigid foot would dig its tip in
    pelvis, trunk, arms, head       .678 of the mass, one rigid body        Winter; its inertia is ours
    passive joints                  PASSIVE: spring, damper, angle at rest  ours: similar to pendulum tests
    or, for the joints in CURVED    exponentials instead of springs         Riener and Edrich, see below
    knee                            stops where it is straight              ours; exponentials need no stop

x is ahead, y left, z up; angles have the signs of OpenSim's gait models and are zero in standing. The feet touch the
belt at z = 0.

The passive elastic moments of hip, knee and ankle of Riener and Edrich (J Biomech 32, 1999, 539-544).

Means of ten healthy subjects, in N m, of angles in degrees: hip flexion h, knee flexion k and plantar flexion a, with
moments in the same directions,

    hip    exp(1.4655 - .0034 k - .0750 h) - exp(1.3403 - .0226 k + .0305 h) + 8.072
    knee   exp(1.800 - .0460 a - .0352 k + .0217 h) - exp(-3.971 - .0004 a + .0495 k - .0128 h) - 4.820
           + exp(2.220 - .150 k)
    ankle  exp(2.1016 - .0843 a - .0176 k) - exp(-7.9763 + .1949 a + .0008 k) - 1.792

    number          from
    all but one     memory, without access to the paper, and the same in a second source: public MATLAB functions
                    (rienerEdrich1999PassiveHipMoment, ...KneeMoment, ...AnkleMoment; "used by Miller et al. 2012")
    .150 k          memory; the second source has 1.50, with which bending a straight knee back by five degrees takes
                    17 kN m instead of 20 N m; nag92/LegMuscleModel has exp(2.5 - .25 k) there, for other subjects

Our signs: a lifted foot and a stretched knee are positive, so k, a and their moments change their signs.

Time is a fraction of a cycle from right heel strike to right heel strike. The right leg swings from SWING[0] to
SWING[1], the left leg half a cycle later. A swing is planned with one leg; ankle and foot of the other one move
as in the normal gait. A cycle has both legs and the belt.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from xml.etree import ElementTree

import numpy as np

from planner.base.arguments import choice, number
from planner.base.errors import PlannerError
from planner.cases import anthropometry as winter
from planner.cases.anthropometry import Segment
from planner.cases.human_step.gait import COLUMNS, LEG, SINK, SWAY, Gait, GaitSamples, Reference, reference
from planner.dynamics.algorithms import mass_matrix
from planner.dynamics.kinematics import frame_pose, jacobian
from planner.model.contact.laws import ContactLaw, Law
from planner.model.mechanism import Frame, Mechanism
from planner.model.mjcf.contacts import contact_attributes, stop_attributes
from planner.model.mjcf.text import edited, model_path, model_text, written
from planner.model.passive_forces import ExponentialTorque
from planner.problem.costs.jerk import driven_by_jerk

CURVED = ("hip_flexion", "knee", "ankle")
SIGNS = {"hip_flexion": 1.0, "knee": -1.0, "ankle": -1.0}  # of our angles and moments, relative to the paper's

# Exponentials of each joint: sign, constant, slopes by hip, knee and ankle per degree.
TERMS: dict[str, tuple[tuple[float, float, tuple[float, float, float]], ...]] = {
    "hip_flexion": ((1.0, 1.4655, (-0.0750, -0.0034, 0.0)), (-1.0, 1.3403, (0.0305, -0.0226, 0.0))),
    "knee": (
        (1.0, 1.800, (0.0217, -0.0352, -0.0460)),
        (-1.0, -3.971, (-0.0128, 0.0495, -0.0004)),
        (1.0, 2.220, (0.0, -0.150, 0.0)),
    ),
    "ankle": ((1.0, 2.1016, (0.0, -0.0176, -0.0843)), (-1.0, -7.9763, (0.0, 0.0008, 0.1949))),
}
CONSTANTS = {"hip_flexion": 8.072, "knee": -4.820, "ankle": -1.792}  # N m


def curves(dofs: Mapping[str, int], joints: Collection[str], factor: float = 1.0) -> Iterator[ExponentialTorque]:
    """The moments on some joints of one leg, times a factor; `dofs` are the degrees of freedom of CURVED."""
    for joint in joints:
        turned = factor * SIGNS[joint]
        for sign, constant, slopes in TERMS[joint]:
            own = {
                dofs[other]: SIGNS[other] * float(np.degrees(slope))
                for other, slope in zip(CURVED, slopes, strict=True)
                if slope != 0.0
            }
            yield ExponentialTorque(dofs[joint], turned * sign, constant, tuple(own.items()))
        yield ExponentialTorque(dofs[joint], turned * CONSTANTS[joint])


FILE_MASS, FILE_HEIGHT = 70.0, 1.75  # kg, m, of the person that mjcf/human_step/human_step.xml is written for
SIDES = ("right", "left")
PELVIS = COLUMNS[: -2 * len(LEG)]

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
BRACES = {"ankle": (40.0, 0.5, 0.0)}  # the same for a joint in an orthosis

TOUCH = ContactLaw(stiffness=5e3, damping=60.0, ramp=5e-3, force_ramp=5.0, slip_damping=150.0, friction=0.6, bend=0.75)
"""Contact of heel and toe with the belt. It is so soft that a touch-down takes several stages, and a light stance sinks
in by mm. With this bend of friction, stages of 10, 5 and 2.5 ms lead to the same minimum of a cycle; with a smaller one
some lead to other minima, 4 % higher."""
STOP = Law(stiffness=1e3, damping=20.0, ramp=0.03, force_ramp=0.1)
"""Stop of a straight knee: with 200 N m/rad it bends backwards by 7 degrees. The stop damps only while it pushes, so it
needs twice the 10 N m s/rad of a damper in both directions; with 10 a swing has two minima, one of which bounces."""
KNEE_RANGE = (-2.6, 0.0)  # rad
IMPRATIO = 125.0
"""MuJoCo's, in the file too. Its viscous friction lags as if a foot had impratio SOFT / w kg more at each contact, with
w = 0.38/kg, the inverse weight: 0.03 kg here, 0.26 kg with 1000, which a foot of 1 kg feels. Where it slips the normal
force is mu^2 / impratio, 0.3 %, off. An eighth of 1000 leaves every bit of the law that is read from the text."""

LIGHTEST, HEAVIEST = 20.0, 300.0  # kg
SHORTEST, TALLEST = 1.0, 2.5  # m
LEANEST, STOUTEST = 8.0, 80.0  # kg/m^2, beyond the known body mass indices of people
STIFFEST = 20.0  # times PASSIVE
LEGS = (0.3, 3.0)  # times Winter's


@dataclass(frozen=True)
class Walker:
    """A person with passive joints, and the modelled parts of him and the treadmill, with checked values."""

    mass: float = FILE_MASS  # kg
    height: float = FILE_HEIGHT  # m
    stiffness: float = 1.0  # of the passive joints, times PASSIVE
    damping: float = 1.0  # of the passive joints, times PASSIVE
    brace: str | None = None  # a joint in an orthosis, one of BRACES
    passive: str = "table"  # resistance of the passive joints, one of RESISTANCES
    legs: tuple[str, ...] = SIDES
    belt: bool = True  # with contact of the feet
    motors: bool = False  # six motors at the pelvis, whose controls are forces
    leg_mass: float = 1.0  # times Winter's share of the mass: less where muscles have wasted
    jerked: bool = False  # accelerations of the pelvis are states, and their rates are controls

    def __post_init__(self) -> None:
        ranges = {
            "mass": (LIGHTEST, HEAVIEST), "height": (SHORTEST, TALLEST), "stiffness": (0.0, STIFFEST),
            "damping": (0.0, STIFFEST), "leg_mass": LEGS,
        }  # fmt: skip
        for name, (least, most) in ranges.items():
            object.__setattr__(self, name, number(name, getattr(self, name), minimum=least, maximum=most))
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
        """Height over that of the person in the file: factor of all lengths."""
        return self.height / FILE_HEIGHT

    @property
    def leg_length(self) -> float:
        """Length of a straight leg from hip to ankle, m."""
        return (winter.THIGH + winter.SHANK) * self.height

    @property
    def curved(self) -> tuple[str, ...]:
        """The joints of a leg with exponentials instead of a spring; an orthosis keeps its own spring."""
        return () if self.passive == "table" else tuple(joint for joint in CURVED if joint != self.brace)

    @property
    def springs(self) -> dict[str, tuple[float, float, float]]:
        """Stiffness, damping and angle at rest of the joints of a leg: N m/rad, N m s/rad, rad."""
        own = {
            joint: (0.0 if joint in self.curved else self.stiffness * k, self.damping * b, rest)
            for joint, (k, b, rest) in PASSIVE.items()
        }
        return own if self.brace is None else own | {self.brace: BRACES[self.brace]}

    @property
    def segments(self) -> dict[str, Segment]:
        """The bodies by name: pelvis (with trunk, arms and head), thigh, shank, foot."""
        bulk = self.mass * self.height**2 / (FILE_MASS * FILE_HEIGHT**2)
        ix, iy, iz = (bulk * inertia for inertia in ABOVE_INERTIA)
        above = Segment(ABOVE_MASS * self.mass, (0.0, 0.0, ABOVE_COM * self.height), (ix, iy, iz))
        return {"pelvis": above, **winter.leg_segments(self.leg_mass * self.mass, self.height)}

    @cached_property
    def mechanism(self) -> Mechanism:
        """The model, read from the same text that the replay uses; MJCF has no exponentials, so they are added here."""
        machine = Mechanism.from_mjcf(self.text)
        legs = [{joint: machine.joint(f"{side}_{joint}").start for joint in CURVED} for side in self.legs]
        machine = machine.with_curves(curve for leg in legs for curve in curves(leg, self.curved, self.stiffness))
        return driven_by_jerk(machine, PELVIS) if self.jerked else machine

    @cached_property
    def text(self) -> str:
        """The MJCF text: the file with this person's masses, lengths and joints, without keyframes.

        MuJoCo scales the numbers of a contact or stop by the inertia of the whole machine, so these are written last.
        """
        text = ElementTree.tostring(self._root(), encoding="unicode")
        bare = Mechanism.from_mjcf(text, contacts="off")
        weights = _InverseWeights(bare)
        edits: dict[str, dict[str, str]] = {}
        for side in self.legs:
            knee = stop_attributes(STOP.stiffness, STOP.damping, weights.of_joint(f"{side}_knee"))
            if "knee" not in self.curved:
                # MuJoCo's plain spring begins where the smooth stop reaches the same force
                bent, straight = KNEE_RANGE[0] - STOP.surface_offset, KNEE_RANGE[1] + STOP.surface_offset
                edits[f".//joint[@name='{side}_knee']"] = {**knee, "range": written(bent, straight)}
            for end in ("heel", "toe") if self.belt else ():
                edits[f"contact/pair[@geom2='{side}_{end}']"] = contact_attributes(
                    TOUCH.stiffness, TOUCH.damping, TOUCH.slip_damping, TOUCH.friction,
                    weights.of_joint("belt") + weights.of_body(f"{side}_foot"), IMPRATIO,
                )  # fmt: skip
        for name, law, more in (("contact_ramp", TOUCH, [TOUCH.bend]), ("stop_ramp", STOP, [])):
            edits[f"custom/numeric[@name='{name}']"] = {"data": written(law.ramp, law.force_ramp or 0.0, *more)}
        return edited(text, edits)

    def _root(self) -> ElementTree.Element:
        """The file's root with masses, lengths and springs of this person, without the parts that are not modelled."""
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
        pelvis = named["pelvis"][1]
        winter.fit(pelvis, self.segments, self.scale)
        for joint in pelvis.iter("joint"):
            spring = self.springs.get(winter.sideless(joint.attrib["name"]))
            if spring is not None:
                values = zip(("stiffness", "damping", "springref"), spring, strict=True)
                joint.attrib.update({key: written(value) for key, value in values})
        return root


class _InverseWeights:
    """MuJoCo's body_invweight0 and dof_invweight0 of a mechanism: accelerations by a unit force at qpos0."""

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism, self.q = mechanism, mechanism.qpos0
        self.inverse = np.linalg.inv(mass_matrix(mechanism, self.q))

    def of_joint(self, name: str) -> float:
        """Inverse inertia felt by a hinge or slide."""
        i = self.mechanism.joint(name).start
        return float(self.inverse[i, i])

    def of_body(self, name: str) -> float:
        """Inverse inertia felt at the centre of mass of a body, mean over three directions."""
        link = self.mechanism.frame(name).link
        J = jacobian(self.mechanism, self.q, Frame.at(link, self.mechanism.com[link]))[:3]
        return float(np.trace(J @ self.inverse @ J.T)) / 3.0


SWING = (0.62, 1.0)  # of the cycle, from toe-off to heel strike
FEET = tuple(f"{side}_{point}" for side in SIDES for point in ("ankle_centre", "heel_point", "toe_point"))
"""Sites, in the order of gait.reference."""


@dataclass(frozen=True)
class GaitPhase:
    """A walker, a gait, and the planned part of its cycles."""

    walker: Walker
    gait: Gait  # the normal gait
    duration: float  # s, of a cycle
    begin: float  # fraction of a cycle
    N: int  # stages
    dt: float  # s

    @property
    def t(self) -> np.ndarray:
        """Times (N+1,), fractions of a cycle."""
        return self.begin + np.arange(self.N + 1) * self.dt / self.duration

    @cached_property
    def whole(self) -> Mechanism:
        """The person with belt, pelvis, right leg and left leg, also where one leg alone is planned."""
        return whole_body(self.walker.mass, self.walker.height)

    @cached_property
    def normal(self) -> Reference:
        """The normal gait on this body."""
        scale = self.walker.scale
        return reference(self.gait, self.feet, self.duration, sway=scale * SWAY, sink=scale * SINK)

    def feet(self, q: np.ndarray) -> np.ndarray:
        """Places (K, 6, 3) of the points FEET, m, of q (K, 16) with the columns of the normal gait."""
        q = np.hstack([np.zeros((len(q), 1)), q])
        return np.stack([frame_pose(self.whole, q, name)[:, :3, 3] for name in FEET], axis=1)

    @cached_property
    def motion(self) -> GaitSamples:
        """The normal gait at the knots: q, qd, qdd, (N+1, 16) each."""
        return self.normal.at(self.t)

    @cached_property
    def states(self) -> np.ndarray:
        """The normal gait as states (N+1, nx) of the plan."""
        q, qd = self.motion.q[:, self.columns], self.motion.qd[:, self.columns]
        accelerations = self.accelerations if self.walker.jerked else q[:, :0]
        if not self.walker.belt:
            return np.hstack([q, qd, accelerations])
        ran = -self.normal.belt_speed * self.dt * np.arange(self.N + 1)
        speed = np.full((self.N + 1, 1), -self.normal.belt_speed)
        return np.hstack([ran[:, None], q, speed, qd, accelerations])

    @property
    def accelerations(self) -> np.ndarray:
        """Accelerations (N+1, 6) of the pelvis in the normal gait, m/s^2 and rad/s^2."""
        return self.motion.qdd[:, : len(PELVIS)]

    @property
    def columns(self) -> list[int]:
        """Columns of the normal gait that the plan has."""
        absent = [side for side in SIDES if side not in self.walker.legs]
        return [i for i, name in enumerate(COLUMNS) if not name.startswith(tuple(absent))]

    def leg_time(self, side: str) -> np.ndarray:
        """Times (N+1,) since the heel strike of a leg, fractions of a cycle from 0 to 1."""
        return (self.t + (0.0 if side == "right" else 0.5)) % 1.0


@lru_cache(maxsize=8)
def whole_body(mass: float, height: float) -> Mechanism:
    """A person with both legs, for kinematics."""
    return Walker(mass, height).mechanism
