"""Dive: the data of a flight, its cost, and first controls that turn the diver the right number of times.

    J = 1/2 (dx_N' F dx_N) + 1/2 sum dt (r |u|^2 + p s(t) |(q - q_mid) / half range|^2 + c |joint rates|^2)

F weighs the angles of pelvis and joints and the rates of the joints; s removes the posture term at both ends.

An orientation does not count turns: 1 1/2 somersaults with 1 twist end like 1/2 somersault with none, and the cost
measures the shortest rotation to the goal. So a homotopy sets the count: the goal starts where a stiff body arrives and
moves to its place by at most 0.6 rad per solve; each solve starts from the controls of the one before. These solves use
few stages; a rollout with the gains of the last one gives the first controls at the requested stages.

The diver is a model for a person's mass and height:

number                       value             from
masses, lengths, inertias    shares of M, H    Winter, see anthropometry.py
ranges of the joints         RANGES            ours: usual ranges of motion, rounded
straight body                arms overhead     ours: all other joint angles are zero

The frames of the bodies are those of anthropometry.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from xml.etree import ElementTree

import numpy as np

from planner.base.arguments import number
from planner.cases import anthropometry as winter
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import rnea
from planner.dynamics.kinematics import center_of_mass
from planner.dynamics.protocol import rollout_states
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import edited, model_path, model_text, written
from planner.model.space import exp_quaternion, product
from planner.problem.costs.tracking import TrackingCost
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.solvers.slq import solve

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


OPENING = 0.35  # s, at most a quarter of the flight: the posture term grows after take-off and fades before entry

_STEP = 0.6  # rad between the goals of two solves; at pi the shortest rotation would change its direction
_STAGES, _ITERATIONS = 140, 25  # limits of the intermediate solves, which need not converge
_LAST_ITERATIONS = 100  # limit of the last solve, whose gains are used


@dataclass(frozen=True)
class Weights:
    """Weights of a dive; see high_dive()."""

    final: float
    rate: float
    effort: float
    posture: float
    calm: float


@dataclass(frozen=True)
class Dive:
    """A flight from take-off to entry."""

    diver: Diver
    up: float  # m/s, of the centre of mass at take-off
    ahead: float  # m/s, likewise
    rate: float  # rad/s, of the somersault at take-off
    duration: float  # s
    somersaults: float  # turns over the head, positive forward
    twists: float  # turns about the long axis, positive to the left
    weights: Weights

    @property
    def start(self) -> np.ndarray:
        """(nx,) at take-off."""
        return self.diver.take_off(self.up, self.ahead, self.rate)

    def entry(self, part: float = 1.0) -> np.ndarray:
        """Goal state (nx,) on the homotopy: where a stiff body arrives at part 0, the entry of the dive at 1.

        Only orientation and joints are goals; place and velocity of the pelvis follow from the fall.
        """
        x = self.diver.mechanism.keyframe("goal")
        stiff = self.rate * self.duration
        somersault = stiff + part * (2.0 * np.pi * self.somersaults - stiff)
        x[3:7] = orientation(somersault, part * 2.0 * np.pi * self.twists)
        return x

    def cost(self, dynamics: RigidBodyDynamics, N: int, part: float = 1.0) -> TrackingCost:
        """The cost over N stages, with the goal entry(part)."""
        nq, nv = dynamics.mechanism.nq, dynamics.mechanism.nv
        ranges, weights = self.diver.ranges(), self.weights
        t = dynamics.dt * np.arange(N + 1)
        posture = np.zeros(2 * nv)
        posture[6:nv] = weights.posture / (0.5 * (ranges[:, 1] - ranges[:, 0])) ** 2
        calm = np.repeat([0.0, weights.calm], [nv + 6, nv - 6])
        Q = dynamics.dt * (self.posture_share(t)[:, None, None] * np.diag(posture) + np.diag(calm))
        Q[N] = np.diag(np.repeat([0.0, weights.final, 0.0, weights.rate], [3, nv - 3, 6, nv - 6]))
        x_ref = np.tile(self.entry(part), (N + 1, 1))
        x_ref[:N, 7:nq] = ranges.mean(axis=1)
        R = np.tile(dynamics.dt * weights.effort * np.eye(dynamics.nu), (N, 1, 1))
        return TrackingCost(Q, R, x_ref, space=dynamics.space)

    def posture_share(self, t: np.ndarray) -> np.ndarray:
        """Share (K,) of the posture weight at times t (K,): 0 at both ends, 1 between."""
        fade = min(OPENING, 0.25 * self.duration)
        s = np.clip(np.minimum(t, self.duration - t) / fade, 0.0, 1.0)
        return s * s * (3.0 - 2.0 * s)

    def first_controls(self, dynamics: RigidBodyDynamics, N: int) -> np.ndarray:
        """Controls (N, nu) that end near the goal after the right number of turns."""
        plan = turning_plan(self, min(N, _STAGES))
        space = dynamics.space
        stage = np.arange(N) * plan.N // N
        part = (np.arange(N) * plan.N / N - stage)[:, None]
        xs = space.integrate(plan.xs[stage], part * space.difference(plan.xs[stage + 1], plan.xs[stage]))
        us, x = plan.us[stage], self.start
        for n in range(N):
            us[n] += plan.K[stage[n]] @ space.difference(x, xs[n])
            x = dynamics.step(x[None], us[n : n + 1])[0]
        return us if np.isfinite(us).all() else plan.us[stage]


def orientation(somersault: float, twist: float) -> np.ndarray:
    """Quaternion (4,) of an upright body turned about its lateral axis, then about its long axis, by angles in rad."""
    axes = np.array([[0.0, somersault, 0.0], [0.0, 0.0, twist]])
    return product(*exp_quaternion(axes))


@lru_cache(maxsize=8)
def turning_plan(dive: Dive, N: int) -> Plan:
    """Plan the dive over N stages by the homotopy of goals."""
    mechanism = dive.diver.mechanism
    dynamics = RigidBodyDynamics(mechanism, dive.duration / N, "rk4")
    us = _stiff_controls(dive, dynamics, N)
    missing = 2.0 * np.pi * max(abs(dive.somersaults - dive.rate * dive.duration / (2.0 * np.pi)), abs(dive.twists))
    steps = max(1, int(np.ceil(missing / _STEP)))
    for k in range(1, steps):
        problem = Problem(dynamics, dive.cost(dynamics, N, k / steps), x0=dive.start, us=us)
        us = solve(problem, max_iterations=_ITERATIONS).us
    return solve(Problem(dynamics, dive.cost(dynamics, N), x0=dive.start, us=us), max_iterations=_LAST_ITERATIONS)


def _stiff_controls(dive: Dive, dynamics: RigidBodyDynamics, N: int) -> np.ndarray:
    """Torques (N, nu) that hold every joint still, by inverse dynamics at the beginning of each stage."""
    mechanism = dynamics.mechanism
    held = RigidBodyDynamics(mechanism, dynamics.dt, prescribed=mechanism.joint_names[1:])
    still = np.zeros((N, held.nu))
    xs = rollout_states(held, dive.start, still)[:-1]
    nq, nv = mechanism.nq, mechanism.nv
    return rnea(mechanism, xs[:, :nq], xs[:, nq:], held.rates(xs, still)[:, nv:])[:, 6:]
