"""report.html of a loop: its verdict, its film, its picture, and every measured number beside its bound."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from planner.base.files import write_atomically
from planner.problem.default_appearance import appearance_of
from planner.view.report.page import NAME, embedded
from planner.view.report.style import STYLE
from planner.view.report.tables import measured_table, table

if TYPE_CHECKING:
    from planner.control.judging import LoopVerdict

_PLAYER = (
    '<video controls loop muted playsinline preload="metadata" src="{}">This browser plays no H.264 video.</video>'
)


def write_loop_page(verdict: LoopVerdict, folder: Path, video_note: str = "") -> Path:
    """Write report.html into a folder, with loop.png and video.mp4 in it as far as they lie there."""
    run = verdict.loop
    title = f"{appearance_of(run.controller.problem).title or 'Loop'}, in the loop"
    words = escape(verdict.headline.removeprefix(verdict.verdict).strip(" ;"))
    kind = "pass" if verdict.passed else "fail"
    video, picture = embedded(folder / "video.mp4", "video/mp4"), embedded(folder / "loop.png", "image/png")
    film = _PLAYER.format(video) if video else f'<p class="soft">{escape(video_note)}</p>'
    caption = "MuJoCo solid, what the controller expected as a ghost"
    asked = {name.replace("_", " "): value for name, value in run.errors.items() if value not in (None, 0.0, False, [])}
    asked["latency"] = "measured" if run.errors["latency"] is None else run.errors["latency"]
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<div class="verdict {kind}" role="status"><strong>{verdict.verdict}</strong><span>{words}</span></div>',
        f"<h2>Video</h2>\n<figure>{film}<figcaption>{caption}</figcaption></figure>",
        f'<h2>Pictures</h2>\n<figure><img src="{picture}" alt="The loop over time"></figure>' if picture else "",
        "<h2>Measured</h2>",
        *[measured_table(section) for section in verdict.sections.values()],
        "<h2>Asked</h2>\n" + table(asked),
        "<h2>What the controller said</h2>\n<pre>" + (escape("\n".join(run.events)) or "nothing") + "</pre>",
    ]  # fmt: skip
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{verdict.verdict}: {escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(part for part in parts if part)
        + "\n</body>\n</html>\n"
    )
    with write_atomically(folder / NAME) as hidden:
        hidden.write_text(page, encoding="utf-8", errors="xmlcharrefreplace")
    return folder / NAME
