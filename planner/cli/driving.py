"""The command `drive`: a controller in the loop with MuJoCo, its verdict, its pictures and its film."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from planner.base.arguments import number, short_repr
from planner.base.data_files import write_json
from planner.base.errors import PlannerError, RenderingUnavailable
from planner.base.files import open_folder, remove_empty
from planner.cli.console import Console
from planner.cli.solving import asked_problem, name_of, show_plan, solved
from planner.control.controller import Controller
from planner.control.judging import CallTimes, LoopVerdict, judge
from planner.control.loop_margins import fitting_rate, margins, measured_calls
from planner.control.simulating import duration_of_run, simulate
from planner.control.window_parts import horizon_and_rate
from planner.problem.default_appearance import appearance_of
from planner.problem.goals import goals_of
from planner.problem.problem import Problem
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import Replay
from planner.proof.robustness.perturbation import Push, pushed_step
from planner.view.plots.case_pictures import draw_loop
from planner.view.plots.style import save
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
    # refuses a body that there is not, or a time after the run, before any work; a solve may change a free duration
    free = arguments.seconds is None and problem.objective is not None and problem.objective.weights.get("time")
    pushed_step(compiled.model, named, until=math.inf if free else duration_of_run(problem, arguments.seconds))
    given: dict[str, Any] = {"iterations": arguments.iterations}
    if arguments.stages is not None:
        given["horizon"] = arguments.stages
    horizon_and_rate(problem, given.get("horizon"), arguments.rate)
    place = Path(arguments.out or f"renders/{name_of(arguments)}-loop")
    probe, created = open_folder(place, OUTPUTS)
    probe.rmdir()
    try:
        plan, seconds = solved(asked, arguments, console)
        show_plan(plan, seconds, console)
        problem = problem if plan.problem is None else plan.problem  # of more cycles, or other times of phases
        controller, calls = _timed(Controller(problem, plan=plan, **given), arguments.rate, latency)
        console.write_progress(f"driving {name_of(arguments)}: {controller}, {1e3 * controller.latency:.3g} ms late")

        def driven(controller: Controller) -> LoopVerdict:
            return judge(simulate(
                controller, duration=arguments.seconds, latency=controller.latency, pushes=pushes,
                mass=arguments.mass_error, friction=arguments.joint_friction, noise=arguments.noise,
                encoders=arguments.encoders, compiled=compiled,
            ))  # fmt: skip

        verdict = driven(controller)
        loop = verdict.loop
        advice = "" if verdict.passed else _advice(controller, calls, driven)
        if arguments.robustness_map is not None:
            found = margins(
                controller, arguments.robustness_map, latency=controller.latency, progress=console.progress("pushes")
            )
            verdict = verdict.with_margins(*found)
    except BaseException:
        remove_empty(created)
        raise
    for name in OUTPUTS:
        (place / name).unlink(missing_ok=True)
    facts = {"case": problem.case, "parameters": problem.parameters, **verdict.to_dict(), "measured": calls._asdict()}
    write_json(place / "drive.json", facts | {"advice": advice})
    plan.save(place / "plan.npz")
    save(draw_loop(verdict), place / "loop.png")
    film_status = _film(arguments, loop, place, console)
    write_loop_page(verdict, place, film_status)
    _show(verdict, console)
    if advice:
        console.write_result(advice)
    files = [name for name in OUTPUTS if (place / name).is_file()]
    console.write_result(f"\n{place}: {', '.join(files)}")
    if film_status and not arguments.no_video:
        console.write_result(f"no video: {film_status}")
    code = 0 if verdict.passed else 1
    return console.finish("drive", code, **verdict.to_dict(), folder=str(place), files=files, video_note=film_status,
                          advice=advice)  # fmt: skip


def _timed(controller: Controller, rate: float | None, latency: float | None) -> tuple[Controller, CallTimes]:
    """The controller with a rate and a latency that its measured calls keep, and their times.

    Raises:
        PlannerError: A stated rate or latency that they do not keep.
    """
    calls = measured_calls(controller)
    took = f"a call takes {1e3 * calls.median:.3g} ms of processor time (median of {calls.calls} on this computer)"
    if latency is not None and latency < calls.median:
        raise PlannerError(
            f"--latency is {1e3 * latency:.3g} ms and {took}, expected at least that: write --latency "
            f"{1e3 * calls.latency:.3g}ms, or leave it out."
        )
    latency = latency_of(controller.problem, calls.latency) if latency is None else latency
    fits = fitting_rate(controller, calls.latency)
    if rate is not None and rate * calls.median > 1.0:
        raise PlannerError(
            f"--rate is {rate:.6g} Hz, a period of {1e3 / rate:.3g} ms, and {took}, expected at most {fits:.4g} Hz: "
            f"write --rate {fits:.4g}, or leave it out."
        )
    return controller.with_timing(fits if rate is None else rate, latency), calls


def latency_of(problem: Problem, taken: float) -> float:
    """The latency, s, of calls that take so long: whole stages where goals have times.

    Goals at times lie at knots. A plan that begins between two knots has them beside it, by up to half a stage.
    """
    if all(one.times is None for one in goals_of(problem)):
        return taken
    return math.ceil(taken / problem.dynamics.dt - 1e-9) * problem.dynamics.dt


def _advice(controller: Controller, calls: CallTimes, driven: Callable[[Controller], LoopVerdict]) -> str:
    """What to write where a loop fails by its latency alone; "" where it fails without one, too."""
    if controller.latency == 0.0 or not driven(controller.with_timing(controller.rate, 0.0)).passed:
        return ""
    late = f"It fails by its latency of {1e3 * controller.latency:.3g} ms alone: without one it passes."
    if calls.latency < controller.latency and driven(controller.with_timing(controller.rate, calls.latency)).passed:
        return f"{late} With that of its calls it passes, too: write --latency {1e3 * calls.latency:.3g}ms."
    for stages in (controller.horizon // 2, controller.horizon // 4):
        if stages > 1:
            fewer = Controller(controller.problem, stages, plan=controller.plan, iterations=controller.iterations)
            if driven(_timed(fewer, None, None)[0]).passed:
                return f"{late} With fewer stages its calls are short enough: write --stages {stages}."
    return f"{late} It needs a faster computer, or a task with longer stages."


def _film(arguments: argparse.Namespace, loop: Replay, place: Path, console: Console) -> str:
    """Film a loop, twice as fast as the film of its plan, in real time at most: half of it is rest; why not, or ""."""
    if arguments.no_video:
        return "No video was asked for (--no-video)."
    from planner.view.render.video import render_video

    try:
        speed = min(1.0, 2.0 * appearance_of(loop.plan.problem).speed)
        render_video(loop, place / "video.mp4", speed=speed, progress=console.progress("video"))
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
