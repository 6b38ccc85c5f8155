"""Find the files that a URDF names: package://, model:// and file:// addresses, and paths relative to the URDF."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

_ADDRESS = re.compile(r"^(package|model)://?([^/\\]+)[/\\](.*)$", re.S)


@dataclass(frozen=True)
class Packages:
    """Where files are sought: beside the URDF, in folders above it, and in folders that the user names."""

    folder: Path  # of the URDF
    paths: tuple[Path, ...] = ()  # of packages, or of folders that hold them
    meshdir: str = ""

    def find(self, file: str) -> Path | None:
        """The path of a file that there is; None where there is none."""
        return next((path for path in self._places(file) if _is_file(path)), None)

    def _places(self, file: str) -> Iterator[Path]:
        if address := _ADDRESS.match(file):
            package, rest = address[2], address[3]
            parents = [self.folder, *self.folder.parents]
            for place in (*self.paths, *parents):
                yield place / package / rest
                if place.name == package:
                    yield place / rest
            for place in (*self.paths, *parents):  # a package in a folder of another name
                yield place / rest
            return
        file = unquote(file.removeprefix("file://")) if file.startswith("file:/") else file
        for place in (self.folder, *self.paths):
            yield place / file
        if self.meshdir:  # of MuJoCo's extension, which takes the names without their folders
            yield self.folder / self.meshdir / re.split(r"[/\\]", file)[-1]


def _is_file(path: Path) -> bool:
    try:
        return os.path.isfile(path)
    except ValueError:  # a null character
        return False


def packages_of(path: Path | None, package_path: tuple[str | os.PathLike[str], ...], meshdir: str) -> Packages:
    """The places for the files of the URDF at `path`; of a text, the working directory."""
    folder = Path(os.path.abspath(path)).parent if path is not None else Path.cwd()
    return Packages(folder, tuple(Path(os.path.abspath(one)) for one in package_path), meshdir)
