"""One page per plan: verdict, video, pictures, every measured number beside its bound, and how to make the plan again.

The page is one file: pictures and video are embedded, so that it can be sent and read without a network.
"""

from __future__ import annotations

import base64
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from planner import cases
from planner.base.arguments import toml_value
from planner.base.errors import PlannerError
from planner.base.files import PathLike, file_error
from planner.cases import CASES, problem_file
from planner.cases.problem_file.keys import RESOLVED
from planner.cases.problem_file.resolved_defaults import resolved_defaults
from planner.problem.default_appearance import appearance_of
from planner.problem.plan import Plan
from planner.solvers.options import SolverOptions
from planner.view.plots.case_pictures import case_pictures
from planner.view.render.video import one_replay_shows_both
from planner.view.report.assessment import assessment
from planner.view.report.curves import interactive
from planner.view.report.markup import (
    first_screen,
    measured_table,
    number,
    script,
    short_paragraph,
    table,
    verdict_box,
    video_player,
    write_page,
)
from planner.view.report.view_3d import view_3d

if TYPE_CHECKING:
    from planner.control.judging import LoopVerdict
    from planner.proof import Proof
    from planner.proof.diagnostics import SuggestedFix
    from planner.proof.repair.refinement import Refinement


NAME = "report.html"
FOLDED = 260  # letters of a note on the first screen: what is beyond is folded
_EMBEDDED = 16e6  # bytes of the largest film within the page

CURVES = "plots.png"
_PICTURES = (
    ("strip.png", "Poses over the motion"),
    (CURVES, "Plan and replays over time, and the convergence of the solver"),
    ("proof.png", "Errors beside their bounds, their growth, order, perturbed machines and other grounds"),
)


def write_report(
    plan: Plan, proof: Proof | None, folder: PathLike, video_note: str = "", *, path: Sequence[Refinement] = (),
    options: Mapping[str, Any] | None = None, fixes: Sequence[SuggestedFix] = (),
) -> Path:  # fmt: skip
    """Write report.html into `folder` and return its path.

    The first screen has the verdict, what was not checked, and the film; the rest is folded. The page embeds strip.png,
    proof.png and video.mp4 as far as they lie in `folder`, which must exist; a film of more than 16 MB stays beside it,
    and so does plots.png, whose curves the page draws. Hovering over its curves shows values, clicking moves the film;
    without scripts the curves are pictures.
    `video_note` says why there is no video, `path` lists the plan's refinements, `options` holds the flags that were
    given: {"starts": 8, "no_refine": True}. `fixes` say what to write so that a plan that failed passes.

    Raises:
        FileError: The page cannot be written, or a picture cannot be read.
    """
    folder = Path(folder)
    title = appearance_of(plan.problem).title or plan.case or "Plan"
    curves = interactive(plan, proof)
    made = [
        _refinement(path), _solver(plan), _parameters(plan), _chosen(plan), _again(plan, proof, path, options or {}),
        "<h2>Made with</h2>\n" + table(plan.versions), _model(plan),
    ]  # fmt: skip
    motion = "\n".join(filter(None, [_film(plan, proof, folder, video_note), _view(plan, proof)]))
    parts = [
        f"<h1>{escape(title)}</h1>",
        first_screen(_verdict(proof), motion, _notes(plan, proof, fixes)),
        _folded("Curves", curves),
        _folded("Pictures", _pictures(plan, proof, folder, with_curves=not curves)),
        _folded("Proof", "" if proof is None else assessment(plan, proof)),
        _folded("How it was made", *made),
    ]
    return write_page(folder / NAME, f"{_word(proof)}: {title}", [*parts, script("curves.js")])


def _folded(title: str, *parts: str) -> str:
    """What is below the first screen, folded under its title; "" where there is none of it."""
    inside = "\n".join(filter(None, parts))
    return f'<details class="part"><summary>{title}</summary>\n{inside}\n</details>' if inside else ""


def _word(proof: Proof | None) -> str:
    return "FAIL" if proof is None else proof.verdict


def _verdict(proof: Proof | None) -> str:
    if proof is None:
        return verdict_box("FAIL", False, "")
    grade = str(getattr(proof, "robustness", ""))
    word = f"{proof.verdict}, {grade}" if grade and ":" not in grade else proof.verdict
    mode = f"({proof.mode}); " if proof.passed and proof.mode else ""
    return verdict_box(word, proof.passed, mode + proof.results, warns=proof.misleads)


def _notes(plan: Plan, proof: Proof | None, fixes: Sequence[SuggestedFix]) -> str:
    """What led to the verdict, what to write so that the plan passes, what the verdict does not cover."""
    if proof is not None:
        reason = proof.reason
    elif math.isfinite(plan.cost):
        reason = "The plan was not replayed in MuJoCo, so nothing is proven."
    else:
        reason = "There is no finite plan that could be replayed."
    notes = [("", reason)]
    for k, fix in enumerate(fixes):
        label = (
            "Or" if k else "To pass" if getattr(fix, "written", "") else ""
        )  # without a change it says why none helps
        notes.append((label, str(fix)))
    if not plan.converged and not fixes:  # a finding says more than the solver's own words, which may contradict it
        notes.append(("The solver did not converge", plan.message))
    if proof is not None:
        if proof.remarks:
            notes.append(("Beside the verdict", f"{'; '.join(proof.remarks)}."))
        notes.append(("Not checked", f"{'; '.join(_unchecked(proof))}."))
    return "\n".join(short_paragraph(label, text, FOLDED) for label, text in notes)


def _unchecked(proof: Proof) -> Iterator[str]:
    """What no step of the proof has measured, a phrase each: the sections that were not run, and why not."""
    yield "whether the model is the machine (see Validation under Proof)"
    titles: dict[str, list[str]] = {}
    for section in proof.sections.values():
        if section.not_applicable:
            titles.setdefault(section.not_applicable.rstrip("."), []).append(section.title)
    for reason, those in titles.items():
        yield f"{', '.join(those)} ({reason})"


def _film(plan: Plan, proof: Proof | None, folder: Path, note: str) -> str:
    """The film, or the strip of poses where there is none."""
    file = folder / "video.mp4"
    beside = file.is_file() and file.stat().st_size > _EMBEDDED
    video = "video.mp4" if beside else embedded(file, "video/mp4")
    if video:
        appearance = appearance_of(plan.problem)
        ghost = "plan" if appearance.ghost is None else appearance.ghost.label
        goals = "; goals as balls, axes and arrows" if appearance.goals else ""
        alike = proof is not None and one_replay_shows_both(proof)
        sides = (
            "open loop; with the plan's gains it looks the same" if alike
            else "at the left open loop, at the right with the plan's gains"
        )  # fmt: skip
        caption = f"MuJoCo solid, the {ghost} as a ghost; {sides}{goals}"
        if beside:
            caption += "; the film is the file video.mp4 beside this page"
        return f"<figure>{video_player(video)}<figcaption>{escape(caption)}</figcaption></figure>"
    return f'<p class="soft">Video: {escape(note or "No video was made.")}</p>'


def _view(plan: Plan, proof: Proof | None) -> str:
    """The 3-D view of the judged replay; "" where there is nothing to draw, which the film's note says."""
    if proof is None:
        return ""
    ghost = appearance_of(plan.problem).ghost
    try:
        return view_3d(proof.replay, "plan" if ghost is None else ghost.label)
    except PlannerError:
        return ""


def _pictures(plan: Plan, proof: Proof | None, folder: Path, *, with_curves: bool) -> str:
    """The pictures of the folder; plots.png only where the page has not drawn its curves already."""
    own = {} if proof is None else case_pictures(plan, proof.replay)
    first, *others = _PICTURES
    figures = []
    for name, caption in (first, *((name, picture.caption) for name, picture in own.items()), *others):
        if name == CURVES and not with_curves:
            continue
        source = embedded(folder / name, "image/png")
        if source:
            figures.append(
                f'<figure><img src="{source}" alt="{escape(caption)}">'
                f"<figcaption>{escape(caption)}</figcaption></figure>"
            )
    return "\n".join(figures)


def _refinement(path: Sequence[Refinement]) -> str:
    """The steps from the first plan to this one."""
    if len(path) < 2:
        return ""
    lines = "\n".join([path[0].header(), *map(str, path)])
    why = "The proof of the first plan failed, so it was solved again at finer steps."
    return f"<h2>Refinement</h2>\n<p>{why}</p>\n<pre>{escape(lines)}</pre>"


def _solver(plan: Plan) -> str:
    rows = {
        "Status": f"{plan.status.name}: {plan.message}",
        "Iterations": plan.nit,
        "Cost": number(plan.cost, digits=8),
        "Gradient norm": plan.gradient_norm,
        "Stages": f"{plan.N} of {number(plan.dt)} s, {number(plan.dt * plan.N)} s in all",
    }
    return "<h2>Solver</h2>\n" + table(rows)


def _parameters(plan: Plan) -> str:
    if not plan.parameters:
        return ""
    case = f" of the case {plan.case}" if plan.case else ""
    given = typed(plan.parameters) if plan.case in CASES else plan.parameters
    return f"<h2>Parameters{escape(case)}</h2>\n" + table({k: v for k, v in given.items() if k != RESOLVED})


def _chosen(plan: Plan) -> str:
    """Defaults that were resolved for the problem file, with the reasons."""
    reasons = resolved_defaults(plan.parameters)
    return f"<h2>Chosen by itself</h2>\n{table(reasons)}" if reasons else ""


def _again(plan: Plan, proof: Proof | None, path: Sequence[Refinement], options: Mapping[str, Any]) -> str:
    """The command, the problem file and the seeds that make the plan again."""
    line = command(plan, path, options)
    body = f"<pre>{escape(line)}</pre>" if line else "<p>A program made the plan, not the command line.</p>"
    file = problem_text(plan, path)
    if file:
        body += f"\n<p>with the model below and this problem file:</p>\n<pre>{escape(file)}</pre>"
    seeds: dict[str, Any] = {}
    if len(plan.starts) > 1:
        seeds["Starts"] = f"{len(plan.starts)}; this plan is start {plan.start}"
        seeds["Seed of the starts"] = options.get("seed") or plan.parameters.get("seed", 0)
    rollouts = getattr(proof, "monte_carlo", None)
    if rollouts is not None:
        seeds["Rollouts"] = f"{rollouts.done} in each mode; varied: {rollouts.perturbation}"
        seeds["Seed of the rollouts"] = rollouts.seed
    return f"<h2>Again</h2>\n{body}" + (f"\n{table(seeds)}" if seeds else "")


def _model(plan: Plan) -> str:
    if plan.twin is None:
        return ""
    text = escape(plan.twin.mjcf.strip())
    return f"<details><summary>The model it was replayed in (MJCF)</summary>\n<pre>{text}</pre></details>"


def embedded(file: Path, kind: str) -> str:
    """The file as a data URL; "" when there is none."""
    try:
        data = file.read_bytes()
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise file_error(error, file, verb="read") from error
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}" if data else ""


def write_loop_page(verdict: LoopVerdict, folder: Path, video_note: str = "") -> Path:
    """Write report.html into a folder, with loop.png and video.mp4 in it as far as they lie there."""
    run = verdict.loop
    title = f"{appearance_of(run.controller.problem).title or 'Loop'}, in the loop"
    words = verdict.headline.removeprefix(verdict.verdict).strip(" ;,")
    video, picture = embedded(folder / "video.mp4", "video/mp4"), embedded(folder / "loop.png", "image/png")
    film = video_player(video) if video else f'<p class="soft">{escape(video_note)}</p>'
    caption = "MuJoCo solid, what the controller expected as a ghost"
    settings = {
        name.replace("_", " "): value for name, value in run.errors.items() if value not in (None, 0.0, False, [])
    }
    settings["latency"] = "measured" if run.errors["latency"] is None else run.errors["latency"]
    parts = [
        f"<h1>{escape(title)}</h1>",
        verdict_box(verdict.verdict, verdict.passed, words),
        f"<h2>Video</h2>\n<figure>{film}<figcaption>{caption}</figcaption></figure>",
        f'<h2>Pictures</h2>\n<figure><img src="{picture}" alt="The loop over time"></figure>' if picture else "",
        "<h2>Measured</h2>",
        *[measured_table(section) for section in verdict.sections.values()],
        "<h2>Settings</h2>\n" + table(settings),
        f"<h2>Events of the controller</h2>\n<pre>{escape(chr(10).join(map(str, run.events))) or 'none'}</pre>",
    ]  # fmt: skip
    return write_page(folder / NAME, f"{verdict.verdict}: {title}", parts)


PROBLEM = "problem.toml"


def command(plan: Plan, path: Sequence[Refinement] = (), options: Mapping[str, Any] | None = None) -> str:
    """The command line that makes a plan; "" for a problem that is no case and no file.

    With a `path` of refinements, it makes the first plan of them. `options` are flags by name: {"no_refine": True}.
    """
    parameters = _at_first(plan, path)
    words = ["planner", "run"]
    if plan.case == problem_file.NAME:
        words.append(PROBLEM)
    elif plan.case in cases.CASES:
        words += [plan.case, *_flags(_needed(plan.case, parameters))]
    else:
        return ""
    usual = SolverOptions()
    made_by = {name: plan.options.get(name) for name in ("update", "line_search", "hessian")}
    given = {name: value for name, value in made_by.items() if value not in (None, getattr(usual, name))}
    given |= dict(options or {})
    if len(plan.starts) > 1 and plan.case in cases.CASES:
        given.setdefault("starts", len(plan.starts))
    return shlex.join([*words, *_flags(given)])


def problem_text(plan: Plan, path: Sequence[Refinement] = ()) -> str:
    """The problem file of a plan as TOML; "" for a plan that was made from none."""
    if plan.case != problem_file.NAME:
        return ""
    table = {name: value for name, value in _at_first(plan, path).items() if value is not None}  # TOML has no null
    own = {name: value for name, value in table.items() if name not in ("weights", "limits", RESOLVED)}
    lines = [f"{name} = {toml_value(value)}" for name, value in own.items()]
    for name in ("weights", "limits"):
        if table.get(name):
            lines += ["", f"[{name}]", *(f"{key} = {toml_value(value)}" for key, value in table[name].items())]
    return "\n".join(lines)


def _at_first(plan: Plan, path: Sequence[Refinement]) -> dict[str, Any]:
    """The parameters of a plan, before it was refined."""
    found = typed(plan.parameters) if plan.case in cases.CASES else dict(plan.parameters)
    if len(path) < 2:
        return found
    first = {"integrator": path[0].integrator, "horizon": path[0].horizon, "dt": path[0].dt}
    return found | {name: value for name, value in first.items() if name in found}


def typed(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters that a flag can hold; the case finds arrays and tables again from the others."""
    return {name: value for name, value in parameters.items() if not isinstance(value, (dict, list, tuple))}


def _needed(case: str, parameters: dict[str, Any]) -> dict[str, Any]:
    """The parameters that the case does not find from the others."""
    try:
        usual = cases.build(case).parameters
        needed = {name: value for name, value in parameters.items() if usual.get(name) != value}
        for name in list(needed):
            others = {other: value for other, value in needed.items() if other != name}
            made = cases.build(case, **others).parameters
            if typed(made) == parameters:
                needed = others
    except PlannerError:  # another version made the plan
        return parameters
    return needed


def _flags(values: Mapping[str, Any]) -> list[str]:
    """Flags of the command line; those of None and False are left out."""
    flags = []
    for name, value in values.items():
        flag = f"--{name.replace('_', '-')}"
        if value is True:
            flags.append(flag)
        elif value is not None and value is not False:
            flags += [flag, f"{value:.17g}" if isinstance(value, float) and f"{value:g}" != str(value) else str(value)]
    return flags
