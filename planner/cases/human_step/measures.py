"""What a step came to, in a clinician's terms, and what a proof of it is held to.

Step 3 asks how far MuJoCo's legs are from the plan's, RMS over all joints and the whole replay; step 4 whether the
swinging foot is clear of the belt, in the plan and in MuJoCo, and whether a gait ends as it began; step 5 how often
another patient walks as planned for this one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from planner.base.measured import Measured, Section
from planner.cases.human_step.phase import SWING, Step
from planner.cases.human_step.walker import LEG, PELVIS
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.algorithms import frame_pose, jacobian, rnea
from planner.dynamics.contacts import contact_forces, generalized_forces
from planner.model.mechanism import Frame
from planner.problem.periodicity import Periodic

if TYPE_CHECKING:
    from planner.proof.replaying import Replay

OPEN_LOOP, FEEDBACK = 1.5, 0.7  # deg, RMS over the joints of the legs
CLEAR = 5e-3  # m, of heel and toe in the middle of a swing
MIDDLE = (0.1, 0.9)  # of a swing
TOUCHES = 0.5  # N
STANDS = (0.95, 0.66)  # fractions of a cycle, from which to which a foot may be on the belt
CLOSED_PLACE, CLOSED_TURN = 4e-3, np.radians(0.5)  # m and rad, from the start of a gait to its end
CLOSED_SPEED, CLOSED_RATE = 0.03, 0.1  # m/s and rad/s
CLOSED_ACCELERATION, CLOSED_TURNING = 0.3, 1.0  # m/s^2 and rad/s^2
PASSES, SETTLED = 6, 0.01  # of a gait: the last percent is noise, of touch-downs that come and go
_PLACE_AND_TURN = (slice(0, 3), slice(3, 6))  # of PELVIS
FOLLOWS = 2.5  # deg, RMS over joints and time: by as much a planned cycle differs from the next (study, section 7)
PATIENT = {"common_mass": 0.1, "stiffness": 0.1, "common_stiffness": 0.2}
"""What step 5 varies beside the usual: a person's mass, and the stiffness of joints that nobody has measured."""


@dataclass(frozen=True)
class Measures:
    """Of one motion. Sides are in the order of the walker's legs.

    Attributes:
        rms: Joint -> deg from the normal gait, RMS over the motion.
        clearance: Side -> m, the least height of heel and toe in the middle of its swings; infinite without one.
        hip_lift: Side -> m, the most that the swinging hip is above the normal gait's.
        in_stance: Side -> share of stance with the foot on the belt.
        in_swing: Side -> the same of swing.
        stance_force: Side -> N, mean over stance.
        largest_force: N, upwards, of one foot.
        slip: m/s along the belt of what bears, the mean weighted by the force; 0 without a belt.
        depth: m, the deepest that heel or toe is in the belt.
        straightest_knee: deg; beyond 0 the knee is bent backwards.
        pelvis: (6, 2) least and largest deviation from the normal gait, m and rad.
    """

    rms: dict[str, float]
    clearance: dict[str, float]
    hip_lift: dict[str, float]
    in_stance: dict[str, float]
    in_swing: dict[str, float]
    stance_force: dict[str, float]
    largest_force: float
    slip: float
    depth: float
    straightest_knee: float
    pelvis: np.ndarray


def measures(step: Step, xs: np.ndarray) -> Measures:
    """Of states (N+1, nx) at the knots."""
    m = step.walker.mechanism
    q, qd, sides = xs[:, : m.nq], xs[:, m.nq : m.nq + m.nv], step.walker.legs
    away = q - step.states[:, : m.nq]
    joints = {f"{side}_{joint}": m.joint(f"{side}_{joint}").start for side in sides for joint in LEG}
    swinging, standing = ({side: when(step, side) for side in sides} for when in (_swings, _stands))
    lifts = {side: height(step, q, f"{side}_hip") - normal_height(step, f"{side}_hip") for side in sides}
    upward = {side: vertical_force(step, q, qd, side) for side in sides}
    knees = [q[:, joints[f"{side}_knee"]].max() for side in sides]
    pelvis = away[:, [m.joint(name).start for name in PELVIS]]
    return Measures(
        rms={name: float(np.degrees(np.sqrt(np.mean(away[:, i] ** 2)))) for name, i in joints.items()},
        clearance={side: clearance(step, q, side) for side in sides},
        hip_lift={side: float(lifts[side][_swing(step, side)].max(initial=-np.inf)) for side in sides},
        in_stance={side: _mean(upward[side][standing[side]] > TOUCHES) for side in sides},
        in_swing={side: _mean(upward[side][swinging[side]] > TOUCHES) for side in sides},
        stance_force={side: _mean(upward[side][standing[side]]) for side in sides},
        largest_force=float(max(force.max() for force in upward.values())),
        slip=slip(step, q, qd),
        depth=float(contact_forces(m, q, qd).depths.max(initial=0.0)),
        straightest_knee=float(np.degrees(max(knees))),
        pelvis=np.stack([pelvis.min(axis=0), pelvis.max(axis=0)], axis=1),
    )  # fmt: skip


def height(step: Step, q: np.ndarray, site: str) -> np.ndarray:
    """(K,) m over the belt, of configurations q (K, nq)."""
    return frame_pose(step.walker.mechanism, q, site)[:, 2, 3]


def normal_height(step: Step, site: str) -> np.ndarray:
    """(N+1,) m, in the normal gait."""
    return height(step, step.states[:, : step.walker.mechanism.nq], site)


def clearance(step: Step, q: np.ndarray, side: str) -> float:
    """m, the least height of heel and toe in the middle of the swings, at the knots q (N+1, nq)."""
    middle = _swing(step, side, MIDDLE)
    points = [height(step, q[middle], f"{side}_{end}_point") for end in ("heel", "toe")]
    return float(np.min(points, initial=np.inf))


def vertical_force(step: Step, q: np.ndarray, qd: np.ndarray, side: str) -> np.ndarray:
    """(K,) N of the belt on a foot."""
    m = step.walker.mechanism
    found = contact_forces(m, q, qd).forces[:, :, 2]
    return found[:, [side in contact.name for contact in m.contacts]].sum(axis=1)


def slip(step: Step, q: np.ndarray, qd: np.ndarray) -> float:
    """m/s along the belt of heels and toes at K states, the mean weighted by what each bears."""
    m = step.walker.mechanism
    bears = contact_forces(m, q, qd).forces[:, :, 2]
    if not bears.any():
        return 0.0
    speeds = np.zeros(bears.shape)
    for k, contact in enumerate(m.contacts):
        T = np.eye(4)
        T[:3, 3] = contact.centre
        v = np.einsum("kaj,kj->ka", jacobian(m, q, Frame(contact.link, T))[:, :2], qd)
        v[:, 0] -= qd[:, m.joint("belt").start]
        speeds[:, k] = np.linalg.norm(v, axis=1)
    return float(np.sum(bears * speeds) / np.sum(bears))


def robot_wrench(dynamics: RigidBodyDynamics, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
    """(N, 6) N and N m that the pelvis is driven with along xs (N+1, nx), us (N, nu), trunk and pelvis being rigid."""
    m, N = dynamics.mechanism, len(us)
    q, qd = xs[:N, : m.nq], xs[:N, m.nq : m.nq + m.nv]
    qdd = dynamics.rates(xs[:N], us)[:, m.nv : 2 * m.nv]
    # a pelvis that is driven by jerk is heavy for its motors' sake
    tau = rnea(m, q, qd, qdd) - m.armature * qdd - generalized_forces(m, q, qd)
    first = m.joint(PELVIS[0]).start
    return tau[:, first : first + len(PELVIS)]


@dataclass(frozen=True)
class Robot:
    """How hard a robot drives the pelvis: RMS and largest of the lengths of what it does, over the stages.

    Attributes:
        force: N, weight included.
        moment: N m.
        acceleration: m/s^2.
        turning: rad/s^2.
        jerk: m/s^3, from stage to stage.
        twitch: rad/s^3, the same of its turning.
    """

    force: tuple[float, float]
    moment: tuple[float, float]
    acceleration: tuple[float, float]
    turning: tuple[float, float]
    jerk: tuple[float, float]
    twitch: tuple[float, float]


def robot(dynamics: RigidBodyDynamics, xs: np.ndarray, us: np.ndarray) -> Robot:
    """Of a motion xs (N+1, nx), us (N, nu)."""
    m, wrench = dynamics.mechanism, robot_wrench(dynamics, xs, us)
    first = m.nv + m.joint(PELVIS[0]).start
    driven = dynamics.rates(xs[: len(us)], us)[:, first : first + len(PELVIS)]
    jerks = np.diff(driven, axis=0) / dynamics.dt
    lengths = [np.linalg.norm(of[:, part], axis=1) for of in (wrench, driven, jerks) for part in _PLACE_AND_TURN]
    return Robot(*((float(np.sqrt(np.mean(length**2))), float(length.max())) for length in lengths))


def judge_tracking(step: Step, run: Replay) -> Section:
    """How far MuJoCo's legs are from the plan's: RMS over all joints."""
    m = step.walker.mechanism
    joints = [m.joint(f"{side}_{joint}").start for side in step.walker.legs for joint in LEG]
    pelvis = [m.joint(name).start for name in PELVIS]
    error = run.error
    away = np.degrees(error[:, joints])
    bound, how = (FEEDBACK, "with the plan's gains") if run.feedback else (OPEN_LOOP, "without feedback")
    return Section(
        run.title,
        (
            Measured(
                "joint_error", float(np.sqrt(np.mean(away**2))), "deg", bound, f"RMS over the legs' joints, {how}"
            ),
            Measured("largest_joint_error", float(np.abs(away).max()), "deg", None, "over the replay"),
            Measured("pelvis_error", float(np.abs(error[:, pelvis[:3]]).max()), "m", None, "largest, of its place"),
            Measured("pelvis_turn_error", float(np.abs(error[:, pelvis[3:]]).max()), "rad", None, "largest"),
        ),
    )


def closing(step: Step) -> Periodic:
    """What of a gait must come back, and how nearly: all but the belt."""
    names = step.walker.mechanism.joint_names
    sides = [
        [np.inf if name == "belt" else place if name in PELVIS[:3] else turn for name in names]
        for place, turn in ((CLOSED_PLACE, CLOSED_TURN), (CLOSED_SPEED, CLOSED_RATE))
    ]
    accelerations = [CLOSED_ACCELERATION] * 3 + [CLOSED_TURNING] * 3 if step.walker.jerked else []
    return Periodic(np.concatenate([*sides, accelerations]), passes=PASSES, settled=SETTLED)


def judge_step(step: Step, run: Replay, promised: bool, closes: bool = False) -> Section:
    """What the plan and MuJoCo's replay of it came to; clearance is judged where the cost asks enough of it."""
    measured = []
    for who, xs in (("planned", run.plan.xs), ("replayed", run.xs[:: run.substeps])):
        found = measures(step, xs)
        least = min(found.clearance.values())
        note = f"of heel and toe under {1e3 * CLEAR:g} mm in the middle of a swing; the least is {1e3 * least:.1f} mm"
        measured += [
            Measured(f"{who}_clearance_missed", max(0.0, CLEAR - least), "m", 0.0 if promised else None, note),
            Measured(f"{who}_hip_lift", max(found.hip_lift.values()), "m", None, "of the swinging hip above normal"),
            Measured(f"{who}_from_normal", _mean_rms(found), "deg", None, "RMS over the legs' joints"),
        ]  # fmt: skip
        if step.walker.belt:
            measured += [
                Measured(f"{who}_slip", found.slip, "m/s", None, "of what bears, along the belt, by force"),
                Measured(f"{who}_depth", found.depth, "m", None, "of heel or toe in the belt"),
                *(Measured(f"{who}_{side}_in_stance", 100.0 * share, "%", None, "of stance, with the foot on the belt")
                  for side, share in found.in_stance.items()),
            ]  # fmt: skip
        if closes:
            measured += _gaps(step, xs, who)
    assert run.plan.problem is not None  # whose requirements these are
    drive = robot(run.plan.problem.dynamics, run.plan.xs, run.plan.us)  # pyright: ignore[reportArgumentType]
    for name, (rms, most), unit in (("force", drive.force, "N"), ("moment", drive.moment, "N m")):
        measured.append(Measured(f"planned_robot_{name}", most, unit, None, f"largest; RMS {rms:.4g} {unit}"))
    return Section("goal", tuple(measured))


def _gaps(step: Step, xs: np.ndarray, who: str) -> list[Measured]:
    """From the start of a gait to its end; the plan's are judged, MuJoCo's have the errors of the replay in them."""
    m = step.walker.mechanism
    gap = np.abs(xs[-1] - xs[0])[: m.nq]
    pelvis = [m.joint(name).start for name in PELVIS]
    legs = np.delete(gap, [*pelvis, *([m.joint("belt").start] if step.walker.belt else [])])
    judged = who == "planned"
    note = f"from start to end, {who}"
    return [
        Measured(f"{who}_place_gap", float(gap[pelvis[:3]].max()), "m", CLOSED_PLACE if judged else None, note),
        Measured(f"{who}_turn_gap", float(gap[pelvis[3:]].max()), "rad", CLOSED_TURN if judged else None, note),
        Measured(f"{who}_joint_gap", float(np.degrees(np.sqrt(np.mean(legs**2)))), "deg",
               float(np.degrees(CLOSED_TURN)) if judged else None, f"{note}, RMS over the legs' joints"),
    ]  # fmt: skip


def follows(step: Step, xs: np.ndarray, plan_xs: np.ndarray, knots: np.ndarray, clear: bool) -> np.ndarray:
    """(K,) whether perturbed patients walk as planned: the legs near the plan all the way, no foot on the belt.

    Args:
        step: The step.
        xs: (K, T, nx) states.
        plan_xs: (T, nx) the plan's.
        knots: (T,) their stages, of 0 to N.
        clear: Whether heel and toe must be above the belt in the middle of a swing.
    """
    m = step.walker.mechanism
    joints = [m.joint(f"{side}_{joint}").start for side in step.walker.legs for joint in LEG]
    won = np.sqrt(np.mean(np.degrees(xs[..., joints] - plan_xs[:, joints]) ** 2, axis=(1, 2))) < FOLLOWS
    for side in step.walker.legs if clear else ():
        q = xs[:, _swing(step, side, MIDDLE)[knots], : m.nq]
        for end in ("heel", "toe"):
            heights = height(step, q.reshape(-1, m.nq), f"{side}_{end}_point").reshape(q.shape[:2])
            won &= heights.min(axis=1, initial=np.inf) > 0.0
    return won


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if values.size else 0.0


def _mean_rms(found: Measures) -> float:
    return float(np.sqrt(np.mean(np.square(list(found.rms.values())))))


def _swing(step: Step, side: str, within: tuple[float, float] = (0.0, 1.0)) -> np.ndarray:
    """(N+1,) bool: in a part of its swing."""
    part = (step.leg_time(side) - SWING[0]) / (SWING[1] - SWING[0])
    return (part >= within[0]) & (part <= within[1])


def _stands(step: Step, side: str) -> np.ndarray:
    t = step.leg_time(side)
    return (t >= STANDS[0]) | (t <= STANDS[1])


def _swings(step: Step, side: str) -> np.ndarray:
    return ~_stands(step, side)
