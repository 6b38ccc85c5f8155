"""Write a problem.toml to start from, which runs as it is, for a machine that was only opened."""

from __future__ import annotations

import json
import os
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import first_of, toml_key
from planner.base.errors import FileError, PlannerError
from planner.base.files import PathLike, write_atomically
from planner.cases.problem_file.build import loaded
from planner.cases.problem_file.keys import KEYS
from planner.cases.problem_file.machine import AUTO
from planner.model.mechanism import Mechanism
from planner.model.mjcf.model_file import ModelFile
from planner.problem.description import Description
from planner.problem.example_task import ExampleTask, actuated_joints, example_task

_SMALL, _PART = 0.05, 0.05  # rad or m: the tolerance is written for a shorter way, as this part of it
_WIDE = 100  # characters of a line
_KEYFRAMES = 5  # that are named


def write_first_problem(path: PathLike, model: PathLike, file: ModelFile, known: Description) -> Path:
    """Write a problem file for a model; returns the path.

    Raises:
        FileError: There is a file of that name, or it cannot be written.
        PlannerError: The machine cannot be planned with, nothing in it can be moved, or what would be written does not
            load.
    """
    path = Path(path)
    if path.suffix != ".toml":
        raise PlannerError(f"--write is {path}, expected a name ending in .toml.")
    if not path.parent.is_dir():
        raise FileError(f"--write is {path}, expected a folder that is there: make {path.parent} first.")
    if path.exists():
        raise FileError(f"{path} is there already, expected a new name: nothing is overwritten.")
    text = starter_text(os.path.relpath(model, path.parent), str(path), file, known)
    try:
        loaded(tomllib.loads(text), path)
    except PlannerError as error:
        raise PlannerError(f"no problem file is written, since `planner run` would refuse it: {error}") from None
    with write_atomically(path) as hidden:
        hidden.write_text(text, encoding="utf-8")
    return path


def _no_goal(mechanism: Mechanism, known: Description) -> str:
    """Why no joint gets a goal: none is driven, or none may go anywhere; with the first thing that looks wrong."""
    driven = [known.joints[j]["label"] for j in actuated_joints(mechanism)]
    if not driven:
        return "no hinge or slide is driven, expected one: no goal can be proposed."
    also = f" What looks wrong: {known.troubles[0].problem}; write {known.troubles[0].fix}." if known.troubles else ""
    where = f"for {first_of(driven, 3)} within ranges and without overlaps"
    return f"no goal can be proposed {where}: expected a problem file of your own.{also}"


def starter_text(model: str, name: str, file: ModelFile, known: Description) -> str:
    """The text of a problem file `name` for a model, named as seen from that file.

    Raises:
        PlannerError: As for write_first_problem.
    """
    mechanism = known.loaded.mechanism
    if mechanism is None:
        raise PlannerError(f"there is nothing to write: {known.loaded.refusal}")
    move = example_task(file.survey.model, mechanism, known.joints)
    if not move.goal:
        raise PlannerError(_no_goal(mechanism, known))
    named = all(joint["name"] for joint in known.joints if joint["unit"])
    lines = [f"# planner run {name}", "", *_line("model", json.dumps(Path(model).as_posix()), KEYS["model"])]
    lines += _keys(known, Path(name).parent)
    if mechanism.nu == 0:
        everything = [known.joints[j]["name"] for j in actuated_joints(mechanism)]
        lines += _line("prescribed", json.dumps(everything), "nothing drives these joints: plan their accelerations")
    lines += ["", *_start(move, known, named), *_goal(move, known, named)]
    lines += _line("duration", f"{move.duration:.1f}", KEYS["duration"])
    lines += _line("dt", json.dumps(AUTO), KEYS["dt"])
    way = max(abs(end - move.start[known.joints[j]["position"]]) for j, end in move.goal.items())
    if way < _SMALL:
        lines += _line("tolerance", f"{_PART * way:.2g}", "how far from the goal passes, rad or m: a part of the way")
    if known.name:
        lines += _line("title", json.dumps(known.name), KEYS["title"])
    lines += [
        "# The default has least effort near a smooth motion. This is the smoothest motion that there is:",
        '# objective = "jerk"', "",
        "# [weights]  numbers, or tables by joint (effort: by actuator); `planner list` names them all",
        "# [limits]   bounds of controls, positions and velocities, exact goals", "",
    ]  # fmt: skip
    return "\n".join(lines)


def _keys(known: Description, beside: Path) -> list[str]:
    """The keys without which the model is refused, folders as seen from the folder of the file."""
    lines: list[str] = []
    for key, value in known.loaded.keys.items():
        value = Path(os.path.relpath(value, beside)).as_posix() if key == "package_path" else value
        lines += _line(key, json.dumps(value), KEYS[key])
    return lines


def _start(move: ExampleTask, known: Description, named: bool) -> list[str]:
    if move.keyframe:
        return _line("start", json.dumps(move.keyframe), "a keyframe of the model")
    if not named:
        return _line("start", _numbers(move.start), "all positions, as qpos has them")
    if not move.displaced:
        return _line("start", "{}", "a keyframe, or a table of joints; those not named are where the model puts them")
    return _line(
        "start", _table(move.displaced, known),
        "joints that the model puts outside of their ranges; the others are where it puts them",
    )  # fmt: skip


def _goal(move: ExampleTask, known: Description, named: bool) -> list[str]:
    units = sorted({known.joints[j]["unit"] for j in move.goal})
    words = f"{' and '.join(units)}; joints that are not named end where they started"
    if len(known.keyframes) > 1:
        words += f"; or a keyframe: {', '.join(known.keyframes[:_KEYFRAMES])}"
    if named:
        return _line("goal", _table(move.goal, known), words)
    goal = move.start.copy()
    for j, end in move.goal.items():
        goal[known.joints[j]["position"]] = end
    return _line("goal", _numbers(goal), "all positions, as qpos has them")


def _table(positions: dict[int, float], known: Description) -> str:
    pairs = [f"{toml_key(known.joints[j]['name'])} = {value:.9g}" for j, value in positions.items()]
    return "{ " + ", ".join(pairs) + " }"


def _numbers(values: np.ndarray) -> str:
    return "[" + ", ".join(f"{float(value):.6g}" for value in values) + "]"


def _line(key: str, value: Any, comment: str) -> list[str]:
    """A key with a comment behind it, or above it where the line would be long."""
    entry = f"{key} = {value}"
    return [f"{entry:<30}  # {comment}"] if len(entry) + len(comment) < _WIDE else [f"# {comment}", entry]
