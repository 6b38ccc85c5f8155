"""Pictures of a step: poses as in the paper's Fig. 5, and its numbers beside those of the normal gait.

The curves of a leg run over its own cycle, from its heel strike, so that left, right and several cycles lie on the same
normal gait. The curves of the pelvis run over the cycle of the right leg.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from planner.cases.human_step.gait import COLUMNS
from planner.cases.human_step.measures import height, normal_height, robot_wrench, vertical_force
from planner.cases.human_step.walker import LEG, PELVIS, SWING, GaitPhase
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.kinematics import frame_pose
from planner.problem.appearance import (
    Band,
    CasePicture,
    Chart,
    Charts,
    CurveData,
    Paths,
    PoseSequence,
    Stick,
    StickFigures,
    Trace,
)

if TYPE_CHECKING:
    from planner.problem.plan import Plan
    from planner.proof.replays.replaying import Replay

POSES = 9
Motions = list[tuple[str, np.ndarray, np.ndarray]]  # label ("" for the plan), times in cycles (K,), states (K, nx)
SAMPLES = 201  # of the normal gait over a cycle
IN_MUJOCO, NORMAL = "in MuJoCo", "normal gait"
PLACES, TURNS = ("x", "y", "z"), ("tilt", "list", "rotation")


def step_pictures(
    step: GaitPhase, tolerances: Mapping[str, float], plan: Plan, replay: Replay | None
) -> tuple[CasePicture, ...]:
    """Poses, measures and the path of the pelvis; the cost's tolerances are by joint of a leg, rad."""
    return poses(step, plan), measured(step, tolerances, plan, replay), pelvis_path(step, plan, replay)


def poses(step: GaitPhase, plan: Plan) -> StickFigures:
    """Stick figures as in the paper's Fig. 5: optimized motion solid, normal gait dashed."""
    frames, sticks = ["right_hip", "left_hip"], [Stick((0, 1))]
    for hue, side in enumerate(step.walker.legs):
        first = len(frames)
        frames += [f"{side}_{name}" for name in ("knee_centre", "ankle_centre", "heel_point", "toe_point")]
        hip, knee, ankle, heel, toe = frames.index(f"{side}_hip"), *range(first, first + 4)
        sticks.append(Stick((hip, knee, ankle, heel, toe, ankle), f"{side} leg", hue))
    motions = [
        PoseSequence(label, _points(step, xs, frames), dashed)
        for label, xs, dashed in (("optimized", plan.xs, False), (NORMAL, step.states, True))
    ]
    times = tuple(f"{100.0 * t:.0f} %" for t in np.linspace(step.t[0], step.t[-1], POSES))
    return StickFigures(
        "The motion beside the normal gait, over the right leg's cycle (the paper's Fig. 5)", motions, sticks, times,
        ground=0.0, title="Optimized and normal gait",
    )  # fmt: skip


def pelvis_path(step: GaitPhase, plan: Plan, replay: Replay | None) -> Paths:
    """The path of the point between the hips."""
    start = step.walker.mechanism.joint(PELVIS[0]).start
    place = slice(start, start + 3)
    traces = [Trace("optimized", plan.xs[:, place]), Trace(NORMAL, step.states[:, place], dashed=True)]
    if replay is not None and step.walker.motors:  # a prescribed pelvis moves as planned
        traces.insert(1, Trace(IN_MUJOCO, _finite(replay)[1][:, place]))
    return Paths("The path of the pelvis, where the hips are; a dot is where it begins", traces, "Path of the pelvis")


def measured(step: GaitPhase, tolerances: Mapping[str, float], plan: Plan, replay: Replay | None) -> Charts:
    """Charts of joints, heights, forces, the pelvis and the robot's wrench."""
    motions: Motions = [("", step.t, plan.xs)]
    if replay is not None:
        seconds, xs = _finite(replay)
        motions.append((IN_MUJOCO, step.begin + seconds / step.duration, xs))
    whole = step.walker.belt
    grid = np.linspace(0.0 if whole else SWING[0], 1.0, SAMPLES)
    normal = step.normal.at(grid).q
    charts = [_joint(step, joint, np.degrees(tolerances[joint]), motions, normal) for joint in LEG]
    charts += [_hip_height(step, motions), _foot_height(step, motions, grid)]
    if whole:
        charts.append(_foot_force(step, motions))
    charts += _pelvis(step, motions)
    charts += _wrench(step, plan)
    return Charts(
        "Joint angles beside the normal gait, heights of hip and foot, forces of the belt, motion of the pelvis, and "
        "forces of the robot on it", 100.0 * grid, charts, "cycle from heel strike, %", "The step in numbers",
        "swing" if whole else "",
    )  # fmt: skip


def by_cycle(t: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Percent of the cycle and values, from values (K,) at t (K,) cycles, with a gap where the next cycle begins."""
    whole = np.floor(t + 1e-9)
    percent = 100.0 * (t - whole)
    ends = np.flatnonzero(np.diff(whole) > 0)
    share = (whole[ends + 1] - t[ends]) / (t[ends + 1] - t[ends])
    between = values[ends] + share * (values[ends + 1] - values[ends])
    at = np.repeat(ends + 1, 3)
    gap = np.stack([between, np.full(len(ends), np.nan), between], axis=1).ravel()
    return np.insert(percent, at, np.tile([100.0, 100.0, 0.0], len(ends))), np.insert(values, at, gap)


def _joint(step: GaitPhase, joint: str, tolerance: float, motions: Motions, normal: np.ndarray) -> Chart:
    columns = {side: step.walker.mechanism.joint(f"{side}_{joint}").start for side in step.walker.legs}
    curves = _of_legs(step, motions, lambda side, t, xs: np.degrees(xs[:, columns[side]]))
    mean = np.degrees(normal[:, COLUMNS.index(f"right_{joint}")])
    band = Band("normal gait, \N{PLUS-MINUS SIGN} the cost's tolerance", mean, tolerance)
    return Chart(joint.replace("_", " ").capitalize(), "angle, deg", curves, band, _swing(step))


def _hip_height(step: GaitPhase, motions: Motions) -> Chart:
    """Height of each hip over that of the normal gait."""

    def lift(side: str, t: np.ndarray, xs: np.ndarray) -> np.ndarray:
        normal = np.interp(t, step.t, normal_height(step, f"{side}_hip"))
        return 1e3 * (height(step, _q(step, xs), f"{side}_hip") - normal)

    return Chart("Hip over the normal gait's", "height, mm", _of_legs(step, motions, lift), None, _swing(step))


def _foot_height(step: GaitPhase, motions: Motions, grid: np.ndarray) -> Chart:
    def lowest(side: str, t: np.ndarray, xs: np.ndarray) -> np.ndarray:
        return 1e3 * np.minimum(*(height(step, _q(step, xs), f"{side}_{end}_point") for end in ("heel", "toe")))

    feet = step.feet(step.normal.at(grid).q)
    band = Band(NORMAL, 1e3 * feet[:, 1:3, 2].min(axis=1), 0.0)
    curves = _of_legs(step, motions, lowest)
    return Chart("Foot, the lower of heel and toe", "height, mm", curves, band, _swing(step))


def _foot_force(step: GaitPhase, motions: Motions) -> Chart:
    m = step.walker.mechanism

    def upward(side: str, t: np.ndarray, xs: np.ndarray) -> np.ndarray:
        return vertical_force(step, xs[:, : m.nq], xs[:, m.velocities], side)

    return Chart("Belt on a foot, upwards", "force, N", _of_legs(step, motions, upward), None, _swing(step))


def _pelvis(step: GaitPhase, motions: Motions) -> list[Chart]:
    """Position of the pelvis, relative to the mean of the normal gait, and its orientation."""
    first = step.walker.mechanism.joint(PELVIS[0]).start
    pelvis = slice(first, first + len(PELVIS))
    middle = np.append(step.states[:, pelvis][:, :3].mean(axis=0), np.zeros(3))
    scale = np.repeat([1e3, 180.0 / np.pi], 3)
    drawn = [*motions, (NORMAL, step.t, step.states)]
    return _by_axis(
        [(label, t, scale * (xs[:, pelvis] - middle)) for label, t, xs in drawn],
        ("Pelvis, from the middle of normal gait", "place, mm"), ("Pelvis", "angle, deg"),
    )  # fmt: skip


def _wrench(step: GaitPhase, plan: Plan) -> list[Chart]:
    """Forces and moments of the robot on the pelvis."""
    assert plan.problem is not None  # the pictures belong to a problem
    dynamics = plan.problem.dynamics
    assert isinstance(dynamics, RigidBodyDynamics)
    motions: Motions = [("", step.t[:-1], robot_wrench(dynamics, plan.xs, plan.us))]
    return _by_axis(motions, ("Robot on the pelvis", "force, N"), ("Robot on the pelvis", "moment, N m"))


def _by_axis(motions: Motions, *heads: tuple[str, str]) -> list[Chart]:
    """A chart of title and unit for places, and one for turns: a curve of every axis and motion, of values (K, 6)."""
    charts = []
    for (title, unit), names, offset in zip(heads, (PLACES, TURNS), (0, 3), strict=True):
        curves = []
        for k, name in enumerate(names):
            for label, t, values in motions:
                percent, ys = by_cycle(t, values[:, offset + k])
                curves.append(CurveData(label or name, ys, bool(label), name if label else "", percent))
        charts.append(Chart(title, unit, curves, None))
    return charts


def _of_legs(
    step: GaitPhase, motions: Motions, values: Callable[[str, np.ndarray, np.ndarray], np.ndarray]
) -> list[CurveData]:  # fmt: skip
    """A curve of every motion and leg over the leg's cycle; `values` of (side, t, xs) are its (K,) values."""
    curves = []
    for label, t, xs in motions:
        for side in step.walker.legs:
            percent, ys = by_cycle(t + (0.0 if side == "right" else 0.5), values(side, t, xs))
            curves.append(CurveData(label or side, ys, bool(label), side if label else "", percent))
    return curves


def _swing(step: GaitPhase) -> tuple[tuple[float, float], ...]:
    return ((100.0 * SWING[0], 100.0 * SWING[1]),) if step.walker.belt else ()


def _q(step: GaitPhase, xs: np.ndarray) -> np.ndarray:
    return xs[:, : step.walker.mechanism.nq]


def _points(step: GaitPhase, xs: np.ndarray, frames: list[str]) -> np.ndarray:
    """Places (K, P, 3) of frames, m."""
    q = _q(step, xs)
    return np.stack([frame_pose(step.walker.mechanism, q, frame)[:, :3, 3] for frame in frames], axis=1)


def _finite(replay: Replay) -> tuple[np.ndarray, np.ndarray]:
    """Times (K,), s, and states (K, nx) at the plan's knots, up to where the replay diverged."""
    t, xs = replay.t[:: replay.substeps], replay.xs[:: replay.substeps]
    finite = np.isfinite(xs).all(axis=1)
    known = len(xs) if finite.all() else int(np.argmin(finite))
    return t[:known], xs[:known]
