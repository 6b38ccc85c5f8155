"""Flags of the command line that several commands share, and how a flag is written down."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any

from planner.base.arguments import short_repr

PROBLEM_FILE = "PROBLEM.toml"
"""Stands for any problem file where a case may be named."""

Flags = dict[str, dict[str, Any]]  # options of add_argument() by flag


def _word_as(parse: Callable[[str], Any], expected: str) -> Callable[[str], Any]:
    """A type of add_argument() that names what it expected."""

    def convert(text: str) -> Any:
        try:
            return parse(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{short_repr(text)} is not {expected}") from None

    return convert


def _width_and_height(text: str) -> tuple[int, int]:
    width, height = map(int, text.split("x"))
    return width, height


def _direction(text: str) -> str | tuple[float, float]:
    """A camera's name, or its azimuth and elevation."""
    if "," not in text:
        return text
    azimuth, elevation = map(float, text.split(","))
    return azimuth, elevation


number, whole = _word_as(float, "a number"), _word_as(int, "a whole number")
size = _word_as(_width_and_height, "a size like 1280x720")
direction = _word_as(_direction, "a camera's name, or azimuth and elevation like 90,-15")


def value_flag(metavar: str, text: str, default: Any = None, kind: Callable[[str], Any] = str) -> dict[str, Any]:
    """Options of add_argument() for a flag with a value."""
    told = text if default is None else f"{text} Default: {default}."
    return {"metavar": metavar, "help": told, "default": default, "type": kind}


def choice_flag(choices: Sequence[str], text: str, default: str) -> dict[str, Any]:
    """Options of add_argument() for a flag with one of some words."""
    return {"choices": choices, "default": default, "help": f"{text} Default: {default}."}


def boolean_flag(text: str) -> dict[str, Any]:
    """Options of add_argument() for a flag without a value."""
    return {"action": "store_true", "help": text}


WORKERS: Flags = {
    "--workers": value_flag("N", "Number of processes. Default: for sweep and paper one per processor, else threads "
                                 "of one process.", kind=whole),
    "--scheduler": value_flag("ADDRESS", "Use the workers of a Dask scheduler, tcp://HOST:8786, or of a new cluster "
                                         "on this machine: local."),
}  # fmt: skip
PROOF: Flags = {
    "--rollouts": value_flag(
        "N", "Number of perturbed simulations, 0 for none; `run` stops them after 20 s.", 512, whole
    ),
    "--hold": value_flag(
        "S", "Also hold the goal for S seconds after the end, by an infinite-horizon LQR.", 0.0, number
    ),
}
ROLLOUT: Flags = {
    "--replay-rollout": value_flag("K", "Show perturbed simulation K in detail.", kind=whole),
    "--mode": choice_flag(("feedback", "open-loop"), "Simulate it with the plan's gains or open loop.", "feedback"),
    "--seed": value_flag("N", "Seed of the perturbations.", 0, whole),
    "--perturb": {"action": "append", "metavar": "NAME=X",
                  "help": "Size of a perturbation, e.g. mass=0.1 or delay=0 (docs/proof.md). May be repeated."},
}  # fmt: skip
BUDGET: Flags = {
    "--work": value_flag("N", "Work that the run may take, about N s of one core; counted, so that the plan is the "
                              "same on any computer. Default: that of the problem file, else about a minute.",
                         kind=number),
    "--budget": value_flag("SECONDS", "Last stop by the clock: solves end, and what is not drawn yet is left out. The "
                                      "plan then depends on the computer, and says so. Default: none.", kind=number),
}  # fmt: skip
LOOKS: Flags = {
    "--size": value_flag("WxH", "Size of the film in pixels. Default: 1280x720, for a strip 1920x540.", kind=size),
    "--camera": value_flag("CAMERA", "Look as this camera of the model does, or at azimuth,elevation in degrees, e.g. "
                                     "--camera=90,-15; from where all of the motion is seen.", kind=direction),
    "--transparent": boolean_flag("The strip of poses without sky and floor, on a transparent ground."),
}  # fmt: skip
NO_VIDEO = {"--no-video": boolean_flag("Make no video and no strip of poses (drawing needs OpenGL).")}
IMPORTS: Flags = {
    "--allow-import": {"action": "append", "metavar": "MODULE", "default": [],
                       "help": "Import this module, or file MODULE.py, for residuals of your own. May be repeated."},
}  # fmt: skip
COMMON: Flags = {
    "--json": boolean_flag("Print one JSON document on stdout."),
    "--quiet": boolean_flag("Print no progress."),
    "--confine": value_flag("DIR", "Read no input outside of this folder: for models and problem files of strangers."),
}


def add(parser: argparse.ArgumentParser, *groups: Flags) -> None:
    """Add groups of flags to a command."""
    for group in groups:
        for flag, options in group.items():
            parser.add_argument(flag, **options)
