"""Forces from outside a mechanism's joints: spheres that touch planes, and stops at the ends of joints. Data.

One smooth one-sided law serves both. With the penetration e, the speed v_n at which it opens, and the sliding
velocity v_t,

    ramp(e; a) = 0, e^2 / 2a, e - a/2          for e < 0, 0..a, > a
    s(e; a)    = 3 t^2 - 2 t^3, t = e/a within 0..1
    f_n = ramp(K ramp(e; a) - B s(e; a) v_n; f)
    f_t = -(h - ramp(h - (1 - b) mu f_n; 2 b mu f_n)) v_t / |v_t|,   h = c_t s(e; a) |v_t|

which is once continuously differentiable and never pulls: friction is viscous, h, as long as that is less than
(1 - b) mu f_n, Coulomb's mu f_n where it is more than (1 + b) mu f_n, and bends between. Far beyond the ramps the force
is that of a plain spring whose surface lies lower by

    lift = a/2 + f/2K

so the law's surface is raised by as much. With a margin it lies higher by that, too:

    e = margin + lift - distance.

`ContactLaw.exact` is the limit of no smoothing, in which MuJoCo's contact tends to the same force (see
model.mjcf.contacts): friction is then c_t v_t, cut off at mu f_n, and where it slips MuJoCo's projection onto the
friction cone raises the normal force to

    f_n = (K e - B v_n + mu c_t |v_t| / impratio) / (1 + mu^2 / impratio).

A law with a `lead` is the force of MuJoCo's usual constraints, of any file (model.mjcf.file_law and contact_edits):
there the damper feels the velocity that the contact or the joint will have `lead` seconds later, x = v + lead J qacc,
relative to the surface and without the Jacobian's own change, so the force depends on the acceleration. With x_n = n'x,
x_t the rest, depth = ramp(e; a) and s = s(e; a/2), a pyramidal cone has the sum over four edges d = n +- mu t1, n +- mu
t2 of

    r(y; f) d,   y = (K depth - B s d'x) / 4,   r = ramp, r(y; 0) = max(y, 0)

with t1, t2 of MuJoCo's contact frame; so has a contact without friction, whose edges are all n. An elliptic cone
has, with i = impratio and (g_n, g_t) the point of |g_t| <= m g_n, m = mu / sqrt(i), that is nearest to (y_n, y_t),

    f_n = g_n,   f_t = sqrt(i) g_t,   y_n = K depth - B s x_n,   y_t = -B s sqrt(i) x_t.

`spinning` and `rolling` are lengths: torques about n and across it of up to so many times the normal force resist the
angular velocity w a lead later. A pyramid with spinning has two edges more, n with the torque +- spinning n, with
rolling another four, +- rolling t1 and +- rolling t2, all with an equal share; in an elliptic cone spinning/mu w_n and
rolling/mu w_t stand beside x_t, and the torque is g's part there times as much.

It slips gradually: with p and c the parts of y along the edge of the cone beside it and across, inwards, g is the
gradient of p^2 (1/2 + psi(c/p)), psi(t) = t^2/2 for t > b m, psi'' = 0 for t < -b m, and a line between. Both forces
are minus the gradient of a convex function of x, so the acceleration minimizes a convex function (Todorov, "Convex and
analytically-invertible dynamics with contacts and constraints", 2014). K and B are those of deep contacts: before, they
grow with the depth r = e - a/2 as MuJoCo's impedance d(r) does, from d_0 to d_1 at a width, to

    K w d/d_1,   B w,   w = d/(1 - d) (1 - d_1)/d_1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, count, number, set_fields
from planner.base.errors import PlannerError

ALONG = 1e-9  # of a direction along a plane, its part across
FORCE_SHARE = 0.2  # of stiffness * ramp: how much of the force the second ramp smooths, as the step study's 5 N of 25
BEND = 0.5  # of the cone either way: less is hardly nearer to MuJoCo; the human step has its own
CONES = ("elliptic", "pyramidal")
RAMP_SHARE = 0.2  # of how deep a machine at rest sinks in: then its feet stand where the law is that of a plain spring


@dataclass(frozen=True)
class Law:
    """The one-sided force of a spring and damper.

    Attributes:
        stiffness: K, N/m or N m/rad.
        damping: B, N s/m or N m s/rad.
        ramp: a, m or rad: how far in the force grows to its full slope; 0 for no smoothing.
        force_ramp: f, N or N m: the same for the force where damping would make it pull; by default a share of
            stiffness * ramp.
        lead: s, how much later the contact has the velocity that is damped; 0 for now.
        impedance: Of a law with a lead d_0, d_1, the width, m or rad, and the midpoint of the rise as a part of the
            width; d_0 = d_1 for the same stiffness at all depths.
        margin: m or rad: the force begins so far before the surfaces touch, or the end of a range; depths count from
            there.
    """

    stiffness: float
    damping: float = 0.0
    ramp: float = 0.0
    force_ramp: float | None = None
    lead: float = field(default=0.0, kw_only=True)
    impedance: tuple[float, float, float, float] = field(default=(0.9, 0.9, 1.0, 0.5), kw_only=True)
    margin: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        set_fields(self, stiffness=number("stiffness", self.stiffness, greater_than=0.0))
        for name in ("damping", "ramp", "lead", "margin"):
            set_fields(self, **{name: number(name, getattr(self, name), minimum=0.0)})
        set_fields(self, impedance=tuple(map(float, self.impedance)))  # a list could not be hashed
        first, last, width, midpoint = self.impedance
        if not (0.0 < first < 1.0 and 0.0 < last < 1.0 and width > 0.0 and 0.0 < midpoint < 1.0):
            raise PlannerError(f"impedance is {self.impedance}, expected d_0, d_1, a width and a midpoint of 0 to 1.")
        share = FORCE_SHARE * self.stiffness * self.ramp if self.force_ramp is None else self.force_ramp
        set_fields(self, force_ramp=number("force_ramp", share, minimum=0.0))

    @property
    def surface_offset(self) -> float:
        """How far the law's surface is raised, m or rad, so that the force deep inside is stiffness times the depth."""
        return 0.5 * self.ramp + 0.5 * float(self.force_ramp or 0.0) / self.stiffness

    @property
    def reach(self) -> float:
        """How far before the surfaces touch, or the end of a range, the smoothed force begins, m or rad."""
        return self.margin + self.surface_offset

    def impedance_at(self, depth: Any) -> Any:
        """The impedance d at depths, m or rad."""
        first, last, width, midpoint = self.impedance
        x = np.clip(depth / width, 0.0, 1.0)
        rise = np.where(x > midpoint, 1.0 - (1.0 - x) ** 2 / (1.0 - midpoint), x**2 / midpoint)
        return first + (last - first) * rise

    def rest_depth(self, load: float) -> float:
        """How deep a load, N or N m, presses at rest, m or rad, beyond the ramps.

        Where the impedance still rises, deeper than a plain spring's.
        """
        return _rest_depth(self, load)


@lru_cache(maxsize=256)  # of few laws, asked for at many states
def _rest_depth(law: Law, load: float) -> float:
    last = law.impedance[1]

    def carried(depth: float) -> float:
        d = float(law.impedance_at(depth))
        return law.stiffness * depth * (d / last) * (d / (1.0 - d)) * (1.0 - last) / last

    low, high = 0.0, load / law.stiffness
    if law.lead == 0.0:
        return high
    while carried(high) < load * (1.0 - 1e-12):  # rounding
        low, high = high, 2.0 * high
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if carried(middle) > load else (middle, high)
    return high


@dataclass(frozen=True)
class ContactLaw(Law):
    """The force between two surfaces: the one-sided law along the normal, and friction.

    Attributes:
        slip_damping: c_t, N s/m, of friction before it slips.
        friction: mu.
        impratio: Of MuJoCo's projection onto the friction cone; infinite for none.
        bend: b, how gradually friction turns from viscous to Coulomb's, 0 (at once) to 1. In an MJCF it goes with a
            ramp: without one friction is cut off at once.
        uncertainty: How many times softer a plane may be; at least 1. A plan's gains allow for it
            (solvers.gains); nothing else depends on it.
        cone: "elliptic" or "pyramidal", the friction cone of a law with a lead. Its friction follows from damping,
            friction, impratio and cone; slip_damping says it and does not change it.
        spinning: m, the torque about the normal of a law with a lead, as a multiple of the normal force.
        rolling: m, the torque across the normal likewise.
    """

    slip_damping: float = 0.0
    friction: float = 0.0
    impratio: float = math.inf
    bend: float = BEND
    uncertainty: float = 1.0
    cone: str = "elliptic"
    spinning: float = 0.0
    rolling: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("slip_damping", "friction", "spinning", "rolling"):
            set_fields(self, **{name: number(name, getattr(self, name), minimum=0.0)})
        set_fields(self, bend=number("bend", self.bend, minimum=0.0, maximum=1.0))
        set_fields(self, uncertainty=number("uncertainty", self.uncertainty, minimum=1.0))
        if self.impratio != math.inf:
            set_fields(self, impratio=number("impratio", self.impratio, greater_than=0.0))
        choice("cone", self.cone, CONES)
        if (self.spinning > 0.0 or self.rolling > 0.0) and not (self.lead > 0.0 and self.friction > 0.0):
            raise PlannerError(
                f"spinning is {self.spinning:g} and rolling {self.rolling:g}, expected a lead and friction beside them."
            )
        if self.rolling > 0.0 and self.spinning == 0.0:
            raise PlannerError(f"rolling is {self.rolling:g} and spinning 0, expected spinning above 0 beside it.")
        if self.lead > 0.0 and self.is_round and self.impratio == math.inf:
            raise PlannerError("impratio is inf, expected a finite number for an elliptic cone with a lead.")

    @property
    def surface_offset(self) -> float:
        """How far the law's surface is raised, m: edges of a pyramid have ramps of their own, elliptic cones none."""
        ramps = 1 if self.lead == 0.0 else 0 if self.is_round else self.edges
        return 0.5 * self.ramp + 0.5 * ramps * float(self.force_ramp or 0.0) / self.stiffness

    @property
    def tangential_damping(self) -> float:
        """Of a law with a lead what friction is before it slips, N s/m, as follows from damping, friction and cone."""
        if self.is_round:
            return self.impratio * self.damping
        return self.damping * self.friction**2 / max(self.condim - 1, 1)

    @property
    def condim(self) -> int:
        """MuJoCo's number of dimensions: 6 with rolling, 4 with spinning, 3 with friction, else 1."""
        return 6 if self.rolling > 0.0 else 4 if self.spinning > 0.0 else 3 if self.friction > 0.0 else 1

    @property
    def edges(self) -> int:
        """How many edges a pyramidal cone has; four without friction, which are all the normal."""
        return max(4, 2 * (self.condim - 1))

    @property
    def is_round(self) -> bool:
        """Whether friction has an elliptic cone; a contact without friction is a pyramid of no width."""
        return self.cone == "elliptic" and self.friction > 0.0

    @classmethod
    def resting(
        cls, mass: float, *, sink: float = 5e-3, friction: float = 1.0, damping_ratio: float = 0.2, slip: float = 0.5,
        ramp: float | None = None, gravity: float = 9.81,
    ) -> ContactLaw:  # fmt: skip
        """Contact parameters from penetration at rest, damping ratio and slip speed of a machine.

        RK4 wants stages of at most 2.7 m / slip_damping and 2.7 m / damping, m the mass that a foot has by itself:
        light feet want a larger slip, or a shorter dt.

        Args:
            mass: kg, of all of the machine.
            sink: m, how deep the machine sinks in when it stands on one contact: K = mass gravity / sink.
            friction: mu.
            damping_ratio: zeta of the machine bouncing on one contact: B = 2 zeta sqrt(K mass).
            slip: m/s at which viscous friction would be all there is, c_t = mu mass gravity / slip; a foot pushed
                along with a part of that creeps at about that part of it.
            ramp: m, of smoothing; by default a fifth of the sink.
            gravity: m/s^2.

        Raises:
            PlannerError: A number that is not above 0.
        """
        weight = number("mass", mass, greater_than=0.0) * number("gravity", gravity, greater_than=0.0)
        stiffness = weight / number("sink", sink, greater_than=0.0)
        damping = 2.0 * number("damping_ratio", damping_ratio, minimum=0.0) * math.sqrt(stiffness * mass)
        mu = number("friction", friction, minimum=0.0)
        return cls(
            stiffness, damping, RAMP_SHARE * sink if ramp is None else ramp,
            slip_damping=mu * weight / number("slip", slip, greater_than=0.0), friction=mu,
        )  # fmt: skip

    @classmethod
    def exact(
        cls, stiffness: float, damping: float, slip_damping: float, friction: float, impratio: float = math.inf
    ) -> ContactLaw:
        """The law without any smoothing, which is what MuJoCo's contact with these coefficients tends to."""
        return cls(stiffness, damping, 0.0, 0.0, slip_damping, friction, impratio, bend=0.0)


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane of the world: n'x = offset on it, touched from n'x > offset.

    Attributes:
        normal: (3,) of length one.
        offset: m.
        velocity: (3,) m/s of its surface; only what is along the plane counts.
        slide: The degree of freedom that carries it along itself, a treadmill's belt for example; -1 for none.
    """

    normal: np.ndarray
    offset: float = 0.0
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    slide: int = -1

    def __post_init__(self) -> None:
        normal, velocity = array("normal", self.normal, (3,)), array("velocity", self.velocity, (3,))
        length = float(np.linalg.norm(normal))
        if not length > 0.0:
            raise PlannerError("normal is (0, 0, 0), expected a direction.")
        normal /= length
        velocity -= normal * (normal @ velocity)
        slide, offset = count("slide", self.slide, minimum=-1), number("offset", self.offset)
        set_fields(self, normal=normal, velocity=velocity, offset=offset, slide=slide)


def slide_direction(mechanism: Any, plane: Plane) -> np.ndarray:
    """(3,) the velocity of a plane per rate of the slide that carries it, in the world; zeros where none does."""
    i = plane.slide
    if i < 0:
        return np.zeros(3)
    fits = i < mechanism.nv and mechanism.parent[i] < 0 and not np.any(mechanism.S[i, :3])
    direction = mechanism.T_home[i, :3, :3] @ mechanism.S[i, 3:] if fits else plane.normal
    if not abs(direction @ plane.normal) < ALONG:
        raise PlannerError(f"a plane is carried by dof {i}, expected that of a slide on the world along the plane.")
    return direction


@dataclass(frozen=True, eq=False)
class Contact:
    """A sphere, or a point, of a link against a plane.

    Attributes:
        link: Which carries the sphere.
        centre: (3,) m, in the link's frame.
        radius: m, 0 for a point.
        plane: The plane that it touches.
        law: The force.
        name: For pictures and messages.
    """

    link: int
    centre: np.ndarray
    radius: float
    plane: Plane
    law: ContactLaw
    name: str = ""

    def __post_init__(self) -> None:
        link, radius = count("link", self.link, minimum=0), number("radius", self.radius, minimum=0)
        set_fields(self, link=link, centre=array("centre", self.centre, (3,)), radius=radius)


@dataclass(frozen=True)
class Stop:
    """The end of a hinge's or slide's range.

    Attributes:
        dof: Which degree of freedom.
        end: Its coordinate there, rad or m.
        side: +1 where larger coordinates are beyond it, -1 where smaller ones are.
        law: The force.
    """

    dof: int
    end: float
    side: int
    law: Law

    def __post_init__(self) -> None:
        set_fields(self, dof=count("dof", self.dof, minimum=0), end=number("end", self.end))
        if self.side not in (-1, 1):
            raise PlannerError(f"side is {self.side!r}, expected 1 or -1.")
