"""What a step should be like, each wish with its tolerance.

    J = 1/2 sum_k (dt / period) sum (e / tolerance)^2 + 1/2 sum (e_N / final tolerance)^2

e are the distances of pelvis, joints and controls from the normal gait (controls: from zero), and

    clearance    a swinging foot below the height that is wanted, heel and toe
    apart        shanks and feet of the two legs nearer than they may be
    reach        of a swing: the hip farther from the standing ankle than a leg is long
    stance       of a cycle: the standing foot above the belt, first the heel, then heel and toe, then the toe
    slip         of a cycle: the standing foot sliding along the belt, in the default cost

Without stance the cheapest way to copy the angles of a gait is to carry the patient through the air.

"study" are the numbers with which the case was first solved; the default wants more clearance and over the whole
swing, which is what the training is for, and a foot that does not slip; its lengths go with the body and its rates with
the time of a cycle, see SLOWER. The period is .4 s, of a slower cycle than the usual as much more as it takes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from planner.cases.human_step.phase import SWING, Step
from planner.dynamics import RigidBodyDynamics
from planner.problem.costs.penalty import PenaltyCost
from planner.problem.costs.penalty_terms import Distance, Height, Point, Segment, Velocity
from planner.problem.costs.tracking import SumCost, TrackingCost

PERIOD = 0.4  # s, over which a tolerance on the way is an average: about a swing
USUAL = 1.2  # s, the cycle that the tolerances are for
SLOWER = {"period": 1.0, "clearance": 1.0, "place": -1.5, "turn": -1.5, "acceleration": -2.0, "turning": -2.0,
          "slip": -1.0, "final_speed": -1.0, "final_turn_rate": -1.0, "final_joint_rate": -1.0}  # fmt: skip
FASTER = {"clearance": -3.0, "acceleration": -1.0, "turning": -1.0, "slip": -1.0}
"""How numbers of the default cost go with the time of a cycle, as its powers, if slower or faster than usual.

Rates and accelerations go as those of the motion do. A slow passive leg copies less of the normal gait, and a pelvis
free to make up for it is led over ever other touches of the belt, for hundreds of iterations: so it is kept nearer. The
height that is wanted is what leaves the promised clearance to people of 45 to 110 kg in cycles of 1.0 to 1.8 s.
"""


@dataclass(frozen=True)
class Wishes:
    """Tolerances, in m, rad and s; the final ones are of the end.

    Attributes:
        place: Of the pelvis.
        turn: Of the pelvis.
        joints: Of the legs, by joint.
        acceleration: Of the pelvis, m/s^2.
        turning: Of the pelvis, rad/s^2.
        final_place: Of the pelvis.
        final_turn: Of the pelvis.
        final_joints: Of the legs, by joint.
        final_speed: Of the pelvis, m/s.
        final_turn_rate: Of the pelvis, rad/s.
        final_joint_rate: Of the legs, rad/s.
        clearance: How high a swinging foot is wanted, m; 0 for no such wish.
        clearance_tolerance: m.
        clear: Of the swing, how soon the height is wanted in full, how long before its end no more, and its limits as
            fractions of a cycle.
        shanks_apart: m.
        feet_apart: m, also of a foot from the other shank.
        apart_tolerance: m.
        straight: Of a leg's length, how far the standing ankle may be from the hip.
        stance_depth: How deep in the belt a standing foot is wanted, m.
        stance_tolerance: m.
        slip: Of a standing foot along the belt, m/s; 0 for no such wish.
        deepest: In the belt, of any foot, m: a blow on a leg that is nearly straight makes its knee buckle one way in
            the plan and the other way in MuJoCo; 0 for no such wish.
        ramp: m, over which clearance, distances and stance begin to count.
        reach_ramp: m.
        reach_tolerance: m.
        period: s, over which a tolerance on the way is an average.
    """

    joints: dict[str, float]
    final_joints: dict[str, float]
    final_place: float
    final_turn: float
    final_speed: float
    final_turn_rate: float
    final_joint_rate: float
    clear: tuple[float, float, float, float]
    place: float = 0.05
    turn: float = np.radians(10.0)
    acceleration: float = 5.0
    turning: float = 40.0
    clearance: float = 0.015
    clearance_tolerance: float = 0.003
    shanks_apart: float = 0.09
    feet_apart: float = 0.075
    apart_tolerance: float = 0.005
    straight: float = 0.999
    stance_depth: float = 0.003
    stance_tolerance: float = 0.005
    slip: float = 0.0
    deepest: float = 0.0
    ramp: float = 0.003
    reach_ramp: float = 0.002
    reach_tolerance: float = 0.003
    period: float = PERIOD


_DEGREES = {"hip_flexion": 5.0, "hip_adduction": 5.0, "hip_rotation": 10.0, "knee": 5.0, "ankle": 10.0}
_JOINTS = {name: float(np.radians(degrees)) for name, degrees in _DEGREES.items()}
STUDY_SWING = Wishes(
    joints=_JOINTS,
    final_joints={name: np.radians(4.0 if name == "ankle" else 2.0) for name in _JOINTS},
    final_place=0.02, final_turn=np.radians(5.0), final_speed=0.2, final_turn_rate=1.0, final_joint_rate=0.5,
    clear=(0.15, 0.10, *SWING),
)  # fmt: skip
STUDY_CYCLE = Wishes(
    joints=_JOINTS,
    final_joints={name: 0.5 * tolerance for name, tolerance in _JOINTS.items()},
    final_place=0.02, final_turn=np.radians(5.0), final_speed=0.5, final_turn_rate=2.0, final_joint_rate=1.0,
    clear=(0.20, 0.15, 0.66, 0.95),
)  # fmt: skip
CLEARANCE = 0.025  # m, wanted by the default cost of the person in the file, over the whole swing
CLEARANCE_TOLERANCE = 0.002  # m, of a cycle: feet that stick to the belt leave it later and lower
CLEAR = (0.20, 0.20, *SWING)
DEEPEST = 0.010  # m, wanted by the default cost: 50 N on one point of a foot
SLIP = 0.1  # m/s, of a standing foot along the belt, either way; under 20 to 30 N viscous friction creeps at about that
STANCE = {"heel": (0.04, 0.36), "toe": (0.10, 0.58)}  # of a cycle, when they are wanted on the belt
STICKS = {"heel": (0.0, 0.36), "toe": (0.04, 0.60)}  # and when they are wanted to move with it, from before they touch


def wishes(step: Step, cost: str, clearance: float | None, apart: float | None) -> Wishes:
    """Of a step, by the name of the cost; see human_step() for the numbers."""
    found = STUDY_CYCLE if step.walker.belt else STUDY_SWING
    if cost != "study":
        scale = step.walker.scale
        found = replace(found, clearance=CLEARANCE, deepest=DEEPEST, slip=SLIP)
        if step.walker.belt:  # a swing of its own has left it
            found = replace(found, clearance_tolerance=CLEARANCE_TOLERANCE)
        lengths = ("clearance", "place", "final_place", "shanks_apart", "feet_apart")
        found = replace(found, clear=CLEAR, **{name: scale * getattr(found, name) for name in lengths})
        time = step.duration / USUAL
        powers = SLOWER if time > 1.0 else FASTER
        found = replace(found, **{name: time**power * getattr(found, name) for name, power in powers.items()})
    if clearance is not None:
        found = replace(found, clearance=clearance)
    return found if apart is None else replace(found, shanks_apart=apart, feet_apart=apart)


def step_cost(
    dynamics: RigidBodyDynamics, step: Step, wish: Wishes, effort: Any, control: Any = 0.0,
    goal: np.ndarray | None = None, acceleration: Any = np.inf,
) -> SumCost:  # fmt: skip
    """The cost of a plan of a step.

    Args:
        dynamics: Of the walker.
        step: The step.
        wish: Its tolerances.
        effort: (6,) tolerances of the controls.
        control: (6,) or (N, 6) what they are tolerances from.
        goal: (nx,) what the end is drawn to; the normal gait's by default.
        acceleration: (6,) tolerances of the pelvis' accelerations, where these are states.
    """
    terms = _clearance(step, wish) + (
        _standing(step, wish) + _sticking(step, wish) if step.walker.belt else _reach(step, wish)
    )
    return _tracking(dynamics, step, wish, effort, control, goal, acceleration) + PenaltyCost(
        dynamics, step.N, terms + _apart(step, wish)
    )  # fmt: skip


def _tracking(
    dynamics: RigidBodyDynamics, step: Step, wish: Wishes, effort: np.ndarray, control: Any, goal: np.ndarray | None,
    acceleration: Any,
) -> TrackingCost:  # fmt: skip
    states = np.vstack([step.states[:-1], step.states[-1] if goal is None else goal])
    states[:-1, 2 * dynamics.mechanism.nv :] = 0.0  # accelerations are spared like any control
    on_the_way = _by_joint(step, wish.place, wish.turn, wish.joints)
    final = _by_joint(step, wish.final_place, wish.final_turn, wish.final_joints)
    rates = _by_joint(step, wish.final_speed, wish.final_turn_rate, dict.fromkeys(wish.joints, wish.final_joint_rate))
    return TrackingCost.joints(
        dynamics, None, step.N, effort=1.0 / (wish.period * effort**2), control=control, reference=states,
        position={joint: 1.0 / (wish.period * tolerance**2) for joint, tolerance in on_the_way.items()},
        final_position={joint: 1.0 / tolerance**2 for joint, tolerance in final.items()},
        final_velocity={joint: 1.0 / tolerance**2 for joint, tolerance in rates.items()},
        activation=1.0 / (wish.period * acceleration**2), final_activation=1.0 / acceleration**2,
    )  # fmt: skip


def _by_joint(step: Step, place: float, turn: float, joints: dict[str, float]) -> dict[str, float]:
    pelvis = {f"pelvis_{name}": place for name in "xyz"} | {
        f"pelvis_{name}": turn for name in ("tilt", "list", "rotation")
    }
    return pelvis | {f"{side}_{name}": value for side in step.walker.legs for name, value in joints.items()}


def _clearance(step: Step, wish: Wishes) -> list[Any]:
    """Heel and toe of a swinging foot at the height that is wanted."""
    if wish.clearance == 0.0:
        return []
    up, down, begin, end = wish.clear
    terms = []
    for side in step.walker.legs:
        # in a swing of its own the leg is in the air from the first knot to the last
        t = step.leg_time(side) if step.walker.belt else step.t
        part = (t - begin) / (end - begin)
        on = (part > 0.0) & (part < 1.0) if step.walker.belt else np.ones(step.N + 1, dtype=bool)
        wanted = wish.clearance * np.clip(np.minimum(part / up, (1.0 - part) / down), 0.0, 1.0)
        terms += [
            Height(Point(f"{side}_{end}_point"), least=np.where(on, wanted, np.nan),
                   tolerance=wish.clearance_tolerance, ramp=wish.ramp, weight=1.0 / wish.period)
            for end in ("heel", "toe")
        ]  # fmt: skip
    return terms


def _standing(step: Step, wish: Wishes) -> list[Any]:
    """Heel and toe of a standing foot on the belt."""
    terms = []
    for side in step.walker.legs:
        t = step.leg_time(side)
        for end, (begin, until) in STANCE.items():
            most = np.where((t > begin) & (t < until), -wish.stance_depth, np.nan)
            terms.append(
                Height(Point(f"{side}_{end}_point"), most=most, tolerance=wish.stance_tolerance, ramp=wish.ramp,
                       weight=1.0 / wish.period)
            )  # fmt: skip
        terms += [
            Height(Point(f"{side}_{end}_point"), least=-wish.deepest, tolerance=wish.stance_tolerance, ramp=wish.ramp,
                   weight=1.0 / PERIOD)
            for end in STANCE if wish.deepest
        ]  # fmt: skip
    return terms


def _sticking(step: Step, wish: Wishes) -> list[Any]:
    """Heel and toe of a standing foot carried along by the belt."""
    terms = []
    for side in step.walker.legs if wish.slip else ():
        t = step.leg_time(side)
        for end, (begin, until) in STICKS.items():
            still = np.where((t > begin) & (t < until), 0.0, np.nan)
            terms += [
                Velocity(Point(f"{side}_{end}_point"), direction, Point("belt"), target=still, tolerance=wish.slip,
                         weight=1.0 / wish.period)
                for direction in np.eye(3)[:2]
            ]  # fmt: skip
    return terms


def _reach(step: Step, wish: Wishes) -> list[Any]:
    """The hip of the standing leg no farther from its ankle than the leg is long."""
    ankle = step.feet(step.motion.q)[:, 3]
    return [
        Distance(Point("left_hip"), Point(world=ankle), most=wish.straight * step.walker.leg_length,
                 tolerance=wish.reach_tolerance, ramp=wish.reach_ramp, weight=1.0 / wish.period)
    ]  # fmt: skip


def _apart(step: Step, wish: Wishes) -> list[Any]:
    """Shanks and feet of the two legs."""
    shank, foot = _segments("right")
    if step.walker.belt:
        other_shank, other_foot = _segments("left")
    else:
        feet = step.feet(step.motion.q)
        ankle, heel, toe = (feet[:, i] for i in (3, 4, 5))
        knee = Point("left_hip", share=0.5, world=0.5 * ankle)  # of a straight leg
        other_shank, other_foot = Segment(knee, Point(world=ankle)), Segment(Point(world=heel), Point(world=toe))
    pairs = (
        (shank, other_shank, wish.shanks_apart), (foot, other_foot, wish.feet_apart),
        (shank, other_foot, wish.feet_apart), (foot, other_shank, wish.feet_apart),
    )  # fmt: skip
    return [
        Distance(a, b, least=least, tolerance=wish.apart_tolerance, ramp=wish.ramp, weight=1.0 / wish.period)
        for a, b, least in pairs
    ]


def _segments(side: str) -> tuple[Segment, Segment]:
    return (
        Segment(Point(f"{side}_knee_centre"), Point(f"{side}_ankle_centre")),
        Segment(Point(f"{side}_heel_point"), Point(f"{side}_toe_point")),
    )
