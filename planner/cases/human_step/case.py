"""Human step training: find how a robot must move the pelvis so that a paralysed person's legs walk (case 3).

A person is suspended over a treadmill, a robot moves the pelvis, the legs are passive (section 2.3). The paper solved
the swing alone, in four hours, by splines; stance and swing together did not converge, and it hopes that SLQ would.

    number               value             from
    u                    six accelerations of the pelvis: place x, y, z, then tilt, list, rotation
                                           paper: hybrid dynamics, the legs follow the given motion of the pelvis
    body, passive joints 70 kg, 1.75 m     ours, see walker.py; the paper gives none
    normal gait          cycle of 1.2 s    OpenSim's data, see gait.py
    swing                .62 to 1 of the cycle, dt 4 ms: N = 114      ours
    cycle                dt 5 ms: N = 240  ours
    cost                 see cost.py       ours; the paper's is a distance from the normal gait, too
    start                normal gait       ours

The plan does what the paper found: it lifts the swinging hip, which clears the foot, and turns it forward.

Controls of the robot at the pelvis, and their cost:

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

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Literal, get_args

import numpy as np

from planner.base.arguments import array, choice, count, number
from planner.base.errors import PlannerError
from planner.cases.human_step.cost import StepTolerances, step_cost, step_tolerances
from planner.cases.human_step.gait import NORMAL_GAIT, Gait, read_gait
from planner.cases.human_step.measures import PATIENT, closing, follows, judge_step, judge_tracking, robot_wrench
from planner.cases.human_step.pictures import step_pictures
from planner.cases.human_step.walker import FILE_MASS, PELVIS, SIDES, SWING, GaitPhase, Walker
from planner.dynamics import INTEGRATORS, RigidBodyDynamics
from planner.dynamics.protocol import rollout_states
from planner.problem.appearance import Appearance, Ghost, Panel, Readout, View
from planner.problem.costs.motors import DriveCost
from planner.problem.problem import Problem, Requirements
from planner.problem.problem_parts import MAX_STAGES, Recipe

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


def drive(step: GaitPhase, tolerances: StepTolerances, weights: RobotWeights, integrator: str) -> RobotControls:
    """The robot of a step, whose walker has the motors that `weights` needs."""
    walker, effort = step.walker, np.sqrt(weights.effort)
    prescribed = () if walker.motors or walker.jerked else PELVIS
    dynamics = RigidBodyDynamics(walker.mechanism, step.dt, integrator, prescribed=prescribed)
    accelerations = np.repeat([tolerances.acceleration, tolerances.turning], 3)
    share = walker.mass / FILE_MASS
    forces = np.repeat([share * FORCE, share * walker.scale * MOMENT], 3)
    carried, none = np.array([0.0, 0.0, weight(walker), 0.0, 0.0, 0.0]), np.zeros(len(PELVIS))
    if walker.motors:
        return RobotControls(dynamics, forces_of(step, step.accelerations[: step.N]), carried, forces / effort)
    if walker.jerked:
        us = np.diff(step.accelerations, axis=0) / step.dt
        rates = accelerations / CHANGE / np.sqrt(weights.jerk)
        return RobotControls(dynamics, us, none, rates, accelerations / effort)
    force_cost = None
    if weights.force:
        force_cost = DriveCost(dynamics, step.N, weights.force / (tolerances.period * forces**2), carried)
    return RobotControls(dynamics, step.accelerations[: step.N], none, accelerations / effort, forces=force_cost)


def weight(walker: Walker) -> float:
    """Weight of the whole person, N."""
    mechanism = walker.mechanism
    carried = mechanism.mass.sum() - (mechanism.mass[0] if walker.belt else 0.0)
    return float(carried * np.linalg.norm(mechanism.gravity))


def forces_of(step: GaitPhase, accelerations: np.ndarray) -> np.ndarray:
    """Forces and moments (N, 6) at the pelvis that give it accelerations (N, 6) while the legs hang; N and N m."""
    carried = RigidBodyDynamics(replace(step.walker, motors=False).mechanism, step.dt, prescribed=PELVIS)
    return robot_wrench(carried, rollout_states(carried, step.states[0], accelerations), accelerations)


Phase = Literal["swing", "cycle", "gait"]
States = tuple[tuple[float, ...], ...]
Angles = dict[str, tuple[float, ...]]
Cost = Literal["default", "study"]
Brace = Literal["ankle"]
Passive = Literal["table", "riener-edrich"]

SLOWEST, FASTEST = 30.0, 200.0  # steps per minute
LONGEST_STAGE = 0.02  # s, that still resolves contact
STAGES = {"swing": 4e-3, "cycle": 5e-3, "gait": 5e-3}  # s
MAX_CYCLES = 20
HIGHEST = 0.2  # m, of a foot over the belt
PROMISED = 0.01  # m, least wanted clearance that the proof checks
CYLINDERS = tuple(f"cylinder_{side}_{end}" for side in SIDES for end in ("high", "low", "across"))
"""Tendons of the scene that show the robot; the ghost is drawn without them."""
TOLERANCE = {"swing": 3e-6, "cycle": 1e-4, "gait": 3e-6}
"""Relative decrease, predicted or achieved, that ends a solve. In a cycle the last percent of the cost takes half of
the iterations, at the kinks of touch-downs. A gait needs it, because the minimum decides where it begins."""


def human_step(
    phase: Phase = "cycle", cycles: int = 1, mass: float = 70.0, height: float = 1.75, cadence: float = 100.0,
    leg_mass: float = 1.0, stiffness: float = 1.0, damping: float = 1.0, brace: Brace | None = None,
    passive: Passive = "table", cost: Cost = "default", pelvis: Pelvis = "motion", effort: float = 1.0,
    jerk: float = 0.0, force: float = 0.0, clearance: float | None = None, apart: float | None = None,
    reference: str | None = None, integrator: str = "rk4", horizon: int | None = None, ends: States | None = None,
    angles: Angles | None = None,
) -> Problem:  # fmt: skip
    """Move the pelvis so that a paralysed person's passive legs walk on a treadmill.

    Args:
        phase: "swing" (one leg from toe-off to heel strike), "cycle" (both legs and the belt, from the normal gait) or
            "gait" (a cycle that ends as it began, which is solved by solve_periodic).
        cycles: Number of cycles.
        mass: Mass of the person, kg.
        height: Height of the person, m.
        cadence: Steps per minute; a cycle has two.
        leg_mass: Factor of the legs' share of the mass: less than 1 where muscles have wasted.
        stiffness: Factor of the stiffness of the passive joints.
        damping: Factor of the damping of the passive joints.
        brace: "ankle" for an orthosis that holds the feet.
        passive: Passive moments of hips, knees and ankles: "table" (springs, and a stop of the knee) or
            "riener-edrich" (double exponentials that couple neighbouring joints, Riener and Edrich 1999).
        cost: "default", or "study" for the numbers with which the case was first solved.
        pelvis: "motion" (controls are accelerations of the pelvis) or "force" (forces and moments of the robot).
        effort: Factor of the weight of the controls: more makes a gentler robot and a worse gait.
        jerk: Weight of the rates of the pelvis' accelerations, 0 for none: with it these rates are the controls, and
            the robot moves more smoothly.
        force: Weight of the robot's forces and moments beside its accelerations, 0 for none; the solve takes seconds.
        clearance: Wanted height of a swinging foot, m, 0 for none; by default that of the cost.
        apart: Least distance of shanks and feet, m; by default that of the cost.
        reference: A CSV file of another gait to copy.
        integrator: "euler", "semi-implicit-euler" or "rk4".
        horizon: Number of stages N; by default one every 4 ms of a swing, every 5 ms of cycles.
        ends: Start state and goal state of a gait, (2, nx), as solve_periodic finds them; by default those of the
            normal gait.
        angles: The gait in the file `reference`, from Gait.to_dict(), so that a plan does not need the file.

    Raises:
        PlannerError: A parameter that is not finite, out of range or not a person's, or a file that is not a gait.
    """
    gait = NORMAL_GAIT if reference is None else read_gait(reference) if angles is None else Gait.from_dict(angles)
    weights = RobotWeights(pelvis, effort, jerk, force)
    step = _step(phase, cycles, cadence, gait, horizon, {
        "mass": mass, "height": height, "leg_mass": leg_mass, "stiffness": stiffness, "damping": damping,
        "brace": brace, "passive": passive,
        "motors": pelvis == "force", "jerked": weights.jerk > 0.0,
    })  # fmt: skip
    choice("cost", cost, get_args(Cost))
    if clearance is not None:
        clearance = number("clearance", clearance, minimum=0.0, maximum=HIGHEST)
    if apart is not None:
        apart = number("apart", apart, minimum=0.0, maximum=1.0)
    tolerances = step_tolerances(step, cost, clearance, apart)
    promised = cost == "default" and tolerances.clearance >= PROMISED
    robot = drive(step, tolerances, weights, choice("integrator", integrator, INTEGRATORS))
    start, goal = _ends(step, phase, ends)
    whole = step_cost(robot.dynamics, step, tolerances, robot.tolerances, robot.control, goal, robot.acceleration)
    if robot.forces is not None:
        whole = whole + robot.forces
    parameters: dict[str, Any] = {
        "phase": phase, "cycles": cycles, "mass": step.walker.mass, "height": step.walker.height, "cadence": cadence,
        "leg_mass": step.walker.leg_mass, "stiffness": step.walker.stiffness, "damping": step.walker.damping,
        "brace": brace, "passive": passive, "cost": cost, **asdict(weights),
        "clearance": clearance, "apart": apart, "reference": reference, "integrator": integrator, "horizon": step.N,
        "ends": None if ends is None else [start.tolist(), goal.tolist()],
        "angles": None if gait == NORMAL_GAIT else gait.to_dict(),
    }  # fmt: skip
    return Problem(
        robot.dynamics, whole, x0=start, us=robot.us,
        recipe=Recipe("human-step", parameters, human_step), appearance=_appearance(step, tolerances.joints),
        expected_reduction_tolerance=TOLERANCE[phase], actual_reduction_tolerance=TOLERANCE[phase],
        periodic=closing(step) if phase == "gait" else None,
        requirements=Requirements(
            tracking=partial(judge_tracking, step),
            goal=partial(judge_step, step, promised=promised, closes=phase == "gait"),
            follows=partial(follows, step, clear=promised),
            perturbation=PATIENT,
        ),
    )  # fmt: skip


def _step(
    phase: str, cycles: int, cadence: float, gait: Gait, horizon: int | None, person: dict[str, Any]
) -> GaitPhase:
    """The checked step."""
    swings = choice("phase", phase, get_args(Phase)) == "swing"
    cycles = count("cycles", cycles, maximum=MAX_CYCLES)
    if swings and cycles != 1:
        raise PlannerError(f"cycles is {cycles}, expected 1 for phase='swing', which is a part of one.")
    cadence = number("cadence", cadence, minimum=SLOWEST, maximum=FASTEST)
    walker = Walker(**person, legs=("right",) if swings else SIDES, belt=not swings)
    duration = 120.0 / cadence
    begin, part = (SWING[0], SWING[1] - SWING[0]) if swings else (0.0, float(cycles))
    N = round(part * duration / STAGES[phase]) if horizon is None else count("horizon", horizon, maximum=MAX_STAGES)
    if part * duration / N > LONGEST_STAGE:
        least = int(np.ceil(part * duration / LONGEST_STAGE))
        raise PlannerError(
            f"horizon is {N}, expected at least {least}: a stage of more than {LONGEST_STAGE:g} s skips contacts."
        )
    return GaitPhase(walker, gait, duration, begin, N, part * duration / N)


def _ends(step: GaitPhase, phase: str, ends: Any) -> tuple[np.ndarray, np.ndarray]:
    """The start state and the goal state of the end."""
    if ends is None:
        return step.states[0], step.states[-1]
    if phase != "gait":
        raise PlannerError(f"ends are given for phase={phase!r}, expected them for phase='gait' alone.")
    start, goal = array("ends", ends, (2, step.states.shape[1]))
    return start, goal


def _appearance(step: GaitPhase, tolerances: Mapping[str, float]) -> Appearance:
    """The person on the belt beside the normal gait, seen from the right and from ahead."""
    names = step.walker.mechanism.joint_names

    def curves(side: str, *joints: str) -> tuple[tuple[int, str], ...]:
        return tuple((names.index(f"{side}_{joint}"), joint.replace("_", " ")) for joint in joints)

    def of_pelvis(*joints: str) -> tuple[tuple[int, str], ...]:
        return tuple((names.index(joint), joint.removeprefix("pelvis_")) for joint in joints)

    axes = tuple(enumerate((*"xyz", "tilt", "list", "rotation")))
    low = (0.0, 0.0, 0.74 * step.walker.scale)  # so that no label hides the feet
    unit, moment = "acceleration, m/s^2", "acceleration, rad/s^2"
    if step.walker.motors:
        unit, moment = "force, N", "moment, N m"
    elif step.walker.jerked:
        unit, moment = "jerk, m/s^3", "jerk, rad/s^3"
    return Appearance(
        title=f"Human step, {step.walker.mass:g} kg, {step.walker.height:g} m",
        readouts=(Readout("height of pelvis", names.index("pelvis_z"), "m"),),
        look_at=(0.0, 0.0, 0.85 * step.walker.scale),
        distance=4.2 * step.walker.scale, azimuth=90.0, elevation=-10.0,
        views=(View(90.0, label="from the right"), View(180.0, look_at=low, label="from ahead")),
        ghost=Ghost(step.states, "normal gait"),
        scenery=(*(("belt",) if step.walker.belt else ()), *CYLINDERS),
        force_scale=0.0 if not step.walker.belt else 8e-3, force_unit="N",
        speed=0.25 if step.N * step.dt < 1.0 else 0.5,
        pictures=partial(step_pictures, step, tolerances),
        plots=(
            *(Panel(f"{side.capitalize()} leg", "angle, rad", states=curves(side, "hip_flexion", "knee", "ankle"))
              for side in step.walker.legs),
            *(Panel(f"{side.capitalize()} hip", "angle, rad", states=curves(side, "hip_adduction", "hip_rotation"))
              for side in step.walker.legs),
            Panel("Pelvis", "position, m", states=of_pelvis(*PELVIS[:3])),
            Panel("Pelvis", "angle, rad", states=of_pelvis(*PELVIS[3:])),
            Panel("Pelvis, driven", unit, controls=axes[:3]),
            Panel("Pelvis, turned", moment, controls=axes[3:]),
        ),
    )  # fmt: skip
