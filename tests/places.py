"""Where the checkout is, and the MJCF files of two packages that others made: dm-control and gymnasium."""

from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).parents[1]


def folder(package, inside):
    spec = find_spec(package)
    return Path(spec.submodule_search_locations[0]) / inside if spec and spec.submodule_search_locations else None


PLACES = {"dm": folder("dm_control", "suite"), "gym": folder("gymnasium", "envs/mujoco/assets")}


def path(name):
    place, stem = name.split()
    return PLACES[place] / f"{stem}.xml"
