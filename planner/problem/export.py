"""A plan for other programs: tables, ROS 2 joint trajectories, MuJoCo keyframes, all made from sampled().

Sampled: the plan at its knots, or at any rate. Controls are constant over a stage: us[n] at time t in stage n. States
between knots are integrated over a part of the stage by the plan's dynamics; so quaternions remain unit ones, and
states at knots are bitwise equal. Without an integrator (a plan without its problem, discrete dynamics) states are
interpolated on the state space: x = integrate(x_n, s difference(x_n+1, x_n)), 0 <= s <= 1.

Table: a row is an instant: its time, the state, the control from it on. Columns of controls have the names of
actuators, so `planner prove --controls` reads a file of controls alone. In a file units follow names: "elbow [rad]". A
plan with touch-downs also has which feet stand when.

Joint trajectory: ROS 2's trajectory_msgs/JointTrajectory, as YAML or JSON; no ROS is needed. It has joints of one
coordinate: hinges (rad) and slides (m). Free and ball joints are omitted. Accelerations and efforts are empty, as the
message allows: a plan's accelerations are discontinuous between stages, and its controls are those of actuators, not of
joints.

Keyframes: a small MJCF that a model includes, <include file="plan.keys.xml"/>. A keyframe has the time, qpos, qvel, act
and ctrl of the model that the plan is replayed in. In MuJoCo's viewer they are a list to click through; in a program
`mujoco.mj_resetDataKeyframe(model, data, k)` sets one.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Collection, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, Protocol
from xml.etree import ElementTree

import numpy as np

from planner.base.arguments import LONGEST_HORIZON, choice, number
from planner.base.errors import FileError, PlannerError
from planner.base.files import PathLike, as_path, printable, write_atomically
from planner.model.capabilities import capabilities_of
from planner.model.coordinates import Coordinate, controls_of_mechanism, coordinates_of
from planner.model.mechanism import SCREW, Mechanism
from planner.model.mjcf.model_index import compile_model
from planner.model.mjcf.prescribed_joints import in_order
from planner.model.space import StateSpace
from planner.model.twin import Twin
from planner.problem.recording import POSITION, TIME
from planner.problem.touch_downs import TouchDown, standing

_ROUNDING = 1e-9  # relative distance below which a time counts as a knot
_TIME = Coordinate(TIME, "s")
STANDS = "stands: "  # before a foot's name: 1 while it bears load in the plan, else 0
PARTS = ("states", "controls")
SUFFIXES = (".yaml", ".yml", ".json")
MAX_KEYFRAMES = 10_000  # MuJoCo lists them all


class ExportedMotion(Protocol):
    """Attributes of a plan that exports read."""

    @property
    def t(self) -> np.ndarray: ...  # noqa: D102
    @property
    def xs(self) -> np.ndarray: ...  # noqa: D102
    @property
    def us(self) -> np.ndarray: ...  # noqa: D102
    @property
    def problem(self) -> Any: ...  # noqa: D102
    @property
    def space(self) -> StateSpace: ...  # noqa: D102
    @property
    def twin(self) -> Twin | None: ...  # noqa: D102
    @property
    def touch_downs(self) -> tuple[TouchDown, ...]: ...  # noqa: D102


class Samples(NamedTuple):
    """A plan at M instants; the last one is its end."""

    t: np.ndarray  # (M,) s
    xs: np.ndarray  # (M, nx) states
    us: np.ndarray  # (M, nu) controls that act from t on; at the end those of the last stage
    stages: np.ndarray  # (M,) the stage n of each instant: gains are K[n]


def sampled(plan: ExportedMotion, rate: float | None = None) -> Samples:
    """The plan at its knots, or at `rate` Hz and at its end.

    The last step is shorter than the others where the duration is no whole number of them.

    Raises:
        PlannerError: The rate is not a number above 0 or gives too many samples, or the plan is not finite.
    """
    if not (np.isfinite(plan.xs).all() and np.isfinite(plan.us).all()):
        raise PlannerError("the plan has states or controls that are not finite, expected one that can be used.")
    N, dt = len(plan.us), float(plan.t[-1]) / len(plan.us)
    if rate is None:
        stages = np.minimum(np.arange(N + 1), N - 1)
        return Samples(plan.t.copy(), plan.xs.copy(), plan.us[stages], stages)
    rate = number("rate", rate, greater_than=0.0)
    periods = float(plan.t[-1]) * rate
    if not periods < LONGEST_HORIZON:
        raise PlannerError(
            f"rate is {rate:g} Hz, expected less: {periods:.3g} samples are more than {LONGEST_HORIZON}."
        )
    t = np.append(np.arange(math.ceil(periods * (1.0 - _ROUNDING))) / rate, plan.t[-1])
    stages = np.minimum(np.floor(t / dt * (1.0 + _ROUNDING)).astype(np.int64), N - 1)
    return Samples(t, _states(plan, t, stages, dt), plan.us[stages], stages)


def _states(plan: ExportedMotion, t: np.ndarray, stages: np.ndarray, dt: float) -> np.ndarray:
    """The states (M, nx) at instants t (M,) of some stages (M,)."""
    parts = t / dt - stages  # of a stage, 0 to 1
    xs = plan.xs[stages]
    xs[parts > 1.0 - _ROUNDING] = plan.xs[-1]
    inside = np.flatnonzero((parts > _ROUNDING) & (parts < 1.0 - _ROUNDING))
    if len(inside) == 0:
        return xs
    n, dynamics = stages[inside], getattr(plan.problem, "dynamics", None)
    if dynamics is not None and getattr(dynamics, "integrator", None) != "discrete":
        xs[inside] = dynamics.step(plan.xs[n], plan.us[n], dt * parts[inside])
    else:
        ways = plan.space.difference(plan.xs[n + 1], plan.xs[n])
        xs[inside] = plan.space.integrate(plan.xs[n], parts[inside, None] * ways)
    return xs


def write_csv(plan: ExportedMotion, path: PathLike, rate: float | None = None, only: str | None = None) -> Path:
    """Write a plan as a CSV file: a header, then a row for every instant, numbers to their last bit.

    Args:
        plan: The plan.
        path: The file.
        rate: Samples a second; None for the plan's knots.
        only: "states" or "controls"; None for both. Controls alone have no row at the end, where none acts.

    Raises:
        PlannerError: An argument is wrong, or the plan is not finite.
        FileError: The file cannot be written.
    """
    columns, table = _table(plan, rate, only)
    with write_atomically(path) as unfinished, open(unfinished, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(f"{one.name} [{one.unit}]" if one.unit else one.name for one in (_TIME, *columns))
        writer.writerows(table.tolist())  # repr() of a float gives every bit back
    return Path(path)


def frame_of(plan: ExportedMotion, rate: float | None = None, only: str | None = None) -> Any:
    """A plan as a pandas DataFrame whose index is the time, s; `frame.attrs["units"]` has the units by column.

    Raises:
        PlannerError: pandas is not installed, an argument is wrong, or the plan is not finite.
    """
    try:
        pandas = import_module("pandas")
    except ImportError:
        raise PlannerError("pandas is not installed, expected it for a DataFrame: pip install pandas.") from None
    columns, table = _table(plan, rate, only)
    index = pandas.Index(table[:, 0], name=TIME)
    frame = pandas.DataFrame(table[:, 1:], index=index, columns=[one.name for one in columns])
    frame.attrs["units"] = {one.name: one.unit for one in columns}
    return frame


def _table(plan: ExportedMotion, rate: float | None, only: str | None) -> tuple[list[Coordinate], np.ndarray]:
    """Names and units of the columns after the time, and the table with it."""
    if only is not None:
        choice("only", only, PARTS)
    samples = sampled(plan, rate)
    columns: list[Coordinate] = []
    parts = [samples.t[:, None]]
    if only != "controls":
        columns += state_names(plan)
        parts.append(samples.xs)
    if only != "states":
        columns += control_names(plan)
        parts.append(samples.us)
    if only is None:
        mechanism = capabilities_of(getattr(plan.problem, "dynamics", None)).mechanism
        feet = standing(mechanism, samples.xs) if mechanism is not None and plan.touch_downs else {}
        columns += [Coordinate(f"{STANDS}{foot}", "") for foot in feet]
        parts += [stands[:, None].astype(float) for stands in feet.values()]
    table = np.concatenate(parts, axis=1)
    return columns, table[:-1] if only == "controls" else table


def state_names(plan: ExportedMotion) -> tuple[Coordinate, ...]:
    """Name and unit of each number of a state, nx of them; a quaternion's are "hip quaternion w" and so on."""
    space = plan.space
    if plan.problem is None:
        known = tuple(Coordinate(f"x[{i}]", "") for i in range(space.ndx))
    else:
        known = coordinates_of(plan.problem.dynamics)
    return names_of_states(known, space, {name for name, _ in control_names(plan)})


def names_of_states(known: Sequence[Coordinate], space: StateSpace, taken: Collection[str]) -> tuple[Coordinate, ...]:
    """As state_names(), of the coordinates of a space and the names that controls have taken."""
    names: list[Coordinate] = []
    addresses = dict(space.quaternions)  # of each quaternion: its address in the deviation
    address = 0  # in the deviation
    while len(names) < space.nx:
        name, unit = known[address]
        if len(names) in addresses:
            body = name.removesuffix(" rotation about x")
            names += [Coordinate(f"{body} quaternion {axis}", "") for axis in "wxyz"]
            address += 3
        else:
            names.append(Coordinate(f"{POSITION}{name}" if name in taken else name, unit))
            address += 1
    return tuple(names)


def control_names(plan: ExportedMotion) -> tuple[Coordinate, ...]:
    """Name and unit of each control: the actuators', then the joints' whose accelerations are controls."""
    nu = plan.us.shape[1]
    dynamics = getattr(plan.problem, "dynamics", None)
    mechanism = capabilities_of(dynamics).mechanism
    controls: list[Coordinate] = []
    if mechanism is not None:
        controls += controls_of_mechanism(mechanism)
        for joint in in_order(mechanism, getattr(dynamics, "prescribed", ())):
            links = mechanism.joint(joint)
            axes = [""] if links.stop - links.start == 1 else [f" {i}" for i in range(links.stop - links.start)]
            controls += [Coordinate(f"acceleration of {joint}{axis}", "") for axis in axes]
    return tuple(controls) if len(controls) == nu else tuple(Coordinate(f"u[{i}]", "") for i in range(nu))


def joint_trajectory(plan: ExportedMotion, path: PathLike | None = None, rate: float | None = None) -> dict[str, Any]:
    """The message as a dictionary, also written to a file where a path is given.

    Args:
        plan: The plan.
        path: The file, ending in .yaml, .yml or .json; None for none.
        rate: Points a second; None for the plan's knots.

    Raises:
        PlannerError: The plan's machine has no hinge or slide, the rate is wrong, or the plan is not finite.
        FileError: The path has another ending, or the file cannot be written.
    """
    if path is not None and as_path(path).suffix not in SUFFIXES:
        raise FileError(f"cannot write a joint trajectory to {printable(path)}: expected a name in {_list(SUFFIXES)}.")
    names, positions, velocities = _single_joints(plan)
    samples = sampled(plan, rate)
    points = [
        {
            "positions": x[positions].tolist(), "velocities": x[velocities].tolist(), "accelerations": [],
            "effort": [], "time_from_start": _duration(t),
        }
        for t, x in zip(samples.t, samples.xs, strict=True)
    ]  # fmt: skip
    header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    message = {"header": header, "joint_names": names, "points": points}
    if path is not None:
        as_json = Path(path).suffix == ".json"
        text = json.dumps(message, indent=1, allow_nan=False) if as_json else "\n".join(_yaml(message))
        with write_atomically(path) as unfinished:
            unfinished.write_text(f"{text}\n", encoding="utf-8")
    return message


def left_out(plan: ExportedMotion) -> tuple[str, ...]:
    """Names of the joints that the message omits: free and ball joints."""
    mechanism = _mechanism(plan)
    every = zip(mechanism.joint_names, mechanism.joint_links, strict=True)
    return tuple(name or f"joint {j}" for j, (name, links) in enumerate(every) if not _single(mechanism, links))


def _single_joints(plan: ExportedMotion) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Names of hinges and slides, and the indices of their positions and velocities in a state."""
    mechanism, names, dofs = _mechanism(plan), [], []
    for j, (name, links) in enumerate(zip(mechanism.joint_names, mechanism.joint_links, strict=True)):
        if _single(mechanism, links):
            names.append(name or f"joint {j}")
            dofs.append(links.start)
    if not names:
        raise PlannerError("a joint trajectory needs hinges or slides, but the plan's machine has none; write a CSV.")
    return names, mechanism.q_address[dofs], mechanism.nq + np.array(dofs)


def _mechanism(plan: ExportedMotion) -> Mechanism:
    mechanism = capabilities_of(getattr(plan.problem, "dynamics", None)).mechanism
    if mechanism is None:
        raise PlannerError(
            "a joint trajectory needs the names of joints, but the plan's dynamics have no Mechanism; write a CSV."
        )
    return mechanism


def _single(mechanism: Mechanism, links: slice) -> bool:
    return links.stop - links.start == 1 and mechanism.kind[links.start] == SCREW


def _duration(t: float) -> dict[str, int]:
    """A time as ROS has it: whole seconds and nanoseconds."""
    nanoseconds = round(float(t) * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def _yaml(message: dict[str, Any]) -> Iterator[str]:
    """The lines of the message as YAML 1.1, where numbers with an exponent need a point."""
    yield "header: {stamp: {sec: 0, nanosec: 0}, frame_id: ''}"
    yield "joint_names:"
    yield from (f"- {json.dumps(name)}" for name in message["joint_names"])
    yield "points:"
    for point in message["points"]:
        at = point["time_from_start"]
        yield f"- positions: [{', '.join(map(_number, point['positions']))}]"
        yield f"  velocities: [{', '.join(map(_number, point['velocities']))}]"
        yield "  accelerations: []"
        yield "  effort: []"
        yield f"  time_from_start: {{sec: {at['sec']}, nanosec: {at['nanosec']}}}"


def _number(value: float) -> str:
    assert math.isfinite(value)
    text = repr(value)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def _list(names: tuple[str, ...]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"


def write_keyframes(plan: ExportedMotion, path: PathLike, rate: float | None = None) -> Path:
    """Write a plan as an MJCF with one keyframe an instant, named plan_0, plan_1 and so on.

    Args:
        plan: The plan.
        path: The file.
        rate: Keyframes a second; None for the plan's knots.

    Raises:
        PlannerError: The plan has no MuJoCo model, the rate is wrong, or the plan is not finite.
        FileError: The file cannot be written.
    """
    if plan.twin is None:
        raise PlannerError("keyframes need the states of a MuJoCo model, but the plan has none; write a CSV.")
    samples = sampled(plan, rate)
    if len(samples.t) > MAX_KEYFRAMES:
        raise PlannerError(
            f"the plan makes {len(samples.t)} keyframes, expected at most {MAX_KEYFRAMES}: lower the rate."
        )
    model: Any = compile_model(plan.twin.mjcf, plan.twin.assets)
    qpos, qvel, act = np.split(plan.twin.sim_of(samples.xs), [model.nq, model.nq + model.nv], axis=1)
    rows = {"qpos": qpos, "qvel": qvel, "act": act}
    if model.nu == samples.us.shape[1]:
        rows["ctrl"] = samples.us
    root = ElementTree.Element("mujoco")
    keyframe = ElementTree.SubElement(root, "keyframe")
    for k, t in enumerate(samples.t):
        values = {name: " ".join(map(repr, row[k].tolist())) for name, row in rows.items() if row.shape[1]}
        ElementTree.SubElement(keyframe, "key", {"name": f"plan_{k}", "time": repr(float(t)), **values})
    ElementTree.indent(root)
    with write_atomically(path) as unfinished:
        unfinished.write_text(ElementTree.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
    return Path(path)
