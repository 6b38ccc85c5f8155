"""Mechanism: a tree of links with joint screws (section 1.2 of the paper). Data only.

There is one link per degree of freedom, in MuJoCo's order of qvel, so that revolute, prismatic, ball and free joints
share one recursion (Fig. 2). A body with several joints is a chain of links of which only the last has mass; a body
without joints is merged into its parent link. Link i moves relative to its parent by

    T = T_home[i] exp(S[i] (q - q_home[i]))                        (SCREW: hinge or slide)
    T = T_home[i] exp of the rotation R(quaternion) about the anchor   (BALL)
    T = identity                                                   (BALL_NEXT, the ball's second and third axis)

with the screw in the moving frame. A free joint is three slides along the world's axes and a ball: then q, qd and qdd
are MuJoCo's qpos, qvel and qacc, world linear and body angular. All axes of a ball rotate
with it, so the derivative of its screws uses the twist of link `base`, the parent of the ball.

The applied force tau excludes the passive forces, which are part of the bias:

    M(q) qdd + bias(q, qd) = tau,   bias = Coriolis + gravity + damping qd + stiffness (q - spring_rest)
                                           - forces of tendons - gravity compensation - drag.

Friction loss is not part of the bias, since it depends on qdd (planner.dynamics.joint_forces).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import choice, first_of
from planner.base.errors import ModelError, PlannerError
from planner.model.actuators import Actuators
from planner.model.contact.body_contact import BodyContact, check_body_contact
from planner.model.contact.laws import Contact, ContactLaw, Stop, slide_direction
from planner.model.couplings import Coupling, LoopClosure, PolynomialCoupling, Reduction, reduce
from planner.model.passive_forces import Drag, ExponentialTorque, FixedTendon, check_curve
from planner.model.robot_collections import model_location
from planner.model.space import StateSpace
from planner.model.twin import origin_of
from planner.model.urdf.write import as_mjcf

SCREW, BALL, BALL_NEXT = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Frame:
    """A body or site with pose T (4, 4) in the frame of a link (-1: the world)."""

    link: int
    T: np.ndarray

    @classmethod
    def at(cls, link: int, point: Any, rotation: np.ndarray | None = None) -> Frame:
        """The frame at a point (3,) of a link, with the link's axes or with a rotation (3, 3) in them."""
        T = np.eye(4)
        T[:3, 3] = point
        if rotation is not None:
            T[:3, :3] = rotation
        return cls(link, T)


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A tree of links with joint screws. All arrays are float64 or int64, in C order and read-only."""

    nq: int  # size of qpos
    qpos0: np.ndarray  # (nq,) MuJoCo's qpos0, the initial configuration of the file
    parent: np.ndarray  # (nv,) parent link, -1 for the world; parents precede children
    base: np.ndarray  # (nv,) link of V_base in ad(V_base) S[i] qd[i]: the parent; of a ball, the ball's parent
    kind: np.ndarray  # (nv,) SCREW, BALL or BALL_NEXT
    q_address: np.ndarray  # (nv,) index of the coordinate in qpos; of a ball, the first of its quaternion
    T_home: np.ndarray  # (nv, 4, 4) pose in the parent's frame at q_home
    q_home: np.ndarray  # (nv,) rad or m, 0 for a ball
    S: np.ndarray  # (nv, 6) screw (angular, linear) in the link's own frame
    mass: np.ndarray  # (nv,) kg
    com: np.ndarray  # (nv, 3) centre of mass in the link's frame, m
    inertia: np.ndarray  # (nv, 3, 3) about the centre of mass, in the link's frame, kg m^2
    armature: np.ndarray  # (nv,) kg m^2 or kg, added to the diagonal of M
    damping: np.ndarray  # (nv,) N m s/rad or N s/m
    stiffness: np.ndarray  # (nv,) N m/rad or N/m, of hinges and slides (of free joints too); 0 on balls
    spring_rest: np.ndarray  # (nv,) rad or m
    ball_stiffness: np.ndarray  # (nballs,) N m/rad, in the order of `quaternions`
    ball_rest: np.ndarray  # (nballs, 4) quaternions at which the springs are relaxed
    gravity: np.ndarray  # (3,) m/s^2
    actuators: Actuators  # motors, servos and the like
    joint_names: tuple[str, ...]  # one per joint, "" if unnamed in the file
    joint_links: tuple[slice, ...]  # one per joint: its degrees of freedom
    joint_range: np.ndarray  # (nv, 2) rad or m, infinite if unlimited
    joint_force_range: np.ndarray  # (nv, 2) N m or N, of the sum of actuator forces (actuatorfrcrange)
    velocity_limit: np.ndarray  # (nv,) rad/s or m/s, infinite if unlimited
    friction_loss: np.ndarray  # (nv,) N m or N, MuJoCo's frictionloss; see planner.dynamics.joint_forces
    friction_inertia: np.ndarray  # (nv,) kg m^2 or kg, D in planner.dynamics.joint_forces
    friction_rate: np.ndarray  # (nv,) 1/s, beta in planner.dynamics.joint_forces
    gravcomp_mass: np.ndarray  # (nv,) kg, gravity-compensated mass of each link
    gravcomp_first_moment: np.ndarray  # (nv, 3) kg m, first moment of gravcomp_mass in the link's frame
    body_names: tuple[str, ...]  # MuJoCo's bodies in order, the world first
    bodies: tuple[Frame, ...]  # one per body name
    contacts: tuple[Contact, ...] = ()  # contacts of spheres and points with planes of the world
    stops: tuple[Stop, ...] = ()  # compliant joint stops
    sites: dict[str, Frame] = field(default_factory=dict)  # frames by name
    keyframes: dict[str, np.ndarray] = field(default_factory=dict)  # state (nx,) by name
    mjcf: str = ""  # XML text of the replay: includes resolved, ignored elements removed
    assets: dict[str, bytes] = field(default_factory=dict)  # content of the files that mjcf refers to, by name
    ignored: tuple[str, ...] = ()  # elements removed from the file, one phrase each
    original: str = ""  # XML text of the file, includes resolved, if `mjcf` was edited; else ""
    origin: dict[str, Any] = field(default_factory=dict)  # where it was read from: planner.model.twin
    body_contacts: tuple[BodyContact, ...] = ()  # contacts between spheres and capsules
    curves: tuple[ExponentialTorque, ...] = ()  # exponential torques; not in the MJCF
    tendons: tuple[FixedTendon, ...] = ()  # fixed tendons with a force or a range
    drags: tuple[Drag, ...] = ()  # of a fluid around the bodies
    couplings: tuple[Coupling, ...] = ()  # linear equations of hinge and slide coordinates, satisfied exactly
    loops: tuple[LoopClosure, ...] = ()  # pairs of frames that coincide
    polynomial_couplings: tuple[PolynomialCoupling, ...] = ()  # joint coordinates that are polynomials of others
    contacts_mode: str = ""  # "model", "ground", "file", "avoid", "off" or "law"; "" if no shapes can collide
    contacts_choice: str = ""  # sentence that explains contacts_mode, without a full stop; or ""

    def __post_init__(self) -> None:
        self._check_numbers()
        self._check_links()
        if self.couplings:
            _ = self.reduction  # raises for a contradiction
        self._protect()

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._protect()  # NumPy copies and unpickles arrays as writable

    def _protect(self) -> None:
        """Make all arrays read-only."""
        frames = (*self.bodies, *self.sites.values())
        wrenches = self.actuators.wrenches
        parts = [*vars(self).values(), *vars(self.actuators).values(), *(frame.T for frame in frames)]
        parts += [part for one in wrenches for part in vars(one).values()]
        for value in (*parts, *self.keyframes.values()):
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def _check_numbers(self) -> None:
        """Raise ModelError for joint or actuator values that are not finite, or negative where they must not be."""
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
        for law in self.actuators.laws:
            if not np.isfinite(law.numbers).all():
                actuator = self.actuators.names[law.actuator]
                raise ModelError(f"actuator {actuator!r} has a {law.kind} that is not finite, expected finite numbers.")

    def _check_links(self) -> None:
        """Raise PlannerError for a contact on a link without a body, or a stop or torque not on hinges and slides."""
        carriers = sorted({body.link for body in self.bodies} - {-1})
        for k, contact in enumerate(self.contacts):
            if contact.link not in carriers:  # of a body with several joints, only the last link has it
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
        cls, model: Any, *, ignore: Collection[str] | None = (), contacts: str | ContactLaw = "auto",
        assets: dict[str, bytes] | None = None, name: str = "", attach: Any = None, obstacles: Any = None,
        exclude: Any = None,
    ) -> Mechanism:  # fmt: skip
        """Read an MJCF file, text or spec with MuJoCo's compiler.

        Args:
            model: A path, the XML text itself, "robot_descriptions:NAME" of that package, a mujoco.MjSpec, or an
                element of dm_control.mjcf, whose whole model is read. A spec or element stays as it was, and later
                changes of it do not change the mechanism.
            ignore: Kinds of elements to remove, e.g. ("frictionloss",), also from the replayed model.
            contacts: Which contacts the plan models. "model": those whose MJCF parameters are a law of
                planner.model.contact.laws (see planner.model.mjcf.contacts): spheres, capsules and corners of boxes
                with planes, spheres and capsules with each other. "ground": bodies that can fall get
                ContactLaw.resting for their mass on planes, all other contacts are omitted. "file": contacts with
                planes at rest get the law that MuJoCo computes from the file's numbers
                (planner.model.mjcf.file_law), all others are omitted. "avoid" and "off": none.
                "auto": the first of "model", "file", "ground" and "avoid" that applies, see `contacts_choice`.
                A ContactLaw: that law for all contacts of modelled shapes. The plan's own model replays the modelled
                contacts; omitted ones are listed in `ignored` and checked in the user's file.
            assets: Content of the files that the text refers to, by name; if given, nothing is read from disk.
            name: Name of the model in messages; by default that of its file.
            attach: A payload or a tool at a frame, or a list of them: {"frame": "hand", "mass": 2.0}, with `size`,
                `com`, `inertia` and `name`; or {"frame": "hand", "model": "gripper.xml"}. See
                planner.model.mjcf.attached. It is part of the replay and of the user's model too.
            obstacles: A shape at rest, or a list of them: {"shape": "box", "size": [0.1, 0.4, 0.5], "position":
                [0.5, 0, 0.25]}, with `orientation`, `name`, and `file` and `scale` of a mesh. See
                planner.model.mjcf.obstacles. They are part of the replay and of the user's model too.
            exclude: Pairs of bodies, or of their shapes, that do not touch each other: [("palm", "thumb")].

        Raises:
            ModelError: The file cannot be read, MuJoCo rejects it, or it has elements that change the dynamics and
                are not modelled: all of them in one message.
        """
        from planner.model.mjcf.read import read  # local import: read imports Mechanism

        model = model_location(model)
        return read(
            model, ignore=ignore, contacts=contacts, assets=assets, name=name, attach=attach, obstacles=obstacles,
            exclude=exclude,
        )  # fmt: skip

    @classmethod
    def from_urdf(
        cls, model: str | Path, *, base: str | None = None, floor: bool = False, package_path: str | Sequence[str] = (),
        inertia: Any = "given", ignore: Collection[str] | None = (), contacts: str | ContactLaw = "auto",
        attach: Any = None, obstacles: Any = None, exclude: Any = None,
    ) -> Mechanism:  # fmt: skip
        """Read a URDF file or text: each link is a body, each one-coordinate joint gets a motor with its effort limit.

        A mimic joint gets an equality instead of a motor; the frame of a link on a fixed joint is preserved. The
        mechanism stores MJCF, and the velocity limits. Missing meshes, and meshes other than STL, OBJ, DAE and GLB, are
        omitted and listed in `ignored`, as are effort limits that are missing or 0.

        Args:
            model: A path, or the XML text itself.
            base: "fixed" or "free" root link; by default fixed, unless the file has a floating joint.
            floor: Add the plane z = 0; a floating base starts with its lowest shape on or above it.
            package_path: Folder of a package or of packages, or a list of these, searched for package:// first, then
                the folder of the file and its parents.
            inertia: "nearest" replaces a physically impossible inertia by the nearest possible one and lists it in
                `ignored`; "from shapes" gives links without <inertial> that of their shapes at 1000 kg/m^3, or at that
                of a table {"density": 2700}; "given" raises.
            ignore: See from_mjcf.
            contacts: See from_mjcf.
            attach: See from_mjcf.
            obstacles: See from_mjcf.
            exclude: See from_mjcf.

        Raises:
            ModelError: The file cannot be read, is no tree of links or is xacro; an inertia is physically impossible;
                a joint moves no inertia; or as from_mjcf.
        """
        model = model_location(model)
        mjcf, assets, name = as_mjcf(model, base, floor, package_path, inertia)
        mechanism = cls.from_mjcf(
            mjcf, ignore=ignore, contacts=contacts, assets=assets, name=name, attach=attach, obstacles=obstacles,
            exclude=exclude,
        )  # fmt: skip
        of_urdf = {"base": base, "floor": floor, "package_path": package_path, "inertia": inertia}
        return replace(mechanism, origin=origin_of(model, attach, obstacles, exclude, **of_urdf))

    def without_lead_stops(self) -> Mechanism:
        """The mechanism without stops with a lead, whose ranges are then bounds.

        Of prescribed joints: those are heavy in MuJoCo, and what its stops are relative to changes with them.
        """
        stops = tuple(stop for stop in self.stops if stop.law.lead == 0.0)
        return self if len(stops) == len(self.stops) else replace(self, stops=stops)

    def with_curves(self, curves: Iterable[ExponentialTorque]) -> Mechanism:
        """The same machine with these exponential torques in place of its own.

        Raises:
            PlannerError: A torque refers to a ball, or to a degree of freedom that does not exist.
        """
        return replace(self, curves=tuple(curves))

    @property
    def nv(self) -> int:
        """Number of degrees of freedom."""
        return len(self.parent)

    @property
    def velocities(self) -> slice:
        """Where a state (qpos, qvel, act) has qvel."""
        return slice(self.nq, self.nq + self.nv)

    def at_rest(self, xs: np.ndarray) -> np.ndarray:
        """A copy of states (..., nx) with velocities of zero."""
        xs = np.array(xs)
        xs[..., self.velocities] = 0.0
        return xs

    @property
    def nu(self) -> int:
        """Number of actuators."""
        return self.actuators.nu

    @property
    def na(self) -> int:
        """Number of activations."""
        return self.actuators.na

    @cached_property
    def quaternions(self) -> tuple[tuple[int, int], ...]:
        """(first index in qpos, first degree of freedom) of each ball, also of free joints."""
        return tuple((int(self.q_address[i]), int(i)) for i in np.flatnonzero(self.kind == BALL))

    @cached_property
    def directly_actuated(self) -> np.ndarray:
        """(nv,) bool, degrees of freedom with an actuator of their own, not only through couplings."""
        return np.any(self.actuators.acts_on, axis=0)

    @property
    def has_closed_chains(self) -> bool:
        """Whether there are loop closures or polynomial couplings."""
        return bool(self.loops or self.polynomial_couplings)

    @cached_property
    def reduction(self) -> Reduction | None:
        """Independent coordinates of the couplings, actuated ones preferred; None without couplings."""
        if not self.couplings:
            return None
        return reduce(self.couplings, self.nv, self.directly_actuated)

    @property
    def independent_directions(self) -> np.ndarray:
        """G (nv, nr), velocities qd = G z that satisfy the couplings; the identity without couplings."""
        return np.eye(self.nv) if self.reduction is None else self.reduction.G

    @property
    def independent_dofs(self) -> np.ndarray:
        """(nr,) indices of the independent degrees of freedom z; all without couplings."""
        return np.arange(self.nv) if self.reduction is None else self.reduction.independent

    @cached_property
    def space(self) -> StateSpace:
        """The space of states x = (qpos, qvel, act)."""
        return StateSpace(self.nq + self.nv + self.na, 2 * self.nv + self.na, self.quaternions)

    @cached_property
    def home(self) -> np.ndarray:
        """The state (nx,) at qpos0 with zero velocity and activation."""
        x = np.zeros(self.space.nx)
        x[: self.nq] = self.qpos0
        return x

    def keyframe(self, name: str) -> np.ndarray:
        """State (nx,) of a keyframe of the model.

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

    def body_of(self, link: int) -> str:
        """The name of the body that a link's joints move, "" where it has none."""
        return next((name for name, body in zip(self.body_names, self.bodies, strict=True) if body.link == link), "")

    def joint(self, name: str) -> slice:
        """The degrees of freedom of a joint.

        Raises:
            PlannerError: There is no joint of that name.
        """
        return self.joint_links[self.joint_names.index(choice("joint", name, [n for n in self.joint_names if n]))]

    def joint_of(self, dof: int) -> str:
        """The joint of a degree of freedom, for messages: "joint 'hip'"."""
        place = next(k for k, links in enumerate(self.joint_links) if links.start <= dof < links.stop)
        name = self.joint_names[place]
        return f"joint {name!r}" if name else f"joint number {place}"

    def __str__(self) -> str:
        names = [name or "unnamed" for name in self.joint_names]
        bodies = len(self.bodies) - 1
        return (
            f"Mechanism({self.nv} degree{'s' * (self.nv != 1)} of freedom, {self.nu} actuator{'s' * (self.nu != 1)}, "
            f"{bodies} bod{'y' if bodies == 1 else 'ies'}, joints: {first_of(names, 10)})"
        )

    __repr__ = __str__
