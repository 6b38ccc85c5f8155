"""The drive of a step: the controls of the robot at the pelvis, and their cost.

    pelvis="motion"                 u = accelerations of the pelvis, weighted by effort over the tolerances of the cost
    pelvis="motion", jerk > 0       u = rates of the accelerations; the accelerations are states, weighted by effort
    pelvis="motion", force > 0      u = accelerations; the robot's forces and moments are weighted too
    pelvis="force"                  u = forces and moments on a free pelvis, weighted by effort

    tolerance            value                             from
    of an acceleration   5 m/s^2, 40 rad/s^2               ours, see cost.py
    of its rate          the same in CHANGE                ours: about the jerk of a plan without a cost of jerk
    of a force           FORCE and MOMENT, with the body   ours

The cost of forces counts from those that carry the weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from planner.base.arguments import choice, number
from planner.base.errors import PlannerError
from planner.cases.human_step.cost import StepTolerances
from planner.cases.human_step.measures import robot_wrench
from planner.cases.human_step.phase import GaitPhase
from planner.cases.human_step.walker import FILE_MASS, PELVIS, Walker
from planner.dynamics import RigidBodyDynamics
from planner.problem.costs.drive import DriveCost
from planner.problem.initial_guess import rollout_states

Pelvis = Literal["motion", "force"]

FORCE, MOMENT = 350.0, 100.0  # N and N m, of a robot for the person in the file
CHANGE = 0.05  # s
MIN_WEIGHT = 1e-3  # times the usual


@dataclass(frozen=True)
class RobotWeights:
    """The controls of a robot and the weights of their cost, with checked values."""

    pelvis: str = "motion"  # or "force"
    effort: float = 1.0  # of the controls, or of accelerations that are states, times the usual
    jerk: float = 0.0  # of the rates of accelerations; 0 for none
    force: float = 0.0  # of forces that are not controls; 0 for none

    def __post_init__(self) -> None:
        choice("pelvis", self.pelvis, get_args(Pelvis))
        object.__setattr__(self, "effort", number("effort", self.effort, minimum=MIN_WEIGHT, maximum=1.0 / MIN_WEIGHT))
        for name in ("jerk", "force"):
            value = number(name, getattr(self, name), minimum=0.0, maximum=1.0 / MIN_WEIGHT)
            object.__setattr__(self, name, value)
            if 0.0 < value < MIN_WEIGHT:
                raise PlannerError(f"{name} is {value:g}, expected 0 or at least {MIN_WEIGHT:g}.")
            if value and self.pelvis != "motion":
                raise PlannerError(
                    f"{name} is {value:g} with pelvis={self.pelvis!r}, expected 0: effort weighs the forces there."
                )
        if self.jerk and self.force:
            raise PlannerError(f"jerk is {self.jerk:g} and force is {self.force:g}, expected one of the two to be 0.")


@dataclass(frozen=True, eq=False)
class RobotControls:
    """A robot: the dynamics with it, the first guess, and the parts of its cost."""

    dynamics: RigidBodyDynamics
    us: np.ndarray  # (N, 6) first guess: the pelvis moves as in the normal gait
    control: np.ndarray  # (6,) controls without cost
    tolerances: np.ndarray  # (6,) of the controls
    acceleration: Any = np.inf  # (6,) tolerances of accelerations that are states
    forces: DriveCost | None = None  # cost of forces that are not controls


def drive(step: GaitPhase, wish: StepTolerances, sparing: RobotWeights, integrator: str) -> RobotControls:
    """The robot of a step, whose walker has the motors that `sparing` needs."""
    walker, effort = step.walker, np.sqrt(sparing.effort)
    led = not (walker.motors or walker.jerked)
    dynamics = RigidBodyDynamics(walker.mechanism, step.dt, integrator, prescribed=PELVIS if led else ())
    accelerations = np.repeat([wish.acceleration, wish.turning], 3)
    share = walker.mass / FILE_MASS
    forces = np.repeat([share * FORCE, share * walker.scale * MOMENT], 3)
    carried, none = np.array([0.0, 0.0, weight(walker), 0.0, 0.0, 0.0]), np.zeros(len(PELVIS))
    if walker.motors:
        return RobotControls(dynamics, forces_of(step, step.accelerations[: step.N]), carried, forces / effort)
    if walker.jerked:
        us = np.diff(step.accelerations, axis=0) / step.dt
        rates = accelerations / CHANGE / np.sqrt(sparing.jerk)
        return RobotControls(dynamics, us, none, rates, accelerations / effort)
    spared = None
    if sparing.force:
        spared = DriveCost(dynamics, step.N, sparing.force / (wish.period * forces**2), carried)
    return RobotControls(dynamics, step.accelerations[: step.N], none, accelerations / effort, forces=spared)


def weight(walker: Walker) -> float:
    """Weight of the whole person, N."""
    mechanism = walker.mechanism
    carried = mechanism.mass.sum() - (mechanism.mass[0] if walker.belt else 0.0)
    return float(carried * np.linalg.norm(mechanism.gravity))


def forces_of(step: GaitPhase, accelerations: np.ndarray) -> np.ndarray:
    """Forces and moments (N, 6) at the pelvis that give it accelerations (N, 6) while the legs hang; N and N m."""
    carried = RigidBodyDynamics(replace(step.walker, motors=False).mechanism, step.dt, prescribed=PELVIS)
    return robot_wrench(carried, rollout_states(carried, step.states[0], accelerations), accelerations)
