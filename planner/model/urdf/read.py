"""Read a model by its file's kind: a URDF as the MJCF that is made of it, MJCF as it is."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from pathlib import Path

from planner.base.arguments import choice, shown
from planner.base.errors import ModelError, PlannerError
from planner.base.files import printable, read_text
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Mechanism
from planner.model.mjcf.opened import Opened, opened
from planner.model.mjcf.read import read
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


def read_model(
    model: str | Path, *, base: str | None = None, floor: bool = False, package_path: str | Sequence[str] = (),
    inertia: str = "given", ignore: Collection[str] | None = (), contacts: str | ContactLaw = "auto",
    assets: dict[str, bytes] | None = None,
) -> Mechanism:  # fmt: skip
    """A mechanism of a URDF or MJCF file or text; from `base` to `inertia`, all is for URDFs alone.

    Raises:
        PlannerError: One of them is given for MJCF, or is wrong.
        ModelError: As of Mechanism.from_urdf and from_mjcf.
    """
    if assets is None and is_urdf(model):
        return read_urdf(
            model, base=base, floor=floor, package_path=package_path, inertia=inertia, ignore=ignore, contacts=contacts
        )
    if assets is None:
        given = {"base": base, "floor": floor, "package_path": package_path, "inertia": inertia != "given"}
        for key, value in given.items():
            if value:
                raise PlannerError(
                    f"{key} is given for an MJCF model, expected it for a URDF alone: MJCF says it itself."
                )
    return read(model, ignore=ignore, contacts=contacts, assets=assets)


def read_urdf(
    model: str | Path, *, base: str | None = None, floor: bool = False, package_path: str | Sequence[str] = (),
    inertia: str = "given", ignore: Collection[str] | None = (), contacts: str | ContactLaw = "auto",
) -> Mechanism:  # fmt: skip
    """A mechanism of a URDF file or text; see Mechanism.from_urdf."""
    mjcf, assets, name = _written(model, base, floor, package_path, inertia)
    return read(mjcf, ignore=ignore, contacts=contacts, assets=assets, name=name)


def opened_model(model: str | Path) -> Opened:
    """A URDF or MJCF file, compiled.

    Raises:
        ModelError: It cannot be read, or MuJoCo refuses it.
    """
    if not is_urdf(model):
        return opened(model)
    return opened(*_written(model, None, False, (), "given"))


def _written(
    model: str | Path, base: str | None, floor: bool, package_path: str | Sequence[str], inertia: str
) -> tuple[str, dict[str, bytes], str]:
    """The MJCF that is made of a URDF, its files, and its name for messages."""
    if base is not None:
        choice("base", base, BASES)
    nearest = choice("inertia", inertia, INERTIAS) == "nearest"
    if not isinstance(floor, bool):
        raise PlannerError(f"floor is {shown(floor)}, expected true or false.")
    paths = (package_path,) if isinstance(package_path, (str, os.PathLike)) else tuple(package_path)
    for path in paths:
        if not isinstance(path, (str, os.PathLike)) or not os.path.isdir(path):
            raise PlannerError(f"package_path is {shown(path)}, expected a folder of packages, or a list of some.")
    text, name, path = str(model), "the model", None
    if not is_text(model):
        path, name = Path(model), f"the model {printable(model)}"
        text = read_text(path, "the model", raises=ModelError)
    robot = robot_of(text, name)
    packages = packages_of(path, paths, robot.meshdir)
    return *mjcf_of(robot, packages, name, base=base, floor=floor, nearest=nearest), name
