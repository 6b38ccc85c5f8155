"""Read a model by its file's kind: a URDF as the MJCF that is made of it, MJCF as it is."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from planner.base.errors import ModelError, PlannerError
from planner.model.contact.laws import ContactLaw
from planner.model.mechanism import Mechanism
from planner.model.mjcf.model_file import ModelFile, open_model_file
from planner.model.mjcf.read import read
from planner.model.urdf.write import as_mjcf, is_urdf


def read_model(
    model: str | Path, *, base: str | None = None, floor: bool = False, package_path: str | Sequence[str] = (),
    inertia: Any = "given", ignore: Collection[str] | None = (), contacts: str | ContactLaw = "auto",
    assets: dict[str, bytes] | None = None, attach: Any = None, obstacles: Any = None, exclude: Any = None,
) -> Mechanism:  # fmt: skip
    """A mechanism of a URDF or MJCF file or text; from `base` to `inertia`, all is for URDFs alone.

    Raises:
        PlannerError: One of them is given for MJCF, or is wrong.
        ModelError: As of Mechanism.from_urdf and from_mjcf.
    """
    if assets is None and is_urdf(model):
        return Mechanism.from_urdf(
            model, base=base, floor=floor, package_path=package_path, inertia=inertia, ignore=ignore,
            contacts=contacts, attach=attach, obstacles=obstacles, exclude=exclude,
        )  # fmt: skip
    if assets is None:
        given = {"base": base, "floor": floor, "package_path": package_path, "inertia": inertia != "given"}
        for key, value in given.items():
            if value:
                raise PlannerError(
                    f"{key} is given for an MJCF model, expected it for a URDF alone: MJCF says it itself."
                )
    return read(
        model, ignore=ignore, contacts=contacts, assets=assets, attach=attach, obstacles=obstacles, exclude=exclude
    )


def opened_model(model: str | Path, package_path: str | None = None) -> tuple[ModelFile, dict[str, Any]]:
    """A URDF or MJCF file, compiled, to be looked at, and the keys of a problem file without which it is refused.

    `package_path` is a folder of packages of a URDF, which is one of these keys.

    Raises:
        ModelError: It cannot be read, or MuJoCo refuses it.
    """
    if not is_urdf(model):
        if package_path is not None:
            raise PlannerError("package_path is given for an MJCF model, expected it for a URDF alone.")
        return open_model_file(model, stored=False), {}
    keys: dict[str, Any] = {} if package_path is None else {"package_path": package_path}
    try:
        return open_model_file(*as_mjcf(model, **keys), stored=False), keys
    except ModelError as refusal:
        for inertia in ("nearest", "from shapes"):
            with suppress(ModelError):
                nearer: dict[str, Any] = keys | {"inertia": inertia}
                return open_model_file(*as_mjcf(model, **nearer), stored=False), nearer
        raise refusal
