"""Mechanism: a machine as the paper sees it, a tree of links on screws (section 1.2). Data only.

There is one link per degree of freedom, in MuJoCo's order of qvel, so that revolute, prismatic, ball and free joints
go through one recursion (Fig. 2). A body with several joints is a chain of links of which only the last has mass; a
body without joints is part of the link that carries it. Link i moves relative to its parent by

    T = T_home[i] exp(S[i] (q - q_home[i]))                        (SCREW: hinge or slide)
    T = T_home[i] exp of the rotation R(quaternion) about the anchor   (BALL)
    T = identity                                                   (BALL_NEXT, the ball's second and third axis)

with the screw in the moving frame. A free joint is three slides along the world's axes and a ball: then q, qd and qdd
are MuJoCo's qpos, qvel and qacc, world linear and body angular. All axes of a ball turn with it, so
the rate of its screws is taken with the twist before the ball, which is what `base` says.

The applied force tau excludes what the mechanism itself does:

    M(q) qdd + bias(q, qd) = tau,   bias = Coriolis + gravity + damping qd + stiffness (q - spring_rest)
                                           - forces of tendons - gravity compensation.

Friction loss acts in the motion but is no part of this, since it depends on qdd (planner.dynamics.friction).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import choice
from planner.base.errors import ModelError, PlannerError
from planner.model.actuators import Actuators
from planner.model.contact.body_contact import BodyContact, check_body_contact
from planner.model.contact.laws import Contact, ContactLaw, Stop, slide_direction
from planner.model.couplings import Coupling, Reduction, reduce
from planner.model.exponential_torques import ExponentialTorque, check_curve
from planner.model.loops import LoopClosure, PolynomialCoupling
from planner.model.space import StateSpace
from planner.model.tendons import FixedTendon
from planner.model.urdf.write import as_mjcf

SCREW, BALL, BALL_NEXT = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Frame:
    """A body or site: fixed at T (4, 4) to a link (-1: the world)."""

    link: int
    T: np.ndarray


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A tree of links on screws. All arrays are float64 or int64, in C order and read-only."""

    nq: int  # Size of qpos
    qpos0: np.ndarray  # (nq,) where the file puts the joints
    parent: np.ndarray  # (nv,) link that carries link i, -1 for the world; parents come first
    base: np.ndarray  # (nv,) link whose twist turns the screw of link i: the parent, or what carries the ball
    kind: np.ndarray  # (nv,) SCREW, BALL or BALL_NEXT
    q_address: np.ndarray  # (nv,) where qpos holds the coordinate; for a ball, the first of its quaternion
    T_home: np.ndarray  # (nv, 4, 4) pose in the parent's frame at q_home
    q_home: np.ndarray  # (nv,) rad or m, 0 for a ball
    S: np.ndarray  # (nv, 6) screw (angular, linear) in the link's own frame
    mass: np.ndarray  # (nv,) kg
    com: np.ndarray  # (nv, 3) centre of mass in the link's frame, m
    inertia: np.ndarray  # (nv, 3, 3) about the centre of mass, in the link's frame, kg m^2
    armature: np.ndarray  # (nv,) added to the diagonal of M
    damping: np.ndarray  # (nv,)
    stiffness: np.ndarray  # (nv,) of hinge, slide and the slides of a free joint; 0 on balls
    spring_rest: np.ndarray  # (nv,) rad or m
    ball_stiffness: np.ndarray  # (nballs,) of the balls in the order of `quaternions`
    ball_rest: np.ndarray  # (nballs, 4) quaternions at rest
    gravity: np.ndarray  # (3,) m/s^2
    actuators: Actuators  # Its motors, servos and the like
    joint_names: tuple[str, ...]  # One per joint, "" where the file gives none
    joint_links: tuple[slice, ...]  # One per joint: its links, a slice of the degrees of freedom
    joint_range: np.ndarray  # (nv, 2) infinite where there is none
    joint_force_range: np.ndarray  # (nv, 2) of the sum of actuator forces (actuatorfrcrange)
    velocity_limit: np.ndarray  # (nv,) rad/s or m/s, infinite where there is none
    friction_loss: np.ndarray  # (nv,) N m or N, the largest friction; see planner.dynamics.friction
    friction_inertia: np.ndarray  # (nv,) kg m^2 or kg, by which friction holds it below that
    friction_rate: np.ndarray  # (nv,) 1/s, of the damper beside that inertia
    gravcomp_mass: np.ndarray  # (nv,) kg of a link whose weight gravity compensation carries
    gravcomp_first_moment: np.ndarray  # (nv, 3) its first moment in the link's frame, kg m
    body_names: tuple[str, ...]  # MuJoCo's bodies in order, the world first
    bodies: tuple[Frame, ...]  # Their frames
    contacts: tuple[Contact, ...] = ()  # Spheres and points that touch planes of the world
    stops: tuple[Stop, ...] = ()  # Ends of joints that push back
    sites: dict[str, Frame] = field(default_factory=dict)  # Frames by name
    keyframes: dict[str, np.ndarray] = field(default_factory=dict)  # State (nx,) by name
    mjcf: str = ""  # The XML text that a replay uses: includes resolved, ignored elements taken out
    assets: dict[str, bytes] = field(default_factory=dict)  # Files that the text names, by the name it uses
    ignored: tuple[str, ...] = ()  # Elements taken out of the file, one phrase each
    original: str = ""  # The XML text as the file gave it, includes resolved, where `mjcf` was edited; else ""
    body_contacts: tuple[BodyContact, ...] = ()  # Spheres and capsules that touch each other
    curves: tuple[ExponentialTorque, ...] = ()  # Of coordinates; the file knows nothing of them
    tendons: tuple[FixedTendon, ...] = ()  # Fixed tendons with a force or a range
    couplings: tuple[Coupling, ...] = ()  # Equations that are linear in hinge and slide coordinates, kept exactly
    loops: tuple[LoopClosure, ...] = ()  # Frames that are held together, so that chains close
    polynomial_couplings: tuple[PolynomialCoupling, ...] = ()  # Joints that follow others by polynomials
    contacts_mode: str = ""  # "model", "ground", "avoid", "off" or "law"; "" where no shapes can touch
    contacts_choice: str = ""  # A sentence about it, without a full stop; "" where there is nothing to say

    def __post_init__(self) -> None:
        self._check_numbers()
        self._check_links()
        if self.couplings:
            _ = self.reduction  # raises for a contradiction
        self._protect()

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._protect()  # NumPy copies and pickles arrays without that

    def _protect(self) -> None:
        """Make all arrays read-only."""
        frames = (*self.bodies, *self.sites.values())
        parts = [*vars(self).values(), *vars(self.actuators).values(), *(frame.T for frame in frames)]
        for value in (*parts, *self.keyframes.values()):
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def _check_numbers(self) -> None:
        """Raise ModelError for a number of a joint or an actuator that is not finite, or negative and must not be."""
        for name in ("armature", "damping", "stiffness", "friction_loss", "friction_rate"):
            values = getattr(self, name)
            for dof in np.flatnonzero(~(np.isfinite(values) & (values >= 0.0)))[:1]:
                raise ModelError(
                    f"{self.joint_of(dof)} has {name} {values[dof]:g}, expected a finite number of at least 0."
                )
        for name in ("moment", "gain", "bias"):
            for a, *_ in np.argwhere(~np.isfinite(getattr(self.actuators, name)))[:1]:
                actuator = self.actuators.names[a]
                raise ModelError(f"actuator {actuator!r} has a {name} that is not finite, expected finite numbers.")

    def _check_links(self) -> None:
        """Raise PlannerError for a contact, stop or torque on a link or degree of freedom that cannot have it."""
        carriers = sorted({body.link for body in self.bodies} - {-1})
        for k, contact in enumerate(self.contacts):
            if contact.link not in carriers:  # of several joints of a body, the last one carries it
                raise PlannerError(f"contacts[{k}] is of link {contact.link}, expected one with a body: {carriers}.")
            slide_direction(self, contact.plane)
        for k, pair in enumerate(self.body_contacts):
            check_body_contact(pair, carriers, f"body_contacts[{k}]")
        screws = self.kind == SCREW
        for k, stop in enumerate(self.stops):
            if not (stop.dof < self.nv and screws[stop.dof]):
                raise PlannerError(
                    f"stops[{k}] is of dof {stop.dof}, expected one of a hinge or slide, below {self.nv}."
                )
        for k, curve in enumerate(self.curves):
            check_curve(curve, screws, f"curves[{k}]")

    @classmethod
    def from_mjcf(
        cls, model: str | Path, *, ignore: Collection[str] | None = (), contacts: str | ContactLaw = "auto",
        assets: dict[str, bytes] | None = None, name: str = "", attach: Any = None,
    ) -> Mechanism:  # fmt: skip
        """Read an MJCF file or text as MuJoCo's compiler understands it.

        Args:
            model: A path, or the XML text itself.
            ignore: Kinds of elements to take out, e.g. ("frictionloss",): in the replayed model too.
            contacts: How contacts are planned. "model": with the file's own law, where that is a law of
                planner.model.contact.laws (see planner.model.mjcf.contacts): of spheres, capsules and corners of boxes
                with planes, and of spheres and capsules with each other. "ground": what can fall gets
                ContactLaw.resting for its mass where it meets a plane; all other contacts are left out. "avoid": all
                of them are left out, as with "off". "auto" chooses the first of "model", "ground" and "avoid" that
                fits: see `contacts_choice`. A ContactLaw is given to all contacts whose shapes are modelled. What is
                planned is replayed in the plan's own model; what is left out is said in `ignored`, and judged in the
                user's file.
            assets: Files by the names that the text uses for them; then nothing is read from disk.
            name: Of the model in messages; by default that of its file.
            attach: A payload or a tool at a frame, or a list of them: {"frame": "hand", "mass": 2.0}, with `size`,
                `com`, `inertia` and `name`; or {"frame": "hand", "model": "gripper.xml"}. See
                planner.model.mjcf.attached. The replay and the user's file carry it too.

        Raises:
            ModelError: A file that cannot be read, that MuJoCo refuses, or with elements that change the motion
                and are not modelled: all of them in one message.
        """
        from planner.model.mjcf.read import read  # read imports Mechanism: the one exception to the order of folders

        return read(model, ignore=ignore, contacts=contacts, assets=assets, name=name, attach=attach)

    @classmethod
    def from_urdf(
        cls, model: str | Path, *, base: str | None = None, floor: bool = False, package_path: str | Sequence[str] = (),
        inertia: str = "given", ignore: Collection[str] | None = (), contacts: str | ContactLaw = "auto",
        attach: Any = None,
    ) -> Mechanism:  # fmt: skip
        """Read a URDF file or text: each link is a body, each joint with one coordinate has a motor within its effort.

        A mimic joint has no motor and an equality instead, a fixed joint keeps its link's frame. The mechanism keeps
        MJCF, with the velocity limits. Meshes that are missing, or of another kind than STL, OBJ, DAE and GLB, are left
        out and said in `ignored`; so are effort limits that the file does not give, or gives as 0.

        Args:
            model: A path, or the XML text itself.
            base: "fixed" or "free", what the root link is; by default fixed, but for a floating joint of the file.
            floor: Add the plane z = 0; what floats starts above it, its lowest shape at least on it.
            package_path: Folder of a package, or of packages, or a list of such: package:// is sought there first,
                then beside the file and in the folders above it.
            inertia: "nearest" replaces an inertia that no body has by the nearest that one can have, and says so in
                `ignored`; "given" refuses it.
            ignore: As from_mjcf has it.
            contacts: As from_mjcf has it.
            attach: As from_mjcf has it.

        Raises:
            ModelError: A file that cannot be read or is no tree of links, xacro, an inertia that no body has, a joint
                that moves no inertia, or what from_mjcf raises.
        """
        mjcf, assets, name = as_mjcf(model, base, floor, package_path, inertia)
        return cls.from_mjcf(mjcf, ignore=ignore, contacts=contacts, assets=assets, name=name, attach=attach)

    def with_curves(self, curves: Iterable[ExponentialTorque]) -> Mechanism:
        """The same machine with torques that are exponentials of its coordinates, in place of those it has.

        Raises:
            PlannerError: One of them is of a ball, or of a degree of freedom that there is not.
        """
        return replace(self, curves=tuple(curves))

    @property
    def nv(self) -> int:
        """Degrees of freedom."""
        return len(self.parent)

    @property
    def nu(self) -> int:
        """Actuators."""
        return self.actuators.nu

    @property
    def na(self) -> int:
        """Activations."""
        return self.actuators.na

    @cached_property
    def quaternions(self) -> tuple[tuple[int, int], ...]:
        """(address in qpos, first degree of freedom) of each ball."""
        return tuple((int(self.q_address[i]), int(i)) for i in np.flatnonzero(self.kind == BALL))

    @cached_property
    def directly_actuated(self) -> np.ndarray:
        """(nv,) bool, the degrees of freedom that an actuator acts on; those that follow them by couplings are not."""
        return np.any(self.actuators.moment != 0.0, axis=0)

    @property
    def has_closed_chains(self) -> bool:
        """Whether loops or polynomial couplings constrain the coordinates that the linear couplings leave."""
        return bool(self.loops or self.polynomial_couplings)

    @cached_property
    def reduction(self) -> Reduction | None:
        """The coordinates that the couplings leave free; those with actuators before others. None without couplings."""
        if not self.couplings:
            return None
        return reduce(self.couplings, self.nv, self.directly_actuated)

    @cached_property
    def space(self) -> StateSpace:
        """The space of states x = (qpos, qvel, act)."""
        return StateSpace(self.nq + self.nv + self.na, 2 * self.nv + self.na, self.quaternions)

    @cached_property
    def home(self) -> np.ndarray:
        """(nx,) the state the file describes, at rest."""
        x = np.zeros(self.space.nx)
        x[: self.nq] = self.qpos0
        return x

    def keyframe(self, name: str) -> np.ndarray:
        """State (nx,) of a keyframe of the file.

        Raises:
            PlannerError: There is no keyframe of that name.
        """
        if not self.keyframes:
            raise PlannerError(f"the model has no keyframes, so none is named {name!r}: expected a state vector.")
        return self.keyframes[choice("keyframe", name, self.keyframes)].copy()

    def frame(self, name: str) -> Frame:
        """A site or body by name.

        Raises:
            PlannerError: There is neither a site nor a body of that name.
        """
        if isinstance(name, str) and name in self.sites:
            return self.sites[name]
        named = [body for body in self.body_names if body]
        return self.bodies[self.body_names.index(choice("frame", name, [*self.sites, *named]))]

    def joint(self, name: str) -> slice:
        """The degrees of freedom of a joint.

        Raises:
            PlannerError: There is no joint of that name.
        """
        return self.joint_links[self.joint_names.index(choice("joint", name, [n for n in self.joint_names if n]))]

    def joint_of(self, dof: int) -> str:
        """A degree of freedom's joint in a sentence: "joint 'hip'"."""
        place = next(k for k, links in enumerate(self.joint_links) if links.start <= dof < links.stop)
        name = self.joint_names[place]
        return f"joint {name!r}" if name else f"joint number {place}"

    def __str__(self) -> str:
        names = [name or "unnamed" for name in self.joint_names]
        joints = ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")
        bodies = len(self.bodies) - 1
        return (
            f"Mechanism({self.nv} degree{'s' * (self.nv != 1)} of freedom, {self.nu} actuator{'s' * (self.nu != 1)}, "
            f"{bodies} bod{'y' if bodies == 1 else 'ies'}, joints: {joints})"
        )

    __repr__ = __str__
