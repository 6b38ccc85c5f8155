"""A plan as a table: a CSV file, or a pandas DataFrame.

A row is an instant: its time, the state, the control from it on.

Columns of controls have the names of actuators, so `planner prove --controls` reads a file of controls alone.
"""

from __future__ import annotations

import csv
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import choice
from planner.base.errors import PlannerError
from planner.base.files import PathLike, write_atomically
from planner.model.capabilities import capabilities_of
from planner.model.coordinates import Coordinate, controls_of_mechanism, coordinates_of
from planner.model.mjcf.prescribed_joints import in_order
from planner.problem.export.sampled import ExportedMotion, sampled

TIME = "time"
POSITION = "position of "  # before a joint's name where an actuator is called the same
PARTS = ("states", "controls")


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
        writer.writerow([TIME, *(one.name for one in columns)])
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
    table = np.concatenate(parts, axis=1)
    return columns, table[:-1] if only == "controls" else table


def state_names(plan: ExportedMotion) -> tuple[Coordinate, ...]:
    """Name and unit of each number of a state, nx of them; a quaternion's are "hip quaternion w" and so on."""
    space = plan.space
    if plan.problem is None:
        known = tuple(Coordinate(f"x[{i}]", "") for i in range(space.ndx))
    else:
        known = coordinates_of(plan.problem.dynamics)
    names, taken = [], {name for name, _ in control_names(plan)}
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
