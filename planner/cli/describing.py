"""The command `model`: what a machine is, what is planned with, what looks wrong, and a problem file to start from."""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from planner.base.arguments import first_of
from planner.base.errors import PlannerError, RenderingUnavailable
from planner.cli.console import Console, shown
from planner.model.robot_collections import model_location
from planner.model.urdf.read import opened_model
from planner.model.urdf.write import is_urdf

if TYPE_CHECKING:
    from planner.problem.description import Description

PICTURE = "poses.png"
COLUMNS = 120
_POSES = 8  # in a row of the picture
_MAX_PHRASES = 12  # phrases of a list
URDF_BASE = 'fixed to the world, which has no floor; a machine that walks wants base = "free" and floor = true'


def describe_model(arguments: argparse.Namespace, console: Console) -> int:
    """Describe a model, draw its keyframes and write a problem file."""
    if arguments.out == "":
        raise PlannerError("--out is empty, expected the name of a folder.")
    arguments.model = str(model_location(arguments.model))
    with ThreadPoolExecutor(1) as beside:  # MuJoCo compiles in a child while this process imports
        opening = beside.submit(opened_model, arguments.model, arguments.package_path)
        from planner.problem.description import describe

        file, keys = opening.result()
    known = describe(file, keys)
    written = None
    if arguments.write is not None:  # or one sentence, before anything is printed
        from planner.cases.problem_file.starter_file import write_first_problem

        written = write_first_problem(arguments.write, arguments.model, file, known)
    _show(arguments.model, known, console)
    if written is not None:
        console.write_result(f"\n{written}: a problem to start from; planner run {written}")
    picture, note = (None, "") if arguments.no_picture else _picture(arguments, known)
    if picture is not None:
        console.write_result(f"\n{picture}: {'its keyframes' if known.keyframes else 'its home pose'}")
    elif note:
        console.write_result(f"\nno picture: {note}")
    return console.finish(
        "model", 0, file=str(arguments.model), **known.to_dict(), picture=None if picture is None else str(picture),
        picture_note=note, written=None if written is None else str(written),
    )  # fmt: skip


def _picture(arguments: argparse.Namespace, known: Description) -> tuple[Path | None, str]:
    """The file of the strip of keyframes, or why there is none."""
    from planner.view.render.video import render_poses

    mechanism = known.loaded.mechanism
    if mechanism is None:
        return None, "the model is refused"
    folder = Path(arguments.out or f"renders/{Path(arguments.write or arguments.model).stem}")
    poses = dict(list(known.poses.items())[:_POSES])
    columns = min(4, len(poses))
    rows = -(-len(poses) // columns)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return render_poses(mechanism, poses, folder / PICTURE, width=480 * columns, height=420 * rows), ""
    except RenderingUnavailable as error:
        return None, str(error)
    except OSError as error:
        return None, f"cannot write {folder}: {error.strerror}"


def _show(path: str, known: Description, console: Console) -> None:
    dofs, actuators = known.degrees_of_freedom, len(known.actuators)
    size = f"{dofs} degree{'s' * (dofs != 1)} of freedom, {actuators} actuator{'s' * (actuators != 1)}"
    name = f"{path}{f' ({known.name})' if known.name else ''}"
    console.write_result(f"{name}: {size}, {known.mass:.4g} kg that move")
    rows = [
        (one["name"] or one["label"], one["kind"], _range(one["range"], one["unit"]),
         *(shown(one[key]) for key in ("damping", "armature", "friction_loss")), _spring(one),
         shown(one["velocity_limit"]))
        for one in known.joints
    ]  # fmt: skip
    heads = ("joint", "kind", "range", "damping", "armature", "friction loss", "spring", "velocity limit")
    _table(console, heads, rows)
    actuators = [
        (one["name"], one["kind"], one["acts_on"], _range(one["control_range"], ""), _range(one["force_range"], ""))
        for one in known.actuators
    ]
    _table(console, ("actuator", "kind", "acts on", "control range", "force range"), actuators)
    bodies = [
        (
            one["name"],
            f"{one['mass']:.4g}",
            " ".join(f"{x:.3g}" for x in one["inertia"]),
            "" if one["moves"] else "rests",
        )
        for one in known.bodies
    ]
    _table(console, ("body", "mass, kg", "principal inertias, kg m^2", ""), bodies)
    pairs = known.contacts["pairs"]
    facts = [("gravity", " ".join(f"{g:g}" for g in known.gravity) + " m/s^2")]
    touching = f"{pairs} pair{'s' * (pairs != 1)} of shapes may touch" if pairs else "no shapes may touch"
    facts += [("contacts", ": ".join(filter(None, (touching, known.contacts["choice"]))))]
    facts += [("keyframes", ", ".join(known.keyframes))] if known.keyframes else []
    placed = [f"{name} at [{', '.join(f'{x:.3g}' for x in place)}]" for name, place in known.frames.items()]
    facts += [("frames", f"{first_of(placed, _MAX_PHRASES)} m in {next(iter(known.poses))}")] if placed else []
    facts += [("base", URDF_BASE)] if is_urdf(path) and not known.moving_base else []
    facts += [("planned with", first_of(known.planned, _MAX_PHRASES))] if known.planned else []
    facts += [("left out", first_of(known.left_out, _MAX_PHRASES))] if known.left_out else []
    if known.loaded.keys:
        facts.append(("needs", ", ".join(f"{key} = {json.dumps(value)}" for key, value in known.loaded.keys.items())))
    facts += [("refused", known.loaded.refusal)] if known.loaded.refusal else []
    facts += [("problem", f"{one.problem}; write {one.fix}") for one in known.troubles]
    console.write_result()
    console.table(("fact", ""), facts, COLUMNS)


def _table(console: Console, heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """A table without the columns in which there is nothing; nothing at all without rows."""
    if not rows:
        return
    used = [k for k in range(len(heads)) if k == 0 or any(row[k] for row in rows)]
    console.write_result()
    console.table([heads[k] for k in used], [[row[k] for k in used] for row in rows])


def _range(ends: list[float] | None, unit: str) -> str:
    return "" if ends is None else f"{ends[0]:.4g} to {ends[1]:.4g}{f' {unit}' if unit else ''}"


def _spring(joint: dict[str, object]) -> str:
    stiffness, rest = joint["stiffness"], joint["spring_rest"]
    return "" if stiffness is None else f"{stiffness:.4g}" + ("" if rest is None else f" about {rest:.4g}")
