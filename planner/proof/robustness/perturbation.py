"""The errors of step 5 of a proof: their sizes, how they are drawn for a rollout, and a MuJoCo model with them.

A rollout draws everything from default_rng([seed, k]), k its number, in a fixed order independent of the switches: it
does not depend on other rollouts, and switching off one kind of error does not change the others. Errors may also be
given instead of drawn: relative mass error, friction. Pushes are forces on bodies for a time.
"""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from planner.base.arguments import array, number, short_repr
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.model.mjcf.prescribed_joints import PRESCRIBED_ARMATURE, prescribed_dofs_of
from planner.model.twin import Twin
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.simulation import Step, set_state

DURATION = 0.1  # s, default duration of a push
_WORD = re.compile(r"^(?P<body>[^=]+)=(?P<force>[^@]*?)N?@(?P<time>[^@/]+?)s?(?:/(?P<duration>[^@/]+?)s?)?$")


@dataclass(frozen=True, eq=False)
class Push:
    """A force at a body.

    Attributes:
        body: Name of a body of the simulated model.
        force: (3,) N in the world's axes at the body's centre of mass; a number is along x.
        time: s, when it begins.
        duration: s.

    Raises:
        PlannerError: A force that is no number or three, a time below 0, a duration that is not above it.
    """

    body: str
    force: Any
    time: float
    duration: float = DURATION

    def __post_init__(self) -> None:
        force = np.array([self.force, 0.0, 0.0]) if np.ndim(self.force) == 0 else self.force
        object.__setattr__(self, "force", array("the force of a push", force, (3,)))
        object.__setattr__(self, "time", number("the time of a push", self.time, minimum=0.0))
        object.__setattr__(self, "duration", number("the duration of a push", self.duration, greater_than=0.0))

    @classmethod
    def parse(cls, text: str) -> Push:
        """A push from "torso=50N@1.0s" or "torso=0,50,0N@1.0s/0.2s": along x, or along three axes, and how long."""
        found = _WORD.match(text.strip())
        try:
            if found is None:
                raise ValueError
            force = [float(part) for part in found["force"].split(",")]
            duration = DURATION if found["duration"] is None else float(found["duration"])
            time = float(found["time"])
        except ValueError:
            expected = "expected BODY=FORCE@TIME, e.g. torso=50N@1.0s, or torso=0,50,0N@1.0s/0.2s with its duration"
            raise PlannerError(f"the push is {short_repr(text)}, {expected}.") from None
        return cls(found["body"], force[0] if len(force) == 1 else force, time, duration)

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {"body": self.body, "force": self.force.tolist(), "time": self.time, "duration": self.duration}

    def __str__(self) -> str:
        force = self.force[0] if not self.force[1:].any() else ",".join(f"{one:g}" for one in self.force)
        force = f"{force:g}" if isinstance(force, float) else force
        return f"{self.body}={force}N@{self.time:g}s/{self.duration:g}s"


def bodies_of(model: Any) -> list[str]:
    """Names of the bodies of MuJoCo's model that can be pushed: those that are not part of the world."""
    return [model.body(i).name for i in range(1, model.nbody) if model.body_weldid[i] and model.body(i).name]


def pushed_step(
    model: Any, pushes: Sequence[Push], step: Step | None = None, until: float = math.inf
) -> Step | None:  # fmt: skip
    """A step function for MuJoCo's data with pushes applied; `step` itself where there are none.

    A push acts over the whole steps that begin within it.

    Raises:
        PlannerError: A body that the model does not have, or a push that begins when the run has ended, `until` s.
    """
    known = bodies_of(model)
    for push in pushes:
        if push.body not in known:
            raise PlannerError(
                f"there is no body {push.body!r} to push, expected one of: {', '.join(known) or 'none has a name'}."
            )
        if push.time >= until:
            raise PlannerError(
                f"the push of {push.body!r} begins at {push.time:g} s, and the run ends at {until:g} s: expected an "
                "earlier time, or a longer run."
            )
    if not pushes:
        return step
    mujoco, half = load_mujoco(), 0.5 * model.opt.timestep
    rows = [(model.body(push.body).id, push.force, push.time, push.time + push.duration) for push in pushes]

    def move(data: Any) -> None:
        data.xfrc_applied[:] = 0.0
        now = data.time + half  # so that rounding does not decide at the ends of steps
        for body, force, begins, ends in rows:
            if begins < now < ends:
                data.xfrc_applied[body, :3] += force
        if step is None:
            mujoco.mj_step(model, data)
        else:
            step(data)

    return move


_FACTORS = ("mass", "inertia", "damping", "stiffness", "contact_friction", "common_mass", "common_stiffness")
_LARGEST = {"floor": 1.0, "drag": 1e6, "friction": 1e3, "start": 1e3, "noise": 1e3, "delay": 10.0}  # upper limits
_MAX_KNOTS = 200  # number of the plan's knots at which its largest forces are evaluated


@dataclass(frozen=True)
class Perturbation:
    """Sizes of the simulated machine's deviations from the planned one. All zero: none.

    The defaults are those of a machine with measured but not identified parameters: masses as from CAD, good
    bearings, calibrated encoders, a controller at 500 Hz.

    Attributes:
        mass: Each body's mass is scaled by a factor uniform in 1 +- this, and its inertia with it.
        inertia: Each body's inertia is scaled, as a whole, by another factor uniform in 1 +- this.
        damping: The damping that the model has in a joint is scaled by a factor uniform in 1 +- this.
        drag: Damping added to a joint, uniform in 0 to this times the inertia it moves (MuJoCo's dof_M0), 1/s: the
            rate at which its speed would decay. Free joints and joints with prescribed acceleration have none.
        friction: Dry friction added to a joint, uniform in 0 to this times the plan's largest force at that joint
            (actuator, or weight with Coriolis forces). Free and prescribed joints have none.
        contact_friction: All friction coefficients of contacts are scaled by one factor uniform in 1 +- this.
        floor: All planes of the world are higher by one number uniform in +- this, m. The start is that of the plan.
        start: Standard deviation of the start from the plan's, in each direction, in its unit.
        noise: Standard deviation of white noise on a control, constant over a stage, relative to the control's largest
            magnitude in the plan; of a servo, to its largest force over its gain.
        delay: Delay of the controls, uniform in 0 to this, s, in whole steps of the simulator. Until then the first
            ones are applied.
        stiffness: The stiffness of a joint's spring is scaled by a factor uniform in 1 +- this.
        common_mass: All bodies' masses and inertias are scaled by one more common factor uniform in 1 +- this, e.g. for
            a patient of unknown weight.
        common_stiffness: The same of all joints' springs.

    Raises:
        PlannerError: A number that is negative, not finite or too large, or a factor that could reach zero.
    """

    mass: float = 0.05
    inertia: float = 0.05
    damping: float = 0.2
    drag: float = 0.01
    friction: float = 0.002
    contact_friction: float = 0.2
    floor: float = 0.005
    start: float = 0.002
    noise: float = 0.01
    delay: float = 0.002
    stiffness: float = 0.0
    common_mass: float = 0.0
    common_stiffness: float = 0.0

    def __post_init__(self) -> None:
        for one in fields(self):
            most = 0.99 if one.name in _FACTORS else _LARGEST[one.name]
            value = number(f"Perturbation: {one.name}", getattr(self, one.name), minimum=0.0, maximum=most)
            object.__setattr__(self, one.name, value)

    @classmethod
    def usual(cls, problem: Problem | None, **changes: float) -> Perturbation:
        """The perturbation in a problem's requirements, else the default; with `changes`."""
        own = None if problem is None else problem.requirements
        return cls(**{**({} if own is None else own.perturbation), **changes})

    def to_dict(self) -> dict[str, float]:
        """The numbers by name."""
        return asdict(self)

    def __str__(self) -> str:
        units = {"drag": " 1/s", "floor": " m", "start": " in each coordinate's unit", "delay": " s"}
        parts = [
            f"{name.replace('_', ' ')} {value:.3g}{units[name]}" if name in units
            else f"{name.replace('_', ' ')} {100.0 * value:.3g} %"
            for name, value in self.to_dict().items() if value
        ]  # fmt: skip
        return ", ".join(parts) or "nothing"


@dataclass(frozen=True, eq=False)
class PerturbationSample:
    """The errors of one rollout."""

    mass: np.ndarray  # (nbody,) factors
    inertia: np.ndarray  # (nbody,) factors, in addition to those of the masses
    damping: np.ndarray  # (nv,) factors
    drag: np.ndarray  # (nv,) 1/s
    friction: np.ndarray  # (nv,) fractions of the largest force
    contact_friction: float  # Factor
    start: np.ndarray  # (ndx,) deviation from the plan's start
    noise: np.ndarray  # (N, nu) fractions of the largest control
    delay: float  # s
    stiffness: np.ndarray  # (njnt,) factors
    floor: float = 0.0  # m, by which planes are higher


@dataclass(frozen=True)
class SampleShape:
    """Sizes of the arrays of a Draw: nbody, nv and njnt are the model's, the others the plan's."""

    nbody: int
    nv: int
    ndx: int
    N: int
    nu: int
    njnt: int = 0


def draw(perturbation: Perturbation, seed: int, k: int, sizes: SampleShape) -> PerturbationSample:
    """The errors of rollout k."""
    rng, p = np.random.default_rng([seed, k]), perturbation
    own = PerturbationSample(
        mass=1.0 + p.mass * rng.uniform(-1.0, 1.0, sizes.nbody),
        inertia=1.0 + p.inertia * rng.uniform(-1.0, 1.0, sizes.nbody),
        damping=1.0 + p.damping * rng.uniform(-1.0, 1.0, sizes.nv),
        drag=p.drag * rng.random(sizes.nv),
        friction=p.friction * rng.random(sizes.nv),
        contact_friction=1.0 + p.contact_friction * rng.uniform(-1.0, 1.0),
        start=p.start * rng.standard_normal(sizes.ndx),
        delay=p.delay * rng.random(),
        noise=p.noise * rng.standard_normal((sizes.N, sizes.nu)),
        stiffness=1.0 + p.stiffness * rng.uniform(-1.0, 1.0, sizes.njnt),
    )
    heavier, stiffer = 1.0 + np.array([p.common_mass, p.common_stiffness]) * rng.uniform(-1.0, 1.0, 2)
    floor = p.floor * rng.uniform(-1.0, 1.0)
    return replace(own, mass=heavier * own.mass, stiffness=stiffer * own.stiffness, floor=floor)


def draw_masses(error: float, seed: int, level: int, k: int, sizes: SampleShape) -> PerturbationSample:
    """Masses and inertias scaled by 1 + error or 1 - error, the sign at random per body; no other errors."""
    rng = np.random.default_rng([seed, k, 1 + level])  # not [.., 0]: equal to [seed, k] in NumPy
    none = draw(Perturbation(**dict.fromkeys((one.name for one in fields(Perturbation)), 0.0)), seed, k, sizes)
    return PerturbationSample(**{**vars(none), "mass": 1.0 + error * rng.choice([-1.0, 1.0], sizes.nbody)})


@dataclass(frozen=True, eq=False)
class Nominal:
    """The planned machine, and the scales of its errors."""

    model: Any  # MuJoCo's
    load: np.ndarray  # (nv,) the largest generalized force along the plan, N m or N
    control: np.ndarray  # (nu,) the largest magnitude of each control; of a servo, of its force over its gain
    sizes: SampleShape  # Of a draw
    # Degrees of freedom whose accelerations the plan prescribes.
    driven: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))

    @classmethod
    def of(cls, model: Any, plan: Plan, twin: Twin) -> Nominal:
        """From a plan and the model to simulate it in."""
        sizes = SampleShape(model.nbody, model.nv, plan.space.ndx, plan.N, model.nu, model.njnt)
        driven = prescribed_dofs_of(getattr(plan.problem, "dynamics", None))
        load, force = _loads(model, plan, twin)
        control, gain = np.abs(plan.us).max(axis=0), np.abs(model.actuator_gainprm[:, 0])
        # Of a stiff servo 1 % of its position is most of its force: its noise is relative to the force, as a motor's.
        servo = np.any(model.actuator_biasprm[:, 1:3] != 0.0, axis=1) & (gain > 0.0)
        control[: model.nu][servo] = force[servo] / gain[servo]
        return cls(model, load, control, sizes, driven)

    @cached_property
    def _in_joints(self) -> np.ndarray:
        """(nv,) 1 for degrees of freedom with joint friction, 0 for those of free and prescribed joints."""
        free = load_mujoco().mjtJoint.mjJNT_FREE
        bearings = self.model.jnt_type[self.model.dof_jntid] != free
        bearings[self.driven] = False
        bearings[self.model.dof_armature == PRESCRIBED_ARMATURE] = False  # prescribed by jerk
        return bearings.astype(float)

    @property
    def ignores_friction(self) -> bool:
        """Whether the model's flags switch dry friction in joints off."""
        bits = load_mujoco().mjtDisableBit
        return bool(self.model.opt.disableflags & (bits.mjDSBL_FRICTIONLOSS | bits.mjDSBL_CONSTRAINT))

    def with_errors(self, draw: PerturbationSample, data: Any) -> Any:
        """A copy of the model with these errors; `data` is overwritten."""
        mujoco, nominal = load_mujoco(), self.model
        moves = nominal.body_weldid != 0  # inertia of bodies welded to the world has no effect
        model = copy.copy(nominal)
        model.body_mass[moves] *= draw.mass[moves]
        model.body_inertia[moves] *= (draw.mass * draw.inertia)[moves, None]
        # Implicit integration needs nonzero damping, so zero added damping must leave it exactly zero.
        model.dof_damping[:] = nominal.dof_damping * draw.damping + draw.drag * nominal.dof_M0 * self._in_joints
        model.dof_frictionloss[:] += draw.friction * self.load * self._in_joints
        model.jnt_stiffness[:] *= draw.stiffness
        model.geom_friction[:] *= draw.contact_friction
        model.pair_friction[:] *= draw.contact_friction
        rests = nominal.body_weldid[nominal.geom_bodyid] == 0
        planes = np.flatnonzero((nominal.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & rests)
        mujoco.mj_kinematics(nominal, data)  # z of the world in the frames of the bodies that carry the planes
        model.geom_pos[planes] += draw.floor * data.xmat[nominal.geom_bodyid[planes], 6:]
        model.geom_sameframe[planes] = 0  # else MuJoCo takes a plane at the origin to be there still
        try:
            mujoco.mj_setConst(model, data)  # contact stiffness depends on inertias, which MuJoCo caches
        except (ValueError, RuntimeError, mujoco.FatalError) as error:
            raise PlannerError(f"MuJoCo refuses the perturbed model: {' '.join(str(error).split())}") from None
        return model


def _loads(model: Any, plan: Plan, twin: Twin) -> tuple[np.ndarray, np.ndarray]:
    """Largest actuator force, or weight with Coriolis force, over knots of the plan (nv,); of each actuator (nu,)."""
    mujoco = load_mujoco()
    data, loads, forces = mujoco.MjData(model), np.zeros(model.nv), np.zeros(model.nu)
    for n in np.unique(np.linspace(0, plan.N - 1, _MAX_KNOTS).round().astype(int)):
        set_state(model, data, twin.sim_of(plan.xs[n]))
        data.ctrl[:] = plan.us[n]
        mujoco.mj_forward(model, data)
        loads = np.maximum(loads, np.maximum(np.abs(data.qfrc_bias), np.abs(data.qfrc_actuator)))
        forces = np.maximum(forces, np.abs(data.actuator_force))
    return loads, forces


Mass = float | Mapping[str, float]


def with_stated_errors(
    compiled: CompiledTwin, plan: Plan, model: Any, mass: Mass, friction: float, contact_friction: float
) -> Any:
    """MuJoCo's model with errors; the model itself where there are none.

    Args:
        compiled: The twin.
        plan: Its largest forces scale the friction.
        model: The twin's MuJoCo model at the simulated step.
        mass: Relative error of all masses, inertias with them, or of bodies by name.
        friction: Dry friction in every joint, relative to the plan's largest force at that joint.
        contact_friction: Relative error of the coefficients of contacts.

    Raises:
        PlannerError: A body that the model does not have, a mass that is not above zero.
    """
    friction = number("friction", friction, minimum=0.0, maximum=1e3)
    change = number("contact_friction", contact_friction, greater_than=-1.0, maximum=1e3)
    factors = np.ones(model.nbody)
    if isinstance(mass, Mapping):
        known = bodies_of(model)
        for body, error in mass.items():
            if body not in known:
                raise PlannerError(f"mass names the body {body!r}, expected one of: {', '.join(known)}.")
            factors[model.body(body).id] += number(f"the mass error of {body}", error, greater_than=-1.0, maximum=1e3)
    else:
        factors += number("mass", mass, greater_than=-1.0, maximum=1e3)
    if np.all(factors == 1.0) and not friction and not change:
        return model
    one = np.ones(model.nv)
    draw = PerturbationSample(
        mass=factors, inertia=np.ones(model.nbody), damping=one, drag=0.0 * one, friction=friction * one,
        contact_friction=1.0 + change, start=np.zeros(plan.space.ndx), noise=np.zeros((0, 0)), delay=0.0,
        stiffness=np.ones(model.njnt),
    )  # fmt: skip
    return Nominal.of(model, plan, compiled.twin).with_errors(draw, load_mujoco().MjData(model))
