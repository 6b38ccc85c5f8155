"""The command `drive`: a controller in the loop with MuJoCo, its verdict, its pictures and its film."""

from __future__ import annotations

import argparse
from pathlib import Path

from planner.base.arguments import count, number, short_repr
from planner.base.errors import PlannerError, RenderingUnavailable
from planner.base.files import open_folder, remove_empty, write_json
from planner.cli.console import Console
from planner.cli.problems import asked_problem, name_of, solved
from planner.cli.results import show_plan
from planner.control.controller import Controller
from planner.control.judging import LoopVerdict, judge
from planner.control.robustness_map import margins
from planner.control.simulating import simulate
from planner.control.window_parts import horizon_and_rate
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.pushes import Push, pushed_step
from planner.view.plots import draw_loop, save
from planner.view.report.page import write_loop_page

OUTPUTS = ("drive.json", "plan.npz", "loop.png", "video.mp4", "report.html")
_UNITS = {"us": 1e-6, "ms": 1e-3, "s": 1.0}


def drive(arguments: argparse.Namespace, console: Console) -> int:
    """Plan a case or a problem file, drive it in MuJoCo, and judge the loop."""
    if arguments.out == "":
        raise PlannerError("--out is empty, expected the name of a folder.")
    pushes = [Push.parse(text) for text in arguments.push]
    latency = None if arguments.latency is None else seconds_of(arguments.latency)
    if arguments.seconds is not None:
        number("seconds", arguments.seconds, greater_than=0.0)
    asked = asked_problem(arguments)
    problem = asked.problem
    if problem.twin is None:
        raise PlannerError("the problem has no MuJoCo model to be driven in.")
    compiled = CompiledTwin(problem.twin)
    named = [*pushes, *([] if arguments.robustness_map is None else [Push(arguments.robustness_map, 1.0, 0.0)])]
    pushed_step(compiled.model, named)  # refuses a body that there is not, before any work
    given = {"rate": arguments.rate, "iterations": count("iterations", arguments.iterations), "latency": latency or 0.0}
    if arguments.stages is not None:
        given["horizon"] = count("stages", arguments.stages)
    horizon_and_rate(problem, given.get("horizon"), arguments.rate)
    place = Path(arguments.out or f"renders/{name_of(arguments)}-loop")
    probe, created = open_folder(place, OUTPUTS)
    probe.rmdir()
    try:
        plan, seconds = solved(asked, arguments, console)
        show_plan(plan, seconds, console)
        controller = Controller(problem, plan=plan, **given)
        console.write_progress(f"driving {name_of(arguments)}: {controller}")
        loop = simulate(
            controller, duration=arguments.seconds, latency=latency, pushes=pushes, mass=arguments.mass_error,
            friction=arguments.joint_friction, noise=arguments.noise, encoders=arguments.encoders, compiled=compiled,
        )  # fmt: skip
        verdict = judge(loop)
        if arguments.robustness_map is not None:
            found = margins(
                controller, arguments.robustness_map, latency=latency or 0.0, progress=console.progress("pushes")
            )
            verdict = verdict.with_margins(*found)
    except BaseException:
        remove_empty(created)
        raise
    for name in OUTPUTS:
        (place / name).unlink(missing_ok=True)
    write_json(place / "drive.json", {"case": problem.case, "parameters": problem.parameters, **verdict.to_dict()})
    plan.save(place / "plan.npz")
    save(draw_loop(verdict), place / "loop.png")
    film_status = _film(arguments, loop, place, console)
    write_loop_page(verdict, place, film_status)
    _show(verdict, console)
    files = [name for name in OUTPUTS if (place / name).is_file()]
    console.write_result(f"\n{place}: {', '.join(files)}")
    if film_status and not arguments.no_video:
        console.write_result(f"no video: {film_status}")
    code = 0 if verdict.passed else 1
    return console.finish("drive", code, **verdict.to_dict(), folder=str(place), files=files, video_note=film_status)


def _film(arguments: argparse.Namespace, loop: object, place: Path, console: Console) -> str:
    """Film a loop; why not, or ""."""
    if arguments.no_video:
        return "No video was asked for (--no-video)."
    from planner.view.render.video import render_video

    try:
        render_video(loop, place / "video.mp4", progress=console.progress("video"))  # type: ignore[arg-type]
    except RenderingUnavailable as error:
        return str(error)
    return ""


def _show(verdict: LoopVerdict, console: Console) -> None:
    console.write_result()
    console.table(("step", "measured", "value", "bound", ""), verdict.rows())
    for event in verdict.loop.events[:10]:
        console.write_result(str(event))
    console.write_result(f"\n{verdict.headline}")


def seconds_of(text: str) -> float:
    """Seconds from "4ms", "0.004s", "250us" or "0.004"."""
    word = text.strip().lower()
    unit = next((one for one in _UNITS if word.endswith(one)), "")
    try:
        return number("latency", float(word.removesuffix(unit)) * _UNITS.get(unit, 1.0), minimum=0.0)
    except ValueError:
        raise PlannerError(f"--latency is {short_repr(text)}, expected a time such as 4ms or 0.004s.") from None
