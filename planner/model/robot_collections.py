"""Models of the package robot_descriptions by name: "robot_descriptions:panda_mj_description".

Importing a module of that package finds its files in a cache, or downloads them, and names the path.
"""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
import sys
from contextlib import redirect_stdout
from pathlib import Path

from planner.base.arguments import choice
from planner.base.errors import ModelError

PREFIX = "robot_descriptions:"


def model_location(model: str | Path, folder: Path | None = None) -> str | Path:
    """A model as it is given, a path relative to a folder where there is one, and the file of a named description.

    Raises:
        ModelError: The package is not installed, or cannot find or download the files.
        PlannerError: It has no description of that name.
    """
    if not str(model).startswith(PREFIX):
        return model if folder is None else folder / model
    package, name = PREFIX[:-1], str(model).removeprefix(PREFIX)
    spec = importlib.util.find_spec(package)
    if spec is None:
        raise ModelError(f"model is {str(model)!r}, expected the package {package}: pip install {package}.")
    known = [one.name for one in pkgutil.iter_modules(spec.submodule_search_locations)]
    choice("the robot description", name, [one for one in known if one.endswith("_description")])
    try:
        with redirect_stdout(sys.stderr):  # it says there what it downloads
            found = importlib.import_module(f"{package}.{name}")
    except Exception as error:  # whatever git raises
        raise ModelError(
            f"{package} has the files of {name!r} not in its cache and cannot download them ({type(error).__name__}): "
            f'run python -c "import {package}.{name}" once with a network.'
        ) from None
    path = getattr(found, "MJCF_PATH", None) or getattr(found, "URDF_PATH", None)
    if path is None:
        raise ModelError(f"{name!r} of {package} has neither an MJCF nor a URDF file, expected another description.")
    return Path(path)
