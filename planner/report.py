"""One page per plan: the verdict first, then every figure beside its bound, pictures, video and parameters.

The page is one file: pictures and video are embedded, so it can be sent and still be whole.
"""

from __future__ import annotations

import base64
import json
import math
import re
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from planner.default_stage import stage_of
from planner.figures import Figure, Section
from planner.files import PathLike, file_error, write_atomically
from planner.plan import Plan

if TYPE_CHECKING:
    from planner.proof import Proof

NAME = "report.html"
NBSP = "\N{NO-BREAK SPACE}"

_STYLE = """
:root { color-scheme: light dark; --ink: #1d1f21; --soft: #5d6670; --line: #d9dde1; --paper: #ffffff;
  --card: #f6f7f8; --good: #14713a; --bad: #b3261e; --good-tint: #e5f4ea; --bad-tint: #fce9e7; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8eaed; --soft: #a3abb3; --line: #3a3f45;
  --paper: #17191c; --card: #202327; --good: #6fd394; --bad: #ff8d84; --good-tint: #16301f;
  --bad-tint: #3a1c1a; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.2rem; max-width: 62rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { font-size: 1.5rem; margin: 0 0 .8rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
h3 { font-size: 1rem; margin: 1.4rem 0 .4rem; }
p { margin: .4rem 0; overflow-wrap: anywhere; }
.soft { color: var(--soft); }
.verdict { border-left: .5rem solid; border-radius: .4rem; padding: .8rem 1.1rem; }
.verdict.pass { color: var(--good); background: var(--good-tint); }
.verdict.fail { color: var(--bad); background: var(--bad-tint); }
.verdict strong { font-size: 2.3rem; line-height: 1.2; letter-spacing: .02em; margin-right: .6rem; }
.verdict span { font-size: 1.15rem; white-space: nowrap; }
.verdict p { color: var(--ink); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th, td { text-align: left; padding: .32rem .7rem .32rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; }
th { font-weight: 600; color: var(--soft); }
th[scope="row"] { width: 11rem; }
td.number, td.verdict-word { width: 8.5rem; }
td.number { font-variant-numeric: tabular-nums; }
td small { display: block; color: var(--soft); line-height: 1.35; }
@media (max-width: 40rem) { th[scope="row"] { width: 7rem; } td.number, td.verdict-word { width: auto; } }
td.value { overflow-wrap: anywhere; }
.word { font-weight: 700; white-space: nowrap; }
.word.pass { color: var(--good); }
.word.fail { color: var(--bad); }
.word.none { color: var(--soft); font-weight: 400; }
figure { margin: 0 0 1.2rem; }
figcaption { color: var(--soft); font-size: .9rem; }
img, video { display: block; max-width: 100%; height: auto; border-radius: .4rem; background: #fff; }
details { margin-top: 1.2rem; }
summary { cursor: pointer; font-weight: 600; }
pre { overflow-x: auto; background: var(--card); padding: .8rem; border-radius: .4rem; font-size: .8rem; }
"""

_PICTURES = (
    ("strip.png", "Poses over the motion"),
    ("plots.png", "Plan and replay over time, and the convergence of the solver"),
)


def write_report(plan: Plan, proof: Proof | None, folder: PathLike, video_note: str = "") -> Path:
    """Write report.html into `folder` and return its path.

    Embedded are strip.png, plots.png and video.mp4, those of them that lie in `folder`.

    Args:
        plan: What was planned.
        proof: Its proof; None when there is none, e.g. for a plan that is not finite.
        folder: Where the pictures are and the page goes. It must exist.
        video_note: Why there is no video, in one sentence; used only when there is none.

    Raises:
        FileError: The page cannot be written, or a picture cannot be read.
    """
    place = Path(folder) / NAME
    page = html(plan, proof, Path(folder), video_note)
    with write_atomically(place) as hidden:
        hidden.write_text(page, encoding="utf-8", errors="xmlcharrefreplace")
    return place


def html(plan: Plan, proof: Proof | None, folder: Path, video_note: str = "") -> str:
    """The page that write_report() writes."""
    title = _title(plan)
    parts = [
        f"<h1>{escape(title)}</h1>",
        _verdict(plan, proof),
        _proof(proof),
        _pictures(folder),
        _film(folder, video_note),
        _solver(plan),
        _parameters(plan),
        _versions(plan),
        _model(plan),
    ]
    body = "\n".join(part for part in parts if part)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(_word(proof))}: {escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )


def _title(plan: Plan) -> str:
    stage = stage_of(plan.problem)
    return stage.title if stage is not None else (plan.case or "Plan")


def _word(proof: Proof | None) -> str:
    return "FAIL" if proof is None else proof.verdict


def _verdict(plan: Plan, proof: Proof | None) -> str:
    kind = "pass" if _word(proof) == "PASS" else "fail"
    if proof is None:
        mode = ""
        reason = "The plan was not replayed in MuJoCo, so nothing is proven."
        if not math.isfinite(plan.cost):
            reason = "There is no finite plan that could be replayed."
    else:
        reason = proof.reason
        mode = f"<span>{escape(proof.mode)}</span>" if proof.mode else ""
    doubt = "" if plan.success else f"<p>The solver did not converge: {escape(plan.message)}</p>"
    return (
        f'<div class="verdict {kind}" role="status"><strong>{escape(_word(proof))}</strong>{mode}'
        f"<p>{escape(reason)}</p>{doubt}</div>"
    )


def _film(folder: Path, note: str) -> str:
    video = _embedded(folder / "video.mp4", "video/mp4")
    if video:
        player = (
            f'<video controls loop muted playsinline preload="metadata" src="{video}">'
            "This browser does not play H.264 video.</video>"
        )
        return f"<h2>Video</h2>\n<figure>{player}</figure>"
    return f'<h2>Video</h2>\n<p class="soft">{escape(note or "No video was made.")}</p>'


def _pictures(folder: Path) -> str:
    shown = []
    for name, caption in _PICTURES:
        source = _embedded(folder / name, "image/png")
        if source:
            shown.append(
                f'<figure><img src="{source}" alt="{escape(caption)}">'
                f"<figcaption>{escape(caption)}</figcaption></figure>"
            )
    return "<h2>Pictures</h2>\n" + "\n".join(shown) if shown else ""


def _proof(proof: Proof | None) -> str:
    if proof is None:
        return ""
    return "<h2>Proof</h2>\n" + "\n".join(_section(section) for section in proof.sections.values())


def _section(section: Section) -> str:
    title = f"<h3>{escape(_capital(section.title))} {_mark(section)}</h3>"
    if section.not_applicable:
        return f'{title}\n<p class="soft">{escape(_capital(section.not_applicable))}</p>'
    if not section.figures:
        return f'{title}\n<p class="soft">Nothing was measured.</p>'
    rows = "\n".join(_row(figure) for figure in section.figures)
    head = "<tr><th>Figure</th><th>Value</th><th>Bound</th><th>Verdict</th></tr>"
    return f'{title}\n<div class="scroll"><table>\n{head}\n{rows}\n</table></div>'


def _mark(section: Section) -> str:
    if section.not_applicable:
        return '<span class="word none">not applicable</span>'
    if all(figure.bound is None for figure in section.figures):
        return ""
    return _pass_or_fail(section.passed)


def _row(figure: Figure) -> str:
    word = '<span class="word none">shown</span>' if figure.bound is None else _pass_or_fail(figure.passed)
    bound = "" if figure.bound is None else f"≤{NBSP}{_quantity(figure.bound, figure.unit)}"
    note = f"<small>{escape(figure.note)}</small>" if figure.note else ""
    return (
        f"<tr><td>{escape(_name(figure))}{note}</td>"
        f'<td class="number">{_quantity(figure.value, figure.unit)}</td>'
        f'<td class="number">{bound}</td><td class="verdict-word">{word}</td></tr>'
    )


def _pass_or_fail(passed: bool) -> str:
    return f'<span class="word {"pass" if passed else "fail"}">{"pass" if passed else "FAIL"}</span>'


def _solver(plan: Plan) -> str:
    rows = {
        "Status": f"{plan.status.name}: {plan.message}",
        "Iterations": plan.nit,
        "Cost": _number(plan.cost, digits=8),
        "Gradient norm": plan.gradient_norm,
        "Stages": f"{plan.N} of {_number(plan.dt)} s, {_number(plan.dt * plan.N)} s in all",
    }
    return "<h2>Solver</h2>\n" + _table(rows)


def _parameters(plan: Plan) -> str:
    if not plan.parameters:
        return ""
    case = f" of the case {plan.case}" if plan.case else ""
    return f"<h2>Parameters{escape(case)}</h2>\n" + _table(plan.parameters)


def _versions(plan: Plan) -> str:
    return "<h2>Made with</h2>\n" + _table(plan.versions)


def _model(plan: Plan) -> str:
    if plan.twin is None:
        return ""
    text = escape(plan.twin.mjcf.strip())
    return f"<details><summary>The model it was replayed in (MJCF)</summary>\n<pre>{text}</pre></details>"


def _table(rows: dict[str, Any]) -> str:
    lines = "\n".join(
        f'<tr><th scope="row">{escape(str(name))}</th><td class="value">{escape(_text(value))}</td></tr>'
        for name, value in rows.items()
    )
    return f'<div class="scroll"><table>\n{lines}\n</table></div>'


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return _number(value)
    return json.dumps(value, default=str, ensure_ascii=False)


def _number(value: float, digits: int = 4) -> str:
    if math.isnan(value):
        return "undefined"
    if math.isinf(value):
        return "∞" if value > 0 else "\N{MINUS SIGN}∞"
    return f"{value:.{digits}g}"


def _quantity(value: float, unit: str) -> str:
    return escape(f"{_number(value)}{NBSP}{unit}".rstrip())


def _name(figure: Figure) -> str:
    """The figure's key in words."""
    return _capital(re.sub(r"\brms\b", "RMS", figure.name.replace("_", " ")))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _embedded(file: Path, kind: str) -> str:
    """The file as a data URL; "" when there is none."""
    try:
        data = file.read_bytes()
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise file_error(error, file, verb="read") from error
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}" if data else ""
