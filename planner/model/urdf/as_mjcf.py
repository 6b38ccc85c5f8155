"""Make MJCF of a URDF file or text."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from planner.base.arguments import choice, short_repr
from planner.base.errors import ModelError, PlannerError
from planner.base.files import printable, read_text
from planner.model.mjcf.text import is_text
from planner.model.urdf.packages import packages_of
from planner.model.urdf.parse import robot_of
from planner.model.urdf.write import mjcf_of

BASES = ("fixed", "free")
INERTIAS = ("given", "nearest")


def is_urdf(model: object) -> bool:
    """Whether a model is a URDF, or xacro that is to become one: by its file's ending, or its text's root element."""
    if is_text(model):
        return "<robot" in str(model)[:100_000] and "<mujoco" not in str(model).split("<robot")[0]
    return isinstance(model, (str, os.PathLike)) and str(model).lower().endswith((".urdf", ".xacro"))


def as_mjcf(
    model: str | Path, base: str | None = None, floor: bool = False, package_path: str | Sequence[str] = (),
    inertia: str = "given",
) -> tuple[str, dict[str, bytes], str]:  # fmt: skip
    """The MJCF that is made of a URDF, its files, and its name for messages; see Mechanism.from_urdf."""
    if base is not None:
        choice("base", base, BASES)
    nearest = choice("inertia", inertia, INERTIAS) == "nearest"
    if not isinstance(floor, bool):
        raise PlannerError(f"floor is {short_repr(floor)}, expected true or false.")
    paths = (package_path,) if isinstance(package_path, (str, os.PathLike)) else tuple(package_path)
    for path in paths:
        if not isinstance(path, (str, os.PathLike)) or not os.path.isdir(path):
            raise PlannerError(f"package_path is {short_repr(path)}, expected a folder of packages, or a list of some.")
    text, name, path = str(model), "the model", None
    if not is_text(model):
        path, name = Path(model), f"the model {printable(model)}"
        text = read_text(path, "the model", raises=ModelError)
    robot = robot_of(text, name)
    packages = packages_of(path, paths, robot.meshdir)
    return *mjcf_of(robot, packages, name, base=base, floor=floor, nearest=nearest), name
