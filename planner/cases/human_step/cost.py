"""The cost of a step: a sum of squared errors, each over its tolerance.

    J = 1/2 sum_k (dt / period) sum (e / tolerance)^2 + 1/2 sum (e_N / final tolerance)^2

The errors e are the distances of pelvis, joints and controls from the normal gait (controls: from zero), and

    clearance    how far heel and toe of a swinging foot are below the wanted height
    distances    how much closer shanks and feet of the two legs are than allowed
    reach        swing only: how much farther the hip is from the standing ankle than a leg is long
    stance       cycle only: height of the standing foot above the belt: heel, then heel and toe, then toe
    slip         cycle only, default cost: speed of the standing foot along the belt

Without the stance term the cheapest way to copy the angles of a gait is to carry the patient through the air.

    number               value                         from
    tolerances           STUDY_SWING, STUDY_CYCLE      ours
    default cost         CLEARANCE to STICKS           ours: more clearance, over the whole swing; a foot without slip
    scaling              lengths with the body, rates with the time of a cycle: SLOWER and FASTER      ours
    period               0.4 s, longer in a slower cycle                                               ours

The cost "study" has the numbers with which the case was first solved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from planner.cases.human_step.walker import PELVIS, SWING, GaitPhase
from planner.dynamics import RigidBodyDynamics
from planner.problem.costs.least_squares import PenaltyCost
from planner.problem.costs.penalty_terms import Distance, Height, Point, Segment, Velocity
from planner.problem.costs.terms import SumCost
from planner.problem.costs.tracking import TrackingCost

PERIOD = 0.4  # s, about the time of a swing
USUAL = 1.2  # s, the cycle that the tolerances are for
SLOWER = {"period": 1.0, "clearance": 1.0, "place": -1.5, "turn": -1.5, "acceleration": -2.0, "turning": -2.0,
          "slip": -1.0, "final_speed": -1.0, "final_turn_rate": -1.0, "final_joint_rate": -1.0}  # fmt: skip
FASTER = {"clearance": -3.0, "acceleration": -1.0, "turning": -1.0, "slip": -1.0}
"""Powers of the time of a cycle over USUAL by which the default cost scales its numbers, in slower and faster cycles.

Rates and accelerations scale like those of the motion. A slow passive leg copies less of the normal gait; a pelvis that
may correct this visits ever new sequences of contacts, for hundreds of iterations, so its tolerance shrinks. The wanted
clearance leaves the promised one to people of 45 to 110 kg in cycles of 1.0 to 1.8 s.
"""


@dataclass(frozen=True)
class StepTolerances:
    """Tolerances of a step, with a factor 1/2 on each squared term. Terms for a length of 0 are left out."""

    joints: dict[str, float]  # rad, of the legs, by joint
    final_joints: dict[str, float]  # rad, at the end
    final_place: float  # m, of the pelvis at the end
    final_turn: float  # rad, of the pelvis at the end
    final_speed: float  # m/s, of the pelvis at the end
    final_turn_rate: float  # rad/s, of the pelvis at the end
    final_joint_rate: float  # rad/s, of the legs at the end
    clear: tuple[float, float, float, float]
    """Shares of the swing over which the wanted clearance rises and falls; begin and end of the swing in the cycle."""
    place: float = 0.05  # m, of the pelvis
    turn: float = np.radians(10.0)  # rad, of the pelvis
    acceleration: float = 5.0  # m/s^2, of the pelvis
    turning: float = 40.0  # rad/s^2, of the pelvis
    clearance: float = 0.015  # m, wanted height of a swinging foot
    clearance_tolerance: float = 0.003  # m
    shank_distance: float = 0.09  # m, least distance
    foot_distance: float = 0.075  # m, least distance of the feet, and of a foot from the other shank
    distance_tolerance: float = 0.005  # m
    straight: float = 0.999  # of the leg's length, largest distance of the standing ankle from the hip
    stance_depth: float = 0.003  # m, wanted depth of a standing foot in the belt
    stance_tolerance: float = 0.005  # m
    slip: float = 0.0  # m/s, tolerance of a standing foot's speed along the belt
    deepest: float = 0.0
    """m, largest depth of any foot in the belt: after a blow on a leg that is nearly straight, the knee buckles one way
    in the plan and the other way in MuJoCo."""
    ramp: float = 0.003  # m, over which clearance, distances and stance begin to count
    reach_ramp: float = 0.002  # m
    reach_tolerance: float = 0.003  # m
    period: float = PERIOD  # s, over which a tolerance on the way is an average


_DEGREES = {"hip_flexion": 5.0, "hip_adduction": 5.0, "hip_rotation": 10.0, "knee": 5.0, "ankle": 10.0}
_JOINTS = {name: float(np.radians(degrees)) for name, degrees in _DEGREES.items()}
STUDY_SWING = StepTolerances(
    joints=_JOINTS,
    final_joints={name: np.radians(4.0 if name == "ankle" else 2.0) for name in _JOINTS},
    final_place=0.02, final_turn=np.radians(5.0), final_speed=0.2, final_turn_rate=1.0, final_joint_rate=0.5,
    clear=(0.15, 0.10, *SWING),
)  # fmt: skip
STUDY_CYCLE = StepTolerances(
    joints=_JOINTS,
    final_joints={name: 0.5 * tolerance for name, tolerance in _JOINTS.items()},
    final_place=0.02, final_turn=np.radians(5.0), final_speed=0.5, final_turn_rate=2.0, final_joint_rate=1.0,
    clear=(0.20, 0.15, 0.66, 0.95),
)  # fmt: skip
CLEARANCE = 0.025  # m, for the person in the file
CLEARANCE_TOLERANCE = 0.002  # m, of a cycle: feet that stick to the belt leave it later and lower
CLEAR = (0.20, 0.20, *SWING)
DEEPEST = 0.010  # m: 50 N on one point of a foot
SLIP = 0.1  # m/s, in both directions; viscous friction creeps at about this speed under 20 to 30 N
STANCE = {"heel": (0.04, 0.36), "toe": (0.10, 0.58)}  # parts of the cycle in which heel and toe must be on the belt
STICKS = {"heel": (0.0, 0.36), "toe": (0.04, 0.60)}  # parts in which they must move with it, from before the contact


def step_tolerances(step: GaitPhase, cost: str, clearance: float | None, apart: float | None) -> StepTolerances:
    """The tolerances of a step by the name of its cost, clearance and distance in m; see human_step()."""
    found = STUDY_CYCLE if step.walker.belt else STUDY_SWING
    if cost != "study":
        scale = step.walker.scale
        found = replace(found, clearance=CLEARANCE, deepest=DEEPEST, slip=SLIP)
        if step.walker.belt:  # a swing of its own has left it
            found = replace(found, clearance_tolerance=CLEARANCE_TOLERANCE)
        lengths = ("clearance", "place", "final_place", "shank_distance", "foot_distance")
        found = replace(found, clear=CLEAR, **{name: scale * getattr(found, name) for name in lengths})
        time = step.duration / USUAL
        powers = SLOWER if time > 1.0 else FASTER
        found = replace(found, **{name: time**power * getattr(found, name) for name, power in powers.items()})
    if clearance is not None:
        found = replace(found, clearance=clearance)
    return found if apart is None else replace(found, shank_distance=apart, foot_distance=apart)


def step_cost(
    dynamics: RigidBodyDynamics, step: GaitPhase, tol: StepTolerances, effort: Any, control: Any = 0.0,
    goal: np.ndarray | None = None, acceleration: Any = np.inf,
) -> SumCost:  # fmt: skip
    """The cost of a step.

    `effort` are the tolerances (6,) of the controls, `control` the controls (6,) or (N, 6) without cost, `goal` the
    state (nx,) of the end (by default that of the normal gait), and `acceleration` the tolerances (6,) of the
    accelerations of the pelvis, where these are states.
    """
    states = np.vstack([step.states[:-1], step.states[-1] if goal is None else goal])
    states[:-1, 2 * dynamics.mechanism.nv :] = 0.0  # accelerations that are states cost like controls
    position = _weights(step, tol.place, tol.turn, tol.joints, tol.period)
    final = _weights(step, tol.final_place, tol.final_turn, tol.final_joints)
    rates = _weights(step, tol.final_speed, tol.final_turn_rate, dict.fromkeys(tol.joints, tol.final_joint_rate))
    tracking = TrackingCost.joints(
        dynamics, None, step.N, effort=1.0 / (tol.period * effort**2), control=control, reference=states,
        position=position, final_position=final, final_velocity=rates,
        activation=1.0 / (tol.period * acceleration**2), final_activation=1.0 / acceleration**2,
    )  # fmt: skip
    contact = _standing(step, tol) + _sticking(step, tol) if step.walker.belt else _reach(step, tol)
    return tracking + PenaltyCost(dynamics, step.N, _clearance(step, tol) + contact + _leg_distances(step, tol))


def _weights(
    step: GaitPhase, place: float, turn: float, joints: dict[str, float], period: float = 1.0
) -> dict[str, float]:
    """1 / (period tolerance^2) by joint, of tolerances of the pelvis' place and turn and of the legs' joints."""
    tolerances = dict(zip(PELVIS, 3 * [place] + 3 * [turn], strict=True))
    tolerances |= {f"{side}_{name}": value for side in step.walker.legs for name, value in joints.items()}
    return {joint: 1.0 / (period * tolerance**2) for joint, tolerance in tolerances.items()}


def _foot(side: str, end: str, tol: StepTolerances, tolerance: float, period: float, **bound: Any) -> Height:
    """The height of heel or toe, with a bound `lower` or `upper`."""
    return Height(Point(f"{side}_{end}_point"), tolerance=tolerance, ramp=tol.ramp, weight=1.0 / period, **bound)


def _during(t: np.ndarray, part: tuple[float, float], value: float) -> np.ndarray:
    """The value where t (K,) is within a part of the cycle, NaN elsewhere: (K,)."""
    return np.where((t > part[0]) & (t < part[1]), value, np.nan)


def _clearance(step: GaitPhase, tol: StepTolerances) -> list[Any]:
    """Heel and toe of a swinging foot are at the wanted height."""
    if tol.clearance == 0.0:
        return []
    up, down, begin, end = tol.clear
    terms = []
    for side in step.walker.legs:
        # without a belt the leg swings from the first knot to the last
        t = step.leg_time(side) if step.walker.belt else step.t
        part = (t - begin) / (end - begin)
        on = (part > 0.0) & (part < 1.0) if step.walker.belt else np.ones(step.N + 1, dtype=bool)
        wanted = tol.clearance * np.clip(np.minimum(part / up, (1.0 - part) / down), 0.0, 1.0)
        terms += [
            _foot(side, end, tol, tol.clearance_tolerance, tol.period, lower=np.where(on, wanted, np.nan))
            for end in ("heel", "toe")
        ]
    return terms


def _standing(step: GaitPhase, tol: StepTolerances) -> list[Any]:
    """Heel and toe of a standing foot are on the belt."""
    terms = []
    for side in step.walker.legs:
        t = step.leg_time(side)
        for end, part in STANCE.items():
            most = _during(t, part, -tol.stance_depth)
            terms.append(_foot(side, end, tol, tol.stance_tolerance, tol.period, upper=most))
        for end in STANCE if tol.deepest else ():
            terms.append(_foot(side, end, tol, tol.stance_tolerance, PERIOD, lower=-tol.deepest))
    return terms


def _sticking(step: GaitPhase, tol: StepTolerances) -> list[Any]:
    """Heel and toe of a standing foot move with the belt."""
    return [
        Velocity(Point(f"{side}_{end}_point"), direction, Point("belt"), tolerance=tol.slip, weight=1.0 / tol.period,
                 target=_during(step.leg_time(side), part, 0.0))
        for side in step.walker.legs if tol.slip for end, part in STICKS.items() for direction in np.eye(3)[:2]
    ]  # fmt: skip


def _reach(step: GaitPhase, tol: StepTolerances) -> list[Any]:
    """The hip of the standing leg is no farther from its ankle than the leg is long."""
    ankle = step.feet(step.motion.q)[:, 3]
    return [
        Distance(Point("left_hip"), Point(world=ankle), upper=tol.straight * step.walker.leg_length,
                 tolerance=tol.reach_tolerance, ramp=tol.reach_ramp, weight=1.0 / tol.period)
    ]  # fmt: skip


def _leg_distances(step: GaitPhase, tol: StepTolerances) -> list[Any]:
    """Distances of shanks and feet of the two legs have a lower limit."""
    shank, foot = _segments("right")
    if step.walker.belt:
        other_shank, other_foot = _segments("left")
    else:
        feet = step.feet(step.motion.q)
        ankle, heel, toe = (feet[:, i] for i in (3, 4, 5))
        knee = Point("left_hip", share=0.5, world=0.5 * ankle)  # of a straight leg
        other_shank, other_foot = Segment(knee, Point(world=ankle)), Segment(Point(world=heel), Point(world=toe))
    pairs = (
        (shank, other_shank, tol.shank_distance), (foot, other_foot, tol.foot_distance),
        (shank, other_foot, tol.foot_distance), (foot, other_shank, tol.foot_distance),
    )  # fmt: skip
    return [
        Distance(a, b, lower=least, tolerance=tol.distance_tolerance, ramp=tol.ramp, weight=1.0 / tol.period)
        for a, b, least in pairs
    ]


def _segments(side: str) -> tuple[Segment, Segment]:
    return (
        Segment(Point(f"{side}_knee_centre"), Point(f"{side}_ankle_centre")),
        Segment(Point(f"{side}_heel_point"), Point(f"{side}_toe_point")),
    )
