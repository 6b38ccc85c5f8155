"""Measures of a step in a clinician's terms, and the checks of its proof.

Step 4 of the proof checks that the swinging foot is clear of the belt in plan and replay, and that a gait ends as it
began. Step 5 counts how often another patient walks as planned for this one.

Step 3 compares MuJoCo's legs with the plan's, and says how much of the difference smoothing explains. A plan's contact
and stops are smooth (model.contact.laws), MuJoCo's are plain springs and dampers with a cone of friction. So a replay
differs from its plan even where nothing is wrong: a touch-down comes a little earlier, and for a moment speeds differ
by a rad/s. The plan's own recursion says by how much: the same controls under the same law without its smoothing. That
predicts the error of an open-loop replay to a few percent, and with gains it is smaller. The bound is twice the
prediction, RMS over the legs' joints and the path: instants of contact may not be judged one by one, where a touch-down
a millisecond early is an error of a rad/s. What is left between MuJoCo and the predicted motion is the inertia of
MuJoCo's friction (walker.IMPRATIO), and integration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from planner.base.measured import Measurement, Section
from planner.cases.human_step.walker import IMPRATIO, LEG, PELVIS, SWING, GaitPhase
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import rnea
from planner.dynamics.contacts import contact_forces, generalized_forces
from planner.dynamics.kinematics import frame_pose, jacobian
from planner.dynamics.protocol import rollout_states
from planner.model.contact.laws import ContactLaw, Law
from planner.model.mechanism import Frame, Mechanism
from planner.problem.problem_parts import Periodic

if TYPE_CHECKING:
    from planner.problem.plan import Plan
    from planner.proof.replays.replaying import Replay


CLEAR = 5e-3  # m, of heel and toe in the middle of a swing
MIDDLE = (0.1, 0.9)  # of a swing
TOUCHES = 0.5  # N
STANDS = (0.95, 0.66)  # fractions of a cycle between which a foot may be on the belt
CLOSED_POSITION, CLOSED_ANGLE = 4e-3, np.radians(0.5)  # m and rad, between start and end of a gait
CLOSED_SPEED, CLOSED_RATE = 0.03, 0.1  # m/s and rad/s
CLOSED_ACCELERATION, CLOSED_TURNING = 0.3, 1.0  # m/s^2 and rad/s^2
PASSES, COST_TOLERANCE = 20, 0.01  # of a gait: contacts change the last percent of the cost from pass to pass
FOLLOWS = 2.5  # deg, RMS over joints and time: the difference between two planned cycles (study, section 7)
PATIENT = {"common_mass": 0.1, "stiffness": 0.1, "common_stiffness": 0.2}
"""The robustness section also varies the mass of the person and the stiffness of the joints, which are not measured."""


@dataclass(frozen=True)
class Measures:
    """Measures of one motion, by joint or by side, in the order of the walker's legs."""

    rms: dict[str, float]  # deg, distance of each joint from the normal gait, RMS over the motion
    clearance: dict[str, float]  # m, least height of heel and toe in the middle of the swings; infinite without one
    hip_lift: dict[str, float]  # m, largest height of the swinging hip over that of the normal gait
    in_stance: dict[str, float]  # share of the stance with the foot on the belt
    in_swing: dict[str, float]  # share of the swing with the foot on the belt
    stance_force: dict[str, float]  # N, mean over the stance
    largest_force: float  # N, upwards, of one foot
    slip: float  # m/s along the belt, mean of the contacts weighted by their force; 0 without a belt
    depth: float  # m, largest depth of heel or toe in the belt
    straightest_knee: float  # deg; positive where the knee is bent backwards
    pelvis: np.ndarray  # (6, 2) least and largest deviation from the normal gait, m and rad


def measures(step: GaitPhase, xs: np.ndarray) -> Measures:
    """Measure states (N+1, nx) at the knots."""
    m = step.walker.mechanism
    q, qd, sides = xs[:, : m.nq], xs[:, m.velocities], step.walker.legs
    deviation = q - step.states[:, : m.nq]
    legs, pelvis = places(step)
    standing = {side: _stands(step, side) for side in sides}
    lifts = {side: height(step, q, f"{side}_hip") - normal_height(step, f"{side}_hip") for side in sides}
    upward = {side: vertical_force(step, q, qd, side) for side in sides}
    return Measures(
        rms={name: float(np.degrees(np.sqrt(np.mean(deviation[:, i] ** 2)))) for name, i in legs.items()},
        clearance={side: clearance(step, q, side) for side in sides},
        hip_lift={side: float(lifts[side][_swing(step, side)].max(initial=-np.inf)) for side in sides},
        in_stance={side: _mean(upward[side][standing[side]] > TOUCHES) for side in sides},
        in_swing={side: _mean(upward[side][~standing[side]] > TOUCHES) for side in sides},
        stance_force={side: _mean(upward[side][standing[side]]) for side in sides},
        largest_force=float(max(force.max() for force in upward.values())),
        slip=slip(step, q, qd),
        depth=float(contact_forces(m, q, qd).depths.max(initial=0.0)),
        straightest_knee=float(np.degrees(max(q[:, legs[f"{side}_knee"]].max() for side in sides))),
        pelvis=np.stack([deviation[:, pelvis].min(axis=0), deviation[:, pelvis].max(axis=0)], axis=1),
    )


@lru_cache(maxsize=1)
def _of_plan(step: GaitPhase, plan: Plan) -> Measures:
    """Measures of a plan's states, once for all of its replays."""
    return measures(step, plan.xs)


def places(step: GaitPhase) -> tuple[dict[str, int], list[int]]:
    """Columns of q: those of the legs' joints by name, and those of PELVIS."""
    m = step.walker.mechanism
    legs = {f"{side}_{joint}": m.joint(f"{side}_{joint}").start for side in step.walker.legs for joint in LEG}
    return legs, [m.joint(name).start for name in PELVIS]


def height(step: GaitPhase, q: np.ndarray, site: str) -> np.ndarray:
    """Height (K,) of a site over the belt, m, at configurations q (K, nq)."""
    return frame_pose(step.walker.mechanism, q, site)[:, 2, 3]


def normal_height(step: GaitPhase, site: str) -> np.ndarray:
    """Height (N+1,) of a site over the belt in the normal gait, m."""
    return height(step, step.states[:, : step.walker.mechanism.nq], site)


def clearance(step: GaitPhase, q: np.ndarray, side: str) -> float:
    """Least height of heel and toe in the middle of the swings, m, at the knots q (N+1, nq)."""
    middle = _swing(step, side, MIDDLE)
    points = [height(step, q[middle], f"{side}_{end}_point") for end in ("heel", "toe")]
    return float(np.min(points, initial=np.inf))


def vertical_force(step: GaitPhase, q: np.ndarray, qd: np.ndarray, side: str) -> np.ndarray:
    """Upward force (K,) of the belt on a foot, N."""
    m = step.walker.mechanism
    found = contact_forces(m, q, qd).forces[:, :, 2]
    return found[:, [side in contact.name for contact in m.contacts]].sum(axis=1)


def slip(step: GaitPhase, q: np.ndarray, qd: np.ndarray) -> float:
    """Speed of heels and toes along the belt, m/s: the mean over K states, weighted by the force of each contact."""
    m = step.walker.mechanism
    forces = contact_forces(m, q, qd).forces[:, :, 2]
    if not forces.any():
        return 0.0
    speeds = np.zeros(forces.shape)
    for k, contact in enumerate(m.contacts):
        v = np.einsum("kaj,kj->ka", jacobian(m, q, Frame.at(contact.link, contact.centre))[:, :2], qd)
        v[:, 0] -= qd[:, m.joint("belt").start]
        speeds[:, k] = np.linalg.norm(v, axis=1)
    return float(np.sum(forces * speeds) / np.sum(forces))


def robot_wrench(dynamics: RigidBodyDynamics, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
    """Forces and moments (N, 6) of the robot on the pelvis along xs (N+1, nx), us (N, nu), in N and N m."""
    m, N = dynamics.mechanism, len(us)
    q, qd = xs[:N, : m.nq], xs[:N, m.velocities]
    qdd = dynamics.rates(xs[:N], us)[:, m.nv : 2 * m.nv]
    # a pelvis whose jerk is the control has an artificial armature
    tau = rnea(m, q, qd, qdd) - m.armature * qdd - generalized_forces(m, q, qd)
    first = m.joint(PELVIS[0]).start
    return tau[:, first : first + len(PELVIS)]


@dataclass(frozen=True)
class RobotLoads:
    """Forces and motion of the robot at the pelvis: RMS and maximum over the stages of the length of each vector."""

    force: tuple[float, float]  # N, weight included
    moment: tuple[float, float]  # N m
    acceleration: tuple[float, float]  # m/s^2
    turning: tuple[float, float]  # rad/s^2
    jerk: tuple[float, float]  # m/s^3, from stage to stage
    twitch: tuple[float, float]  # rad/s^3, from stage to stage


def robot(dynamics: RigidBodyDynamics, xs: np.ndarray, us: np.ndarray) -> RobotLoads:
    """Measure the robot along xs (N+1, nx), us (N, nu)."""
    m, wrench = dynamics.mechanism, robot_wrench(dynamics, xs, us)
    first = m.nv + m.joint(PELVIS[0]).start
    accelerations = dynamics.rates(xs[: len(us)], us)[:, first : first + len(PELVIS)]
    jerks = np.diff(accelerations, axis=0) / dynamics.dt
    lengths = [np.linalg.norm(of[:, i : i + 3], axis=1) for of in (wrench, accelerations, jerks) for i in (0, 3)]
    return RobotLoads(*((float(np.sqrt(np.mean(length**2))), float(length.max())) for length in lengths))


def closing(step: GaitPhase) -> Periodic:
    """Bounds on the difference between start and end of a gait; the belt has none."""
    names = step.walker.mechanism.joint_names
    sides = [
        [np.inf if name == "belt" else place if name in PELVIS[:3] else turn for name in names]
        for place, turn in ((CLOSED_POSITION, CLOSED_ANGLE), (CLOSED_SPEED, CLOSED_RATE))
    ]
    accelerations = [CLOSED_ACCELERATION] * 3 + [CLOSED_TURNING] * 3 if step.walker.jerked else []
    return Periodic(np.concatenate([*sides, accelerations]), passes=PASSES, cost_tolerance=COST_TOLERANCE)


def judge_step(step: GaitPhase, run: Replay, promised: bool, closes: bool = False) -> Section:
    """Measure the plan and MuJoCo's replay; `promised`: check the clearance, `closes`: check the end of a gait."""
    measured = []
    motions = {"planned": run.plan.xs, "replayed": run.xs[:: run.substeps]}
    for who, xs in motions.items():
        found = _of_plan(step, run.plan) if who == "planned" else measures(step, xs)
        least = min(found.clearance.values())
        note = f"how far heel or toe is below {1e3 * CLEAR:g} mm in mid-swing; the least height is {1e3 * least:.1f} mm"
        measured += [
            Measurement(f"{who}_clearance_missed", max(0.0, CLEAR - least), "m", 0.0 if promised else None, note),
            Measurement(f"{who}_hip_lift", max(found.hip_lift.values()), "m", None, "of the swinging hip above normal"),
            Measurement(f"{who}_from_normal", _mean_rms(found), "deg", None, "RMS over the legs' joints"),
        ]  # fmt: skip
        if step.walker.belt:
            measured += [
                Measurement(f"{who}_slip", found.slip, "m/s", None, "along the belt, mean weighted by contact force"),
                Measurement(f"{who}_depth", found.depth, "m", None, "of heel or toe in the belt"),
                *(Measurement(f"{who}_{side}_in_stance", 100.0 * share, "%", None, "of stance, the foot on the belt")
                  for side, share in found.in_stance.items()),
            ]  # fmt: skip
        if closes:
            measured += _closure_errors(step, xs, who)
    assert run.plan.problem is not None  # whose requirements these are
    drive = robot(run.plan.problem.dynamics, run.plan.xs, run.plan.us)  # pyright: ignore[reportArgumentType]
    for name, (rms, most), unit in (("force", drive.force, "N"), ("moment", drive.moment, "N m")):
        measured.append(Measurement(f"planned_robot_{name}", most, unit, None, f"largest; RMS {rms:.4g} {unit}"))
    return Section("goal", tuple(measured))


def _closure_errors(step: GaitPhase, xs: np.ndarray, who: str) -> list[Measurement]:
    """Differences between start and end of a gait: only the plan's have bounds, the replay adds its own errors."""
    legs, pelvis = places(step)
    change = np.abs(xs[-1] - xs[0])
    joints = float(np.degrees(np.sqrt(np.mean(change[list(legs.values())] ** 2))))
    place, turn, joint = (
        (CLOSED_POSITION, CLOSED_ANGLE, float(np.degrees(CLOSED_ANGLE))) if who == "planned" else [None] * 3
    )
    note = f"from start to end, {who}"
    return [
        Measurement(f"{who}_place_gap", float(change[pelvis[:3]].max()), "m", place, note),
        Measurement(f"{who}_turn_gap", float(change[pelvis[3:]].max()), "rad", turn, note),
        Measurement(f"{who}_joint_gap", joints, "deg", joint, f"{note}, RMS over the legs' joints"),
    ]


def follows(step: GaitPhase, xs: np.ndarray, plan_xs: np.ndarray, knots: np.ndarray, clear: bool) -> np.ndarray:
    """Which perturbed patients (K,), of states (K, T, nx) at knots (T,), walk as the plan, of states (T, nx).

    Their legs must be near the plan's; with `clear`, heel and toe must be above the belt in the middle of a swing.
    """
    joints, nq = list(places(step)[0].values()), step.walker.mechanism.nq
    succeeded = np.sqrt(np.mean(np.degrees(xs[..., joints] - plan_xs[:, joints]) ** 2, axis=(1, 2))) < FOLLOWS
    for side in step.walker.legs if clear else ():
        q = xs[:, _swing(step, side, MIDDLE)[knots], :nq]
        for end in ("heel", "toe"):
            heights = height(step, q.reshape(-1, nq), f"{side}_{end}_point").reshape(q.shape[:2])
            succeeded &= heights.min(axis=1, initial=np.inf) > 0.0
    return succeeded


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if values.size else 0.0


def _mean_rms(found: Measures) -> float:
    return float(np.sqrt(np.mean(np.square(list(found.rms.values())))))


def _swing(step: GaitPhase, side: str, within: tuple[float, float] = (0.0, 1.0)) -> np.ndarray:
    """Whether a leg is in a part of its swing: (N+1,)."""
    part = (step.leg_time(side) - SWING[0]) / (SWING[1] - SWING[0])
    return (part >= within[0]) & (part <= within[1])


def _stands(step: GaitPhase, side: str) -> np.ndarray:
    t = step.leg_time(side)
    return (t >= STANDS[0]) | (t <= STANDS[1])


FACTOR = 2.0  # bound over the predicted error
UNEXPLAINED = 0.02  # deg, RMS, added to the bound for errors without smoothing
MAX_ANGLE_ERROR = 0.5  # deg, RMS over the joints of the legs, whatever is predicted


def unsmoothed(mechanism: Mechanism) -> Mechanism:
    """The mechanism with contacts and stops as MuJoCo has them: no ramps, and friction cut off at its cone."""
    contacts = []
    for contact in mechanism.contacts:
        law = contact.law
        plain = ContactLaw.exact(law.stiffness, law.damping, law.slip_damping, law.friction, IMPRATIO)
        contacts.append(replace(contact, law=plain))
    stops = [replace(stop, law=Law(stop.law.stiffness, stop.law.damping)) for stop in mechanism.stops]
    return replace(mechanism, contacts=tuple(contacts), stops=tuple(stops))


@lru_cache(maxsize=1)  # both replays of a plan are compared with it
def without_smoothing(plan: Plan, parts: int) -> np.ndarray:
    """States (N+1, nx) of a plan's controls, open loop and unsmoothed, with so many steps of RK4 per stage."""
    assert plan.problem is not None
    dynamics: Any = plan.problem.dynamics  # rigid bodies, as every step's are
    plain = RigidBodyDynamics(
        unsmoothed(dynamics.mechanism), dynamics.dt / parts, "rk4", prescribed=dynamics.prescribed
    )  # fmt: skip
    return rollout_states(plain, plan.xs[0], np.repeat(plan.us, parts, axis=0))[::parts]


def judge_tracking(step: GaitPhase, run: Replay) -> Section:
    """Compare MuJoCo's legs with the plan's: RMS over all joints."""
    legs, pelvis = places(step)
    joints = list(legs.values())
    # From the plan alone: a replay of a wrong model must not widen its own bound. Twice the replay's step is 0.5 ms.
    plain = without_smoothing(run.plan, max(run.substeps // 2, 1))
    errors = np.degrees(run.error[:, joints])
    expected = _rms(np.degrees(plain - run.plan.xs)[:, joints])
    place, turn = (float(np.abs(run.error[:, part]).max()) for part in (pelvis[:3], pelvis[3:]))
    bound = min(FACTOR * expected + UNEXPLAINED, MAX_ANGLE_ERROR)
    how = "with the plan's gains" if run.feedback else "without feedback"
    measured = [
        Measurement("joint_error", _rms(errors), "deg", bound, f"RMS over the legs' joints, {how}"),
        Measurement("largest_joint_error", float(np.abs(errors).max()), "deg", None, "over the replay"),
        Measurement("predicted_joint_error", expected, "deg", None,
                 "RMS, open loop, by the plan's own law without its smoothing; the bound is twice this"),
        Measurement("pelvis_error", place, "m", None, "largest, of its place"),
        Measurement("pelvis_turn_error", turn, "rad", None, "largest"),
    ]  # fmt: skip
    if not run.feedback:
        left = _rms(np.degrees(run.xs[:: run.substeps] - plain)[:, joints])
        measured.append(
            Measurement("unexplained_joint_error", left, "deg", None, "RMS, MuJoCo from the predicted motion")
        )
    return Section(run.title, tuple(measured))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
