"""A plan from a recording of controls or of joint positions to track, for a proof.

    time, shoulder, elbow          a header with `time` (s) and the names of actuators, or of joints
    0.00, 1.2, -0.3                rows at equal times (of positions at any)
    0.01, 1.3, -0.2

Instead of a CSV the file may be any that read_recording() knows.

Columns named as actuators are controls, each row held until the next one's time; actuators without a column get zero.
Columns named as joints (with `position of ` before the name where an actuator is called the same) are positions to be
followed from the first row's time to the last one's: controls come from inverse dynamics of a spline through them, and
the gains from an LQR about the motion, in stages shorter than the rows are apart where the machine is faster. Of an
exported plan, with states and controls, the controls are taken, from the state in its first row until the time of its
last. What the model has and a plan cannot have is left out of the planned machine; the proof says so, and replays the
file as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import LONGEST_HORIZON
from planner.base.errors import FileError, ModelError, PlannerError
from planner.base.files import printable
from planner.cases.problem_file.states import state_of
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.protocol import feedback_control, rollout, rollout_states
from planner.dynamics.rigid_body import MAX_SUBSTEPS
from planner.model.coordinates import controls_of_mechanism, coordinates_of, coordinates_of_mechanism
from planner.model.mechanism import SCREW, Mechanism
from planner.model.mjcf.unsupported import KINDS
from planner.model.urdf.read import read_model
from planner.problem.costs.tracking import TrackingCost
from planner.problem.export import names_of_states
from planner.problem.initial_guess import inverse_dynamics_controls
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.problem.recording import (
    POSITION,
    STEPS_PER_ROW,
    TIME,
    Recording,
    control_columns,
    other_columns,
    position_columns,
    read_recording,
)
from planner.proof.error_propagation import propagate_errors
from planner.proof.replays.replaying import Replay
from planner.solvers import lq
from planner.solvers.gains import tracking_gains

EVEN = 0.01  # relative, of the spacing of times
_CONTROL_WEIGHT = 0.01  # of a control of the largest size, where 1 rad and 1 rad/s have the weight 1
_START_TOLERANCE = 0.01  # rad or m, between a given start and the first row of positions
_PARTS = 1, 2, 4, 8, 16  # steps from one row to the next: of positions stages, of controls, which are held, substeps
_RESOLVED = 0.5  # of what passes: the predicted error of steps that are short enough
_SMALL = 10.0  # of what passes: larger errors are of steps at which RK4 is not stable, and shorter ones may be stable
_HELPS = 0.5  # of the least error: where that is small, shorter steps that leave more do not help
_EFFORT = 1e-6  # weight of the given controls: the cost is only shown


def plan_of_controls(
    path: str | Path, model: str | Path, *, start: Any = None, goal: Any = None, tolerance: Any = None,
    part: str | None = None, degrees: bool = False,
) -> Plan:  # fmt: skip
    """The plan whose controls or positions are recorded in a file, of the machine in an MJCF or URDF file.

    Args:
        path: The file.
        model: The MJCF or URDF file.
        start: A keyframe, numbers, or positions by joint; by default the model's own, at rest, or the file's first row.
        goal: The same, for the proof to judge the end by; None for none.
        tolerance: How far from the goal passes, as of Problem.
        part: Topic of a bag, or number of an episode; see read_recording().
        degrees: Whether the file has degrees.

    Returns:
        A plan with the status GIVEN: feasibility can be proved, optimality cannot.

    Raises:
        PlannerError: The file or the model cannot be used.
    """
    recording = _recording(Path(path), part, degrees)
    table = recording.table
    mechanism = _readable(model)
    if mechanism.nu == 0:
        raise ModelError(f"{model} has no actuators, expected at least one that the file's columns drive.")
    motion = degrees or Path(path).suffix != ".csv"  # bags and data sets hold positions
    columns = _columns(recording, mechanism, path, motion)
    dt = _spacing(table[:, 0], path, even=not columns.joints)
    x0 = mechanism.home.copy() if start is None else state_of("start", start, mechanism, mechanism.home)
    if columns.joints:
        table = table[:, [0, *columns.joints.values()]]
        joints = [mechanism.joint_names.index(name) for name in columns.joints]
        recorded = _motion_of(mechanism, table, joints, x0 if start is not None else None)
        with_goal, goal = goal is not None, _last(table[-1, 1:], joints, mechanism) if goal is None else goal
        rows = len(table) - 1

        def run_of(parts: int) -> _Run | None:
            return _tracked(RigidBodyDynamics(mechanism, dt / parts), parts * rows, recorded)

        plan = _resolved(run_of, max(1, LONGEST_HORIZON // rows), goal, tolerance, moving=not with_goal)
        if plan is None:
            raise PlannerError(_jumps(recorded, table[:, 0] - table[0, 0]))
    else:
        if columns.states and start is None:
            x0 = table[0, columns.states]
        us = np.zeros((len(table) - bool(columns.states), mechanism.nu))  # at the end of a plan no control acts
        us[:, [*columns.controls]] = table[: len(us), [*columns.controls.values()]]

        def run_of(parts: int) -> _Run | None:
            dynamics = RigidBodyDynamics(mechanism, dt, substeps=parts)
            xs, K = rollout_states(dynamics, x0, us), np.zeros((len(us), mechanism.nu, dynamics.ndx))
            return _Run(dynamics, xs, xs, us, K)

        plan = _resolved(run_of, MAX_SUBSTEPS, goal, tolerance, moving=False)
        if plan is None:
            raise PlannerError(_infinite(path, mechanism, columns))
    return plan


class _Run(NamedTuple):
    """A motion in stages of one length: states that are recorded and reached, controls and gains."""

    dynamics: RigidBodyDynamics
    reference: np.ndarray  # (N+1, nx)
    xs: np.ndarray  # (N+1, nx)
    us: np.ndarray  # (N, nu)
    K: np.ndarray  # (N, nu, ndx)


def _resolved(
    run_of: Callable[[int], _Run | None], most: int, goal: Any, tolerance: Any, moving: bool
) -> Plan | None:  # fmt: skip
    """The plan whose steps, as few as can be from one row to the next, a proof resolves; else that of the least error.

    Rows are as far apart as a recorder had them; the machine may be faster. Steps are halved until the error that is
    predicted of them is well within what passes. Where RK4 is not stable, errors do not fall from one to the next.

    Args:
        run_of: The motion with so many steps from one row to the next; None where there is none.
        most: The largest number of steps from one row to the next.
        goal: As of plan_of_controls().
        tolerance: Likewise.
        moving: Whether it may end in motion.

    Returns:
        None where no steps lead to finite states.
    """
    found, least = None, np.inf
    for parts in dict.fromkeys(min(parts, most) for parts in _PARTS):
        run = run_of(parts)
        plan = None if run is None else _planned(run, goal, tolerance, moving)
        if plan is None:
            continue
        assert plan.problem is not None
        plan.options[STEPS_PER_ROW] = parts
        error = max(float(one.max()) for one in propagate_errors(plan, plan.problem, {}).predicted.values())
        error = error if np.isfinite(error) else np.inf
        enough = error <= _RESOLVED or (least <= _SMALL and error >= _HELPS * least)
        if error <= least:
            found, least = plan, error
        if enough:
            break
    return found


def _planned(run: _Run, goal: Any, tolerance: Any, moving: bool) -> Plan | None:
    """The plan, whose cost refers to the recorded states, without weight but at a goal; None if states are infinite."""
    dynamics, reference, xs, us, K = run
    if not np.isfinite(xs).all():
        return None
    mechanism, N = dynamics.mechanism, len(us)
    Q = np.zeros((N + 1, dynamics.ndx, dynamics.ndx))
    R = np.tile(_EFFORT * dynamics.dt * np.eye(dynamics.nu), (N, 1, 1))
    x_ref = reference.copy()
    if goal is not None:
        at_rest = xs[-1].copy()
        at_rest[mechanism.nq :] = 0.0
        x_ref[-1], Q[N] = state_of("goal", goal, mechanism, at_rest), np.eye(dynamics.ndx)
        if moving:  # a path may end in motion
            Q[N, mechanism.nv :] = 0.0
        Q[N, 2 * mechanism.nv :] = 0.0
    cost = TrackingCost(Q, R, x_ref, 0.0, dynamics.space)
    problem = Problem(dynamics, cost, xs[0], us=us, tolerance=tolerance)
    with np.errstate(all="ignore"):  # of steps at which RK4 is not stable
        A, B = dynamics.linearize(xs, us)
        norm = float(np.linalg.norm(lq.gradient(A, B, cost.quadratize(xs, us))))
    return Plan(
        t=dynamics.dt * np.arange(N + 1), xs=xs, us=us, K=K, cost=cost.value(xs, us), gradient_norm=norm,
        status=Status.GIVEN, history=(), problem=problem, twin=problem.twin,
    )  # fmt: skip


def _readable(model: str | Path) -> Mechanism:
    """The machine without unmodelled features; with contacts where they are modelled."""
    try:
        return read_model(model, ignore=KINDS)
    except ModelError as error:
        if "contacts" not in str(error):
            raise
        return read_model(model, ignore=KINDS, contacts="off")


def _recording(path: Path, part: str | None, degrees: bool) -> Recording:
    """A recording with a time first, and with two rows at least."""
    what = "the controls"
    recording = read_recording(path, what, part, degrees)
    if len(recording.heading) < 2 or recording.heading[0] != TIME:
        raise FileError(
            f"{what} {printable(path)} do not begin with time, expected a header: time, then names of actuators or "
            "joints."
        )
    if not 2 <= len(recording.table) <= LONGEST_HORIZON:
        raise FileError(
            f"{what} {printable(path)} have {len(recording.table)} rows below the header, expected 2 to "
            f"{LONGEST_HORIZON}."
        )
    return recording


def _spacing(times: np.ndarray, path: str | Path, even: bool) -> float:
    """The mean time between rows, s, which is that of each where they are to be `even`."""
    steps = np.diff(times)
    dt = float(np.mean(steps))
    if not np.all(steps > 0.0) or (even and np.any(np.abs(steps - dt) > EVEN * dt)):
        expected = "rows at equal times; resample them" if even else "times that rise"
        raise FileError(f"the times of {path} are {steps.min():.4g} to {steps.max():.4g} s apart, expected {expected}.")
    return dt


class _Columns(NamedTuple):
    """The columns that are taken: of controls, of positions, or of controls and the state in the first row."""

    controls: dict[int, int]  # by actuator
    joints: dict[str, int]  # by name
    states: list[int]  # nx of them, or none


def _columns(recording: Recording, mechanism: Mechanism, path: str | Path, motion: bool) -> _Columns:
    """The columns to take of a file that holds `motion` only, or also controls.

    Where all columns may be controls they are: a URDF's actuators have the names of its joints.
    """
    names = list(recording.heading[1:])
    units = {name: unit for name, unit in controls_of_mechanism(mechanism) if name in mechanism.actuators.names}
    joints = [name for name in mechanism.joint_names if name]
    if len(set(names)) == len(names):
        positions = position_columns(recording, joints, units)
        controls = {} if motion else control_columns(recording, joints, units)
        number_of = {name: a for a, name in enumerate(mechanism.actuators.names)}
        by_actuator = {number_of[name]: column for name, column in controls.items()}
        if len(controls) == len(names):
            return _Columns(by_actuator, {}, [])
        states = _state_columns(recording, mechanism)
        other = set(other_columns(recording, joints, units)).difference(recording.heading[column] for column in states)
        if not other and controls and states:
            return _Columns(by_actuator, {}, states)
        if not other and set(positions) == set(joints):
            return _Columns({}, positions, [])
        if not units and len(names) == mechanism.nu:
            return _Columns({a: a + 1 for a in range(mechanism.nu)}, {}, [])
    raise FileError(
        f"{path} has the columns {', '.join(names)[:120]}, expected each once: actuators "
        f"({', '.join(units) or 'none has a name'}), or all joints ({', '.join(joints) or 'none has a name'}; "
        f"{POSITION + 'JOINT'!r} where an actuator is called the same); of a plan `planner export --only controls` "
        "writes them."
    )


def _state_columns(recording: Recording, mechanism: Mechanism) -> list[int]:
    """The columns (nx,) of a state, as a plan's table has them; none where one is missing."""
    taken = {name for name, _ in controls_of_mechanism(mechanism)}
    names = names_of_states(coordinates_of_mechanism(mechanism), mechanism.space, taken)
    if any(name not in recording.heading for name, _ in names):
        return []
    return [recording.heading.index(name) for name, _ in names]


def _infinite(path: str | Path, mechanism: Mechanism, columns: _Columns) -> str:
    """That controls lead nowhere, and how to say that they are none."""
    names = [mechanism.actuators.names[a] for a in columns.controls]
    shared = [name for name in names if name in mechanism.joint_names]
    if not shared or columns.states:
        return f"the controls of {path} lead to infinite states, expected those of this model."
    return (
        f"the columns {', '.join(shared)} of {path} are read as controls, since actuators have these names, and lead "
        f"to infinite states: expected controls of this model, or for positions the heading {POSITION + shared[0]!r} "
        "and so on, or --degrees where they are in degrees."
    )


def _last(row: np.ndarray, joints: list[int], mechanism: Mechanism) -> dict[str, float]:
    """The last row as a goal: a motion that is to be followed is to end where it says."""
    return {mechanism.joint_names[j]: float(value) for j, value in zip(joints, row, strict=True)}


class _Motion(NamedTuple):
    """Recorded positions (nq,) over time, a spline, and the start of who follows it; None for the motion's own."""

    positions: Any
    start: np.ndarray | None


def _motion_of(mechanism: Mechanism, table: np.ndarray, joints: list[int], x0: np.ndarray | None) -> _Motion:
    """The spline through a table (N+1, 1 + nv) of times and positions."""
    from scipy.interpolate import make_interp_spline

    if not np.all(mechanism.kind == SCREW):
        raise PlannerError("the model has ball or free joints, expected hinges and slides to follow joint positions.")
    if len(table) < 7:
        raise PlannerError(f"{len(table)} rows of positions are given, expected at least 7 to know accelerations.")
    links = [mechanism.joint_links[j].start for j in joints]
    q = np.empty((len(table), mechanism.nq))
    q[:, mechanism.q_address[links]] = table[:, 1:]
    if x0 is not None and np.abs(x0[: mechanism.nq] - q[0]).max() > _START_TOLERANCE:
        raise PlannerError(
            f"the start is {np.abs(x0[: mechanism.nq] - q[0]).max():.3g} from the first row of positions, expected the "
            "same: leave --start out."
        )
    return _Motion(make_interp_spline(table[:, 0] - table[0, 0], q, k=5), x0)


def _tracked(dynamics: RigidBodyDynamics, N: int, motion: _Motion) -> _Run | None:
    """The motion followed in N stages: controls by inverse dynamics, gains of an LQR about it; None if it has none."""
    mechanism, dt, spline = dynamics.mechanism, dynamics.dt, motion.positions
    t = dt * np.arange(N + 1)
    middle = t[:-1] + 0.5 * dt  # the best time for a control that is constant over a stage
    us = inverse_dynamics_controls(mechanism, spline(middle), spline(middle, 1), spline(middle, 2))
    reference = np.concatenate([spline(t), spline(t, 1)], axis=1)
    A, B = dynamics.linearize(reference, us)
    size = np.maximum(np.abs(us).max(axis=0), np.finfo(float).tiny)
    Q, R = dt * np.eye(dynamics.ndx), dt * _CONTROL_WEIGHT * np.diag(1.0 / size**2)
    K = tracking_gains(A, B, np.tile(Q, (N + 1, 1, 1)), np.tile(R, (N, 1, 1)))
    if K is None:  # R is positive definite, Q semidefinite: the numbers are too far apart
        return None
    start = reference[0] if motion.start is None else motion.start
    return _Run(dynamics, reference, *rollout(dynamics, start, us, feedback_control(dynamics, reference, us, K)), K)


def _jumps(motion: _Motion, t: np.ndarray) -> str:
    """That nothing follows a motion, whose rows are at the times t, s."""
    fastest = float(np.abs(motion.positions(t, 2)).max())
    return (
        f"the positions jump, by accelerations up to {fastest:.3g} in rad/s^2 or m/s^2, and no gains follow them, "
        "expected a motion of the joints: columns of controls bear the names of actuators."
    )


def recording_errors(replay: Replay) -> list[tuple[str, ...]]:
    """How far each joint of a replay is from its recording: name, largest error, its time, root mean square."""
    problem = replay.plan.problem
    assert problem is not None
    assert isinstance(problem.cost, TrackingCost)
    rows = []
    for i, joint in enumerate(coordinates_of(problem.dynamics)[: problem.dynamics.nx // 2]):  # no ball or free joints
        recorded = np.interp(replay.t, replay.plan.t, problem.cost.x_ref[:, i])
        error = np.abs(replay.xs[:, i] - recorded)
        worst, rms = int(np.argmax(error)), float(np.sqrt(np.mean(error**2)))
        rows.append((joint.name, f"{error[worst]:.3g} {joint.unit}", f"{replay.t[worst]:.2f} s", f"{rms:.3g}"))
    return rows
