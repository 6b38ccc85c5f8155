"""One page per plan: verdict, video, pictures, every measured number beside its bound, and how to make the plan again.

The page is one file: pictures and video are embedded, so that it can be sent and read without a network.
"""

from __future__ import annotations

import base64
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from markupsafe import Markup

from planner import cases
from planner.base.arguments import toml_value
from planner.base.errors import PlannerError
from planner.base.files import PathLike, file_error
from planner.cases import CASES, problem_file
from planner.cases.problem_file.keys import RESOLVED
from planner.cases.problem_file.tasks import resolved_defaults
from planner.problem.default_appearance import appearance_of
from planner.problem.plan import Plan
from planner.solvers.options import SolverOptions
from planner.view.plots.case_pictures import case_pictures
from planner.view.render.video import one_replay_shows_both
from planner.view.report.assessment import assessment
from planner.view.report.curves import interactive
from planner.view.report.markup import number, split_after_word, write_page
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
    heading = appearance_of(plan.problem).title or plan.name or "Plan"
    verdict, curves = _verdict(proof), Markup(interactive(plan, proof))
    film, of_case = _film(plan, proof, folder, video_note), "" if plan.case == problem_file.NAME else plan.case
    return write_page(
        folder / NAME, "report.html", title=f"{'FAIL' if proof is None else proof.verdict}: {heading}", heading=heading,
        verdict=verdict, notes=_notes(plan, proof, fixes), film=film, view=_view(plan, proof), curves=curves,
        pictures=_pictures(plan, proof, folder, with_curves=not curves, still=film.still),
        assessment=() if proof is None else assessment(plan, proof), refinement=_refinement(path), solver=_solver(plan),
        case=of_case, parameters=_parameters(plan), chosen=resolved_defaults(plan.parameters),
        command=command(plan, path, options), problem_file=problem_text(plan, path),
        seeds=_seeds(plan, proof, options or {}), versions=plan.versions,
        model="" if plan.twin is None else plan.twin.mjcf.strip(),
    )  # fmt: skip


class _Verdict(NamedTuple):
    """The verdict in its colour with words beside it."""

    word: str
    kind: str  # "pass", "warn" or "fail"
    words: str = ""


class _Film(NamedTuple):
    """A film, a file beside the page or a data URL, and its caption; or a picture in its place, and why."""

    source: str
    words: str
    still: str = ""


class _Note(NamedTuple):
    """A paragraph of the first screen, of which a part is folded. Words in `` are code."""

    label: str
    text: str
    folded: str


def _verdict(proof: Proof | None) -> _Verdict:
    if proof is None:
        return _Verdict("FAIL", "fail")
    grade = str(getattr(proof, "robustness", ""))
    word = f"{proof.verdict}, {grade}" if grade and ":" not in grade else proof.verdict
    mode = f"({proof.mode}); " if proof.passed and proof.mode else ""
    return _Verdict(word, "warn" if proof.misleads else "pass" if proof.passed else "fail", mode + proof.results)


def _notes(plan: Plan, proof: Proof | None, fixes: Sequence[SuggestedFix]) -> list[_Note]:
    """What led to the verdict, what to write so that the plan passes, what the verdict does not cover."""
    if proof is not None:
        reason = proof.reason
    elif math.isfinite(plan.cost):
        reason = "The plan was not replayed in MuJoCo, so nothing is proven."
    else:
        reason = "There is no finite plan that could be replayed."
    notes = [("", reason)]
    labels = iter(["To pass"])
    for fix in fixes:  # without a change it says why none helps
        notes.append((next(labels, "Or") if getattr(fix, "written", "") else "", str(fix)))
    if not plan.converged and not fixes:  # a finding says more than the solver's own words, which may contradict it
        notes.append(("The solver did not converge", plan.message))
    if proof is not None:
        if proof.remarks:
            notes.append(("What the verdict does not cover", f"{'; '.join(proof.remarks)}."))
        if proof.own_step:
            notes.append(("In your own simulation", proof.own_step))
        notes.append(("Not checked", f"{'; '.join(_unchecked(proof))}."))
    return [_Note(label, *split_after_word(text, FOLDED)) for label, text in notes]


def _unchecked(proof: Proof) -> Iterator[str]:
    """What no step of the proof has measured, a phrase each: the sections that were not run, and why not."""
    yield "whether the model is the machine (see Validation under Proof)"
    titles: dict[str, list[str]] = {}
    for section in proof.sections.values():
        if section.not_applicable:
            titles.setdefault(section.not_applicable.rstrip("."), []).append(section.title)
    for reason, those in titles.items():
        yield f"{', '.join(those)} ({reason})"


def _film(plan: Plan, proof: Proof | None, folder: Path, note: str) -> _Film:
    """The film; without one poses or curves, and why."""
    file = folder / "video.mp4"
    beside = file.is_file() and file.stat().st_size > _EMBEDDED
    video = "video.mp4" if beside else embedded(file, "video/mp4")
    if not video:
        why = note or "No video was made."
        stills = ((embedded(folder / name, "image/png"), caption) for name, caption in _PICTURES[:2])
        return next((_Film("", f"{caption}. {why}", still) for still, caption in stills if still), _Film("", why))
    appearance = appearance_of(plan.problem)
    ghost = "plan" if appearance.ghost is None else appearance.ghost.label
    sides = (
        "open loop; with the plan's gains it looks the same" if proof is not None and one_replay_shows_both(proof)
        else "at the left open loop, at the right with the plan's gains"
    )  # fmt: skip
    goals = "; goals as balls, axes and arrows" if appearance.goals else ""
    where = "; the film is the file video.mp4 beside this page" if beside else ""
    return _Film(video, f"MuJoCo solid, the {ghost} as a ghost; {sides}{goals}{where}")


def _view(plan: Plan, proof: Proof | None) -> str:
    """The 3-D view of the judged replay; "" where there is nothing to draw, which the film's note says."""
    if proof is None:
        return ""
    ghost = appearance_of(plan.problem).ghost
    try:
        return view_3d(proof.replay, "plan" if ghost is None else ghost.label)
    except PlannerError:
        return ""


def _pictures(
    plan: Plan, proof: Proof | None, folder: Path, *, with_curves: bool, still: str
) -> list[tuple[str, str]]:  # fmt: skip
    """Sources and captions of the folder's pictures without `still`; plots.png only if its curves are not drawn."""
    own = {} if proof is None else case_pictures(plan, proof.replay)
    first, *others = _PICTURES
    named = (first, *((name, picture.caption) for name, picture in own.items()), *others)
    found = [
        (embedded(folder / name, "image/png"), caption) for name, caption in named if with_curves or name != CURVES
    ]
    return [(source, caption) for source, caption in found if source not in ("", still)]


def _refinement(path: Sequence[Refinement]) -> str:
    """The steps from the first plan to this one."""
    return "\n".join([path[0].header(), *map(str, path)]) if len(path) > 1 else ""


def _solver(plan: Plan) -> dict[str, Any]:
    return {
        "Status": f"{plan.status.name}: {plan.message}",
        "Iterations": plan.nit,
        "Cost": number(plan.cost, digits=8),
        "Gradient norm": plan.gradient_norm,
        "Stages": f"{plan.N} of {number(plan.dt)} s, {number(plan.dt * plan.N)} s in all",
    }


def _parameters(plan: Plan) -> dict[str, Any]:
    given = typed(plan.parameters) if plan.case in CASES else plan.parameters
    return {name: value for name, value in given.items() if name != RESOLVED}


def _seeds(plan: Plan, proof: Proof | None, options: Mapping[str, Any]) -> dict[str, Any]:
    """What makes the plan and its rollouts again, beside the command."""
    seeds: dict[str, Any] = {}
    if len(plan.starts) > 1:
        seeds["Starts"] = f"{len(plan.starts)}; this plan is start {plan.start}"
        seeds["Seed of the starts"] = options.get("seed") or plan.parameters.get("seed", 0)
    rollouts = getattr(proof, "monte_carlo", None)
    if rollouts is not None:
        seeds["Rollouts"] = f"{rollouts.done} in each mode; varied: {rollouts.perturbation}"
        seeds["Seed of the rollouts"] = rollouts.seed
    return seeds


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
    title = appearance_of(run.controller.problem).title or run.controller.plan.name or "Loop"
    heading = f"{title}, in the loop"
    words = verdict.headline.removeprefix(verdict.verdict).strip(" ;,")
    settings = {
        name.replace("_", " "): value for name, value in run.errors.items() if value not in (None, 0.0, False, [])
    }
    settings["latency"] = "measured" if run.errors["latency"] is None else run.errors["latency"]
    return write_page(
        folder / NAME, "loop.html", title=f"{verdict.verdict}: {heading}", heading=heading,
        verdict=_Verdict(verdict.verdict, "pass" if verdict.passed else "fail", words),
        film=_Film(embedded(folder / "video.mp4", "video/mp4"), video_note),
        picture=embedded(folder / "loop.png", "image/png"), sections=list(verdict.sections.values()),
        settings=settings, events="\n".join(map(str, run.events)),
    )  # fmt: skip


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
