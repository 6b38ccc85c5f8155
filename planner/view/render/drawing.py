"""Draw films: the frames of one or of two side by side, from one camera or several, a strip of poses, a still.

Pictures of one film from several cameras form a row; of two films, each has a column of them.

Several child processes draw a long film; one draws where this process cannot, because mujoco was imported without an
OpenGL library. Where both films show the same, to half a pixel, it is drawn once.

Each child (python -m planner.view.render.drawing JOBFILE FIRST STRIDE) draws every STRIDE-th frame and writes to its
stdout, for each, a line of JSON and then the picture's bytes. This process reads the frames in their order.
"""

from __future__ import annotations

import copy
import json
import math
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Generator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from planner.base import errors, gl
from planner.base.environment import available_processors
from planner.base.errors import PlannerError, RenderingUnavailable
from planner.view.render import overlay
from planner.view.render.environment import visible_model
from planner.view.render.film import Film
from planner.view.render.scene import Scene, best_rows

_VIDEO_OVERSIZE = 1.25  # pixels drawn over pixels written, each way: a third of the time of 2, which looks the same
_LEGIBLE = 0.8  # of the words under a pose in a strip of 540 rows: 14 pixels, which a page may show smaller
_MAX_CHILDREN = 8  # more would wait for the process that encodes
_NARROW_READOUTS = 4  # numbers in the table of a picture beside another
_NICE = 5  # lower priority of a child, so that rollouts with a time limit come first
_WORTH_A_CHILD = 24  # frames: a child needs a second or two before its first
_DRAWING = "planner.view.render.drawing"
_ROOT = Path(__file__).parents[3]


@dataclass(frozen=True)
class Job:
    """Frames of a video, a strip or a still to make of films. Sizes are pixels of the whole picture."""

    kind: str  # "video", "strip" or "frame"
    width: int
    height: int
    fps: float = 0.0  # of a video
    speed: float | None = None  # of a video; None for stills
    transparent: bool = False  # a strip or still with an alpha channel, without sky, floor and panels of words


def carry_out(films: Sequence[Film], job: Job) -> np.ndarray:
    """The picture of a strip or still, drawn here or in a child process.

    `films` is one, or for a still two of the same plan and times, shown side by side.
    """
    if not gl.can_render_here():
        with closing(drawn_by_children(films, job, 1)) as pictures:
            return next(pictures)
    if job.kind == "strip":
        return _draw_strip(films[0], job)
    with closing(draw_frames(films, job)) as pictures:
        return next(pictures)


def frames_of(films: Sequence[Film], job: Job) -> Generator[np.ndarray]:
    """All frames of a video of one film, or of two side by side: by several processes where there are many, or here."""
    children = min(available_processors(), _MAX_CHILDREN, len(films[0]) // _WORTH_A_CHILD)
    if children > 1 or not gl.can_render_here():
        return drawn_by_children(films, job, max(1, children))
    return draw_frames(films, job)


def draw_frames(films: Sequence[Film], job: Job, first: int = 0, stride: int = 1) -> Generator[np.ndarray]:
    """Frames first, first + stride, ... of films side by side, drawn in this process: (height, width, 3), uint8."""
    with ExitStack() as scenes:
        rows = _tiles(films, job, scenes)
        for frame in range(first, len(films[0]), stride):
            pictures = [_draw_row(row, frame, alike=len(films) > 1) for row in rows]
            yield _parted(np.concatenate(pictures), rows)


def _draw_row(row: Sequence[_Tile], frame: int, *, alike: bool) -> np.ndarray:
    """The pictures of one row; `alike` says that one camera sees films of one plan, so that one may do for all."""
    first, *others = row
    pictures = [first.draw(frame), *(tile.draw(frame, first.scene if alike else None) for tile in others)]
    return np.concatenate(pictures, axis=1)


def _tiles(films: Sequence[Film], job: Job, scenes: ExitStack) -> list[list[_Tile]]:
    """The parts of a picture, row by row; `scenes` closes their OpenGL contexts."""
    if len(films) > 1:  # side by side: a longer table would cover a machine that stands
        films = [_with_readouts(film, _NARROW_READOUTS) for film in films]
    views = [film.views for film in films]  # by film and camera
    if len(films) > 1:
        views = [list(row) for row in zip(*views, strict=True)]
    widths, heights = _shares(job.width, len(views[0])), _shares(job.height, len(views))
    largest, model = np.max([film.largest for film in films], axis=0), visible_model(films)
    tiles: list[list[_Tile]] = []
    for i, row in enumerate(views):
        tiles.append([])
        for j, film in enumerate(row):
            first = i == 0 if len(films) > 1 else j == 0  # of the cameras
            last_row, last_column = i == len(views) - 1, j == len(row) - 1
            beside = [other for other in row if other is not film] if len(films) > 1 else []
            captioned = last_row and (len(films) > 1 or first)
            words = overlay.Words(
                largest, numbers=first, legend=last_row and j == 0,
                speed=job.speed if last_row and last_column else None,
                caption=film.caption if captioned else None, unstable=film.unstable if captioned else math.inf,
                difference=captioned, label=film.appearance.views[0].label if film.appearance.views else "",
            )  # fmt: skip
            scene = Scene(
                film, widths[j], heights[i], oversize=_VIDEO_OVERSIZE if job.kind == "video" else 2.0, beside=beside,
                narrow=len(row) > 1 or len(views) > 1, quick=job.kind == "video", transparent=job.transparent,
                model=copy.copy(model),
            )  # fmt: skip
            written = None if job.transparent else overlay.Overlay(film.appearance, widths[j], heights[i], words)
            tiles[-1].append(_Tile(film, written, scenes.enter_context(scene)))
    return tiles


def _with_readouts(film: Film, count: int) -> Film:
    """The film with the first numbers of its table."""
    appearance = replace(film.appearance, readouts=film.appearance.readouts[:count])
    return replace(film, appearance=appearance, readings=film.readings[:, :count], largest=film.largest[:count])


def _parted(picture: np.ndarray, rows: Sequence[Sequence[_Tile]]) -> np.ndarray:
    """The picture with lines between what several cameras see; two films from one camera need none."""
    if not rows[0][0].film.appearance.views:
        return picture
    height, width, _ = picture.shape
    half = max(1, round(height / 720))
    for x in np.cumsum(_shares(width, len(rows[0])))[:-1]:
        picture[:, x - half : x + half] = 255
    for y in np.cumsum(_shares(height, len(rows)))[:-1]:
        picture[y - half : y + half] = 255
    return picture


def _shares(pixels: int, parts: int) -> list[int]:
    """The sizes of equal parts; the last takes the remainder of the division."""
    each = pixels // parts
    return [each] * (parts - 1) + [pixels - each * (parts - 1)]


class _Tile(NamedTuple):
    """A film from one camera, with its words."""

    film: Film
    words: overlay.Overlay | None
    scene: Scene

    def draw(self, frame: int, like: Scene | None = None) -> np.ndarray:
        """Frame number `frame`: (height, width, 3), uint8; see Scene.draw()."""
        drawn, film = self.scene.draw(frame, like), self.film
        if self.words is None:
            return drawn
        ends = [self.scene.project(np.asarray(end)) for end in film.appearance.goal_line or ()]
        visible = [end for end in ends if end is not None]
        marks = [overlay.beside(label) for label in self.scene.labels(frame)]
        if visible:  # at the right end of the line
            marks.append(overlay.Mark(max(visible), f" {film.appearance.goal_label}"))
        return self.words.write(drawn, film.t[frame], film.readings[frame], marks, self.scene.difference)


def _draw_strip(film: Film, job: Job) -> np.ndarray:
    if film.appearance.accompany is None:  # one camera for all poses, so that their heights compare
        middle = 0.5 * (film.shift.min(axis=0) + film.shift.max(axis=0))
        film = replace(film, shift=np.tile(middle, (len(film), 1)))
    heights = _shares(job.height, len(film.views))
    strips = [
        _draw_poses(view, job.width, high, job.transparent) for view, high in zip(film.views, heights, strict=True)
    ]
    return np.concatenate(strips)


def _draw_poses(film: Film, width: int, height: int, transparent: bool) -> np.ndarray:
    """All poses from one camera: (height, width, 3), or 4 for a transparent strip."""
    gap = max(1, round(height / 270))
    model = visible_model([film])
    rows = best_rows(film, model, width, height)
    columns = math.ceil(len(film) / rows)
    tile = (width - gap * (columns - 1)) // columns
    high = (height - gap * (rows - 1)) // rows
    unit = max(min(height / 540, tile / 160), _LEGIBLE)
    band = min(round(30 * unit), high // 3)
    strip = np.zeros((height, width, 4), np.uint8) if transparent else np.full((height, width, 3), 255, np.uint8)
    # Both sides share the remainder of the division.
    left = (width - tile * columns - gap * (columns - 1)) // 2
    with Scene(film, tile, high - band, ghost=False, words=False, transparent=transparent, model=model) as scene:
        for frame, t in enumerate(film.t):
            row, column = (frame // columns) * (high + gap), left + (frame % columns) * (tile + gap)
            words = film.words[frame] if film.words else overlay.time_words(t, unstable=t >= film.unstable)
            picture, marks = scene.draw(frame), [overlay.beside(label) for label in scene.labels(frame)]
            picture = overlay.write_below(picture, words, band, unit, marks, bad=t >= film.unstable)
            strip[row : row + high, column : column + tile] = picture
    return strip


def drawn_by_children(films: Sequence[Any], job: Any, children: int) -> Generator[np.ndarray]:
    """The pictures (height, width, 3), uint8, of a job in their order, drawn by so many processes.

    Raises:
        PlannerError: As the child raised it.
        RenderingUnavailable: A child died.
    """
    with tempfile.TemporaryDirectory(prefix="planner-") as folder:
        file = Path(folder) / "job"
        file.write_bytes(pickle.dumps((films, job)))
        started: list[subprocess.Popen[bytes]] = []
        logs = [Path(folder) / f"log{first}" for first in range(children)]
        try:
            for first, log in enumerate(logs):
                started.append(_child(file, first, children, log))
            turn = 0
            while (picture := _read(started[turn % children], logs[turn % children])) is not None:
                yield picture
                turn += 1
        finally:
            for child in started:
                child.kill()  # does nothing to a finished process
                child.wait()
                if child.stdout is not None:
                    child.stdout.close()


def answer(what: np.ndarray | PlannerError) -> None:
    """Write a picture or an error to the process that waits for it."""
    out = sys.stdout.buffer
    if isinstance(what, PlannerError):
        out.write(json.dumps({"error": type(what).__name__, "message": str(what)}).encode() + b"\n")
    else:
        out.write(json.dumps({"shape": what.shape}).encode() + b"\n")
        out.write(np.ascontiguousarray(what).data)
    out.flush()


def _child(file: Path, first: int, stride: int, log: Path) -> subprocess.Popen[bytes]:
    # The child must find this very package, whatever folder it is started in.
    places = [str(_ROOT), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, places))}
    if stride > 1:  # Mesa's own threads would compete with the other children for the processors
        environment.setdefault("LP_NUM_THREADS", "1")
    words = [sys.executable, "-P", "-m", _DRAWING, str(file), str(first), str(stride)]
    with log.open("wb") as complaints:
        return subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=complaints, env=environment
        )


def _read(child: subprocess.Popen[bytes], log: Path) -> np.ndarray | None:
    """The next picture of a child; None where it is done."""
    assert child.stdout is not None
    line = child.stdout.readline()
    report = json.loads(line) if line else {}
    if "error" in report:
        raise getattr(errors, report["error"])(report["message"])
    shape = tuple(report.get("shape", (0,)))
    data = child.stdout.read(int(np.prod(shape)))
    if line and len(data) == np.prod(shape):
        return np.frombuffer(data, np.uint8).reshape(shape)
    if child.wait() == 0 and not line:
        return None
    lines = log.read_text(errors="replace").strip().splitlines()
    reason = lines[-1] if lines else f"exit code {child.returncode}"
    raise RenderingUnavailable(f"The process that draws failed: {reason}.")


def main(words: Sequence[str]) -> int:
    """The child process: words are JOBFILE FIRST STRIDE; pictures go to stdout."""
    films, job = pickle.loads(Path(words[0]).read_bytes())
    if hasattr(os, "nice"):
        os.nice(_NICE)
    try:
        if job.kind == "strip":
            answer(_draw_strip(films[0], job))
        else:
            for picture in draw_frames(films, job, int(words[1]), int(words[2])):
                answer(picture)
    except PlannerError as error:
        answer(error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
