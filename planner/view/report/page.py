"""One page per plan: verdict, video, pictures, every measured number beside its bound, and how to make the plan again.

The page is one file: pictures and video are embedded, so that it can be sent and read without a network.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from planner.base.files import PathLike, file_error, write_atomically
from planner.cases import CASES
from planner.cases.problem_file.keys import RESOLVED
from planner.cases.problem_file.resolved_defaults import resolved_defaults
from planner.problem.default_appearance import appearance_of
from planner.problem.plan import Plan
from planner.view.plots import case_pictures
from planner.view.report.assessment import assessment
from planner.view.report.curves import interactive
from planner.view.report.reproduce import command, problem_text, typed
from planner.view.report.script import SCRIPT
from planner.view.report.style import STYLE
from planner.view.report.tables import number, table

if TYPE_CHECKING:
    from planner.proof import Proof
    from planner.proof.diagnostics import SuggestedFix
    from planner.proof.repair.refinement import Refinement

NAME = "report.html"
_EMBEDDED = 16e6  # bytes of the largest film within the page

_PICTURES = (
    ("strip.png", "Poses over the motion"),
    ("plots.png", "Plan and replays over time, and the convergence of the solver"),
    ("proof.png", "Errors beside their bounds, their growth, order, perturbed machines and other grounds"),
)


def write_report(
    plan: Plan,
    proof: Proof | None,
    folder: PathLike,
    video_note: str = "",
    *,
    path: Sequence[Refinement] = (),
    options: Mapping[str, Any] | None = None,
    fixes: Sequence[SuggestedFix] = (),
) -> Path:
    """Write report.html into `folder` and return its path.

    The page embeds strip.png, plots.png, proof.png and video.mp4 as far as they lie in `folder`, which must exist; a
    film of more than 16 MB stays beside it. Hovering over its curves shows values, clicking moves the film; without
    scripts the curves are pictures.
    `video_note` says why there is no video, `path` lists the plan's refinements, `options` holds the flags that were
    given: {"starts": 8, "no_refine": True}. `fixes` say what to write so that a plan that failed passes.

    Raises:
        FileError: The page cannot be written, or a picture cannot be read.
    """
    folder = Path(folder)
    title = appearance_of(plan.problem).title or plan.case or "Plan"
    parts = [
        f"<h1>{escape(title)}</h1>",
        _verdict(plan, proof, fixes),
        _film(plan, folder, video_note),  # people look before they read
        interactive(plan, proof),
        _pictures(plan, proof, folder),
        _refinement(path),
        "" if proof is None else assessment(plan, proof),
        _solver(plan),
        _parameters(plan),
        _chosen(plan),
        _again(plan, proof, path, options or {}),
        "<h2>Made with</h2>\n" + table(plan.versions),
        _model(plan),
    ]
    body = "\n".join(part for part in parts if part)
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(_word(proof))}: {escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n"
        f"<body>\n{body}\n<script>{SCRIPT}</script>\n</body>\n</html>\n"
    )
    with write_atomically(folder / NAME) as hidden:
        hidden.write_text(page, encoding="utf-8", errors="xmlcharrefreplace")
    return folder / NAME


def _word(proof: Proof | None) -> str:
    return "FAIL" if proof is None else proof.verdict


def _verdict(plan: Plan, proof: Proof | None, fixes: Sequence[SuggestedFix]) -> str:
    kind = "pass" if _word(proof) == "PASS" else "fail"
    if proof is None:
        words = ""
        reason = "The plan was not replayed in MuJoCo, so nothing is proven."
        if not math.isfinite(plan.cost):
            reason = "There is no finite plan that could be replayed."
    else:
        reason = proof.reason
        words = f"<span>{escape(proof.headline.removeprefix(proof.verdict).strip(' ;'))}</span>"
    doubt = "" if plan.success else f"<p>The solver did not converge: {escape(plan.message)}</p>"
    return (
        f'<div class="verdict {kind}" role="status"><strong>{escape(_word(proof))}</strong>{words}'
        f"<p>{escape(reason)}</p>{doubt}{_unchecked(proof)}{_to_pass(fixes)}</div>"
    )


def _to_pass(fixes: Sequence[SuggestedFix]) -> str:
    """What to write so that the plan passes."""
    return f"<p>To pass: {' Or: '.join(escape(str(one)) for one in fixes)}</p>" if fixes else ""


def _unchecked(proof: Proof | None) -> str:
    """What the plan's model left out, and what the verdict does not speak of."""
    left, phrases = ((), ()) if proof is None else (proof.planned_without, proof.not_checked)
    tested = f"The plan was made without {' and '.join(left)}; the replay in your file (step 6) had all of it."
    said = [tested] if left else []
    said += [f"Not checked: {'; '.join(phrases)}."] if phrases else []
    return "".join(f"<p>{escape(sentence)}</p>" for sentence in said)


def _film(plan: Plan, folder: Path, note: str) -> str:
    file = folder / "video.mp4"
    beside = file.is_file() and file.stat().st_size > _EMBEDDED
    video = "video.mp4" if beside else embedded(file, "video/mp4")
    if video:
        player = (
            f'<video controls loop muted playsinline preload="metadata" src="{video}">'
            "This browser does not play H.264 video.</video>"
        )
        seen = appearance_of(plan.problem)
        ghost = "plan" if seen.ghost is None else seen.ghost.label
        goals = "; goals as balls, axes and arrows" if seen.goals else ""
        sides = "at the left open loop, at the right with the plan's gains"
        caption = f"MuJoCo solid, the {ghost} as a ghost; {sides}{goals}"
        if beside:
            caption += "; the film is the file video.mp4 beside this page"
        return f"<h2>Video</h2>\n<figure>{player}<figcaption>{escape(caption)}</figcaption></figure>"
    return f'<h2>Video</h2>\n<p class="soft">{escape(note or "No video was made.")}</p>'


def _pictures(plan: Plan, proof: Proof | None, folder: Path) -> str:
    own = {} if proof is None else case_pictures(plan, proof.replay)
    first, *others = _PICTURES
    shown = []
    for name, caption in (first, *((name, picture.caption) for name, picture in own.items()), *others):
        source = embedded(folder / name, "image/png")
        if source:
            shown.append(
                f'<figure><img src="{source}" alt="{escape(caption)}">'
                f"<figcaption>{escape(caption)}</figcaption></figure>"
            )
    return "<h2>Pictures</h2>\n" + "\n".join(shown) if shown else ""


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
    told = typed(plan.parameters) if plan.case in CASES else plan.parameters
    told = {name: value for name, value in told.items() if name != RESOLVED}
    return f"<h2>Parameters{escape(case)}</h2>\n" + table(told)


def _chosen(plan: Plan) -> str:
    """What the problem file left to be chosen, with the reasons."""
    reasons = resolved_defaults(plan.parameters)
    return f"<h2>Chosen by itself</h2>\n{table(reasons)}" if reasons else ""


def _again(plan: Plan, proof: Proof | None, path: Sequence[Refinement], options: Mapping[str, Any]) -> str:
    """The command, the problem file and the seeds that make the plan again."""
    line = command(plan, path, options)
    shown = f"<pre>{escape(line)}</pre>" if line else "<p>A program made the plan, not the command line.</p>"
    file = problem_text(plan, path)
    if file:
        shown += f"\n<p>with the model below and this problem file:</p>\n<pre>{escape(file)}</pre>"
    seeds: dict[str, Any] = {}
    if len(plan.starts) > 1:
        seeds["Starts"] = f"{len(plan.starts)}; this plan is start {plan.start}"
        seeds["Seed of the starts"] = options.get("seed") or plan.parameters.get("seed", 0)
    rollouts = getattr(proof, "monte_carlo", None)
    if rollouts is not None:
        seeds["Rollouts"] = f"{rollouts.done} in each mode; varied: {rollouts.perturbation}"
        seeds["Seed of the rollouts"] = rollouts.seed
    return f"<h2>Again</h2>\n{shown}" + (f"\n{table(seeds)}" if seeds else "")


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
