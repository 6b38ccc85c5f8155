"""Draw films: a video of one or of two side by side, from one camera or several, a strip of poses, a still.

The pictures of one film from several cameras stand in a row; of two films, each has a column of them.

If this process cannot draw, because mujoco was imported without an OpenGL library, the films are drawn in a child
process (python -m planner.view.render.drawing JOBFILE).
"""

from __future__ import annotations

import json
import math
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from planner.base import errors, gl
from planner.base.errors import PlannerError, RenderingUnavailable
from planner.view.render import overlay
from planner.view.render.encode import Encoder
from planner.view.render.film import Film
from planner.view.render.scene import Scene, best_rows
from planner.view.render.setting import visible_model

Progress = Callable[[int, int], object]

_HOLD = 1.0  # s, how long the last frame stays
_VIDEO_OVERSIZE = 1.5  # two thirds of the time that 2 takes, and in motion nobody sees the difference


@dataclass(frozen=True)
class Job:
    """A video, strip or still to make of films. Sizes are pixels of the whole picture."""

    kind: str  # "video", "strip" or "frame"
    width: int
    height: int
    fps: float = 0.0  # of a video
    speed: float | None = None  # of a video; None for stills
    output: str = ""  # the file of a video
    shown: str = ""  # the path that an error names, where output is a temporary one


def carry_out(films: Sequence[Film], job: Job, progress: Progress | None = None) -> np.ndarray:
    """Do the job, here or in a child process. Returns the picture; of a video, the last frame.

    `films` is one, or for a video or a still two of the same plan and times, shown side by side. `progress` is called
    with (frames done, frames in all) of a video.
    """
    return (_draw if gl.can_render_here() else _draw_in_child)(films, job, progress)


def _draw(films: Sequence[Film], job: Job, progress: Progress | None) -> np.ndarray:
    if job.kind == "strip":
        return _draw_strip(films[0], job)
    with ExitStack() as scenes:
        rows = _tiles(films, job, scenes)

        def picture(frame: int) -> np.ndarray:
            parts = [np.concatenate([tile.draw(frame) for tile in row], axis=1) for row in rows]
            return _parted(np.concatenate(parts), rows)

        return picture(0) if job.kind == "frame" else _draw_video(picture, len(films[0]), job, progress)


def _draw_video(picture: Callable[[int], np.ndarray], frames: int, job: Job, progress: Progress | None) -> np.ndarray:
    total = frames + round(_HOLD * job.fps)
    with Encoder(Path(job.output), job.width, job.height, job.fps, job.shown) as encoder:
        image = np.empty(0)
        for done in range(total):
            if done < frames:
                image = picture(done)
            encoder.write(image)
            if progress is not None:
                progress(done + 1, total)
    return image


def _tiles(films: Sequence[Film], job: Job, scenes: ExitStack) -> list[list[_Tile]]:
    """The parts of a picture, row by row; `scenes` closes their OpenGL contexts."""
    seen = [film.views for film in films]  # by film and camera
    if len(films) > 1:
        seen = [list(row) for row in zip(*seen, strict=True)]
    widths, heights = _shares(job.width, len(seen[0])), _shares(job.height, len(seen))
    largest = np.max([film.largest for film in films], axis=0)
    tiles: list[list[_Tile]] = []
    for i, row in enumerate(seen):
        tiles.append([])
        for j, film in enumerate(row):
            first = i == 0 if len(films) > 1 else j == 0  # of the cameras
            last_row, last_column = i == len(seen) - 1, j == len(row) - 1
            beside = [other for other in row if other is not film] if len(films) > 1 else []
            captioned = last_row and (len(films) > 1 or first)
            views = film.appearance.views
            words = overlay.Words(
                largest, numbers=first, legend=last_row and j == 0,
                speed=job.speed if last_row and last_column else None,
                caption=film.caption if captioned else None, unstable=film.unstable if captioned else math.inf,
                label=views[0].label if views else "",
            )  # fmt: skip
            scene = Scene(
                film, widths[j], heights[i], oversize=_VIDEO_OVERSIZE if job.kind == "video" else 2.0, beside=beside,
                narrow=len(row) > 1 or len(seen) > 1,
            )  # fmt: skip
            written = overlay.Overlay(film.appearance, widths[j], heights[i], words)
            tiles[-1].append(_Tile(film, written, scenes.enter_context(scene)))
    return tiles


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
    words: overlay.Overlay
    scene: Scene

    def draw(self, frame: int) -> np.ndarray:
        """Frame number `frame`: (height, width, 3), uint8."""
        drawn, film = self.scene.draw(frame), self.film
        ends = [self.scene.project(np.asarray(end)) for end in film.appearance.goal_line or ()]
        seen = [end for end in ends if end is not None]
        marks = [overlay.beside(label) for label in self.scene.labels(frame)]
        if seen:  # at the right end of the line
            marks.append(overlay.Mark(max(seen), f" {film.appearance.goal_label}"))
        return self.words.write(drawn, film.t[frame], film.readings[frame], marks)


def _draw_strip(film: Film, job: Job) -> np.ndarray:
    if film.appearance.accompany is None:  # one camera for all poses, so that their heights compare
        middle = 0.5 * (film.shift.min(axis=0) + film.shift.max(axis=0))
        film = replace(film, shift=np.tile(middle, (len(film), 1)))
    heights = _shares(job.height, len(film.views))
    strips = [_draw_poses(seen, job.width, high) for seen, high in zip(film.views, heights, strict=True)]
    return np.concatenate(strips)


def _draw_poses(film: Film, width: int, height: int) -> np.ndarray:
    """All poses from one camera: (height, width, 3)."""
    gap = max(1, round(height / 270))
    model = visible_model(film)
    rows = best_rows(film, model, width, height)
    columns = math.ceil(len(film) / rows)
    tile = (width - gap * (columns - 1)) // columns
    high = (height - gap * (rows - 1)) // rows
    unit = min(height / 540, tile / 160)
    band = min(round(30 * unit), high // 3)
    strip = np.full((height, width, 3), 255, np.uint8)
    # Both sides share the remainder of the division.
    left = (width - tile * columns - gap * (columns - 1)) // 2
    with Scene(film, tile, high - band, ghost=False, model=model) as scene:
        for frame, t in enumerate(film.t):
            row, column = (frame // columns) * (high + gap), left + (frame % columns) * (tile + gap)
            words = film.words[frame] if film.words else overlay.time_words(t, unstable=t >= film.unstable)
            picture, marks = scene.draw(frame), [overlay.beside(label) for label in scene.labels(frame)]
            picture = overlay.write_below(picture, words, band, unit, marks, bad=t >= film.unstable)
            strip[row : row + high, column : column + tile] = picture
    return strip


def _draw_in_child(films: Sequence[Film], job: Job, progress: Progress | None) -> np.ndarray:
    with tempfile.TemporaryDirectory(prefix="planner-") as folder:
        file = Path(folder) / "job"
        file.write_bytes(pickle.dumps((films, job)))
        # The child must find this very package, whatever folder it is started in.
        places = [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, places))}
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", "planner.view.render.drawing", str(file)],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip
        try:
            return _follow(child, file, progress)
        finally:
            child.kill()  # does nothing to a finished process
            child.communicate()


def _follow(child: subprocess.Popen[str], file: Path, progress: Progress | None) -> np.ndarray:
    """Read what the child reports, one JSON line at a time, until it is done."""
    assert child.stdout is not None
    assert child.stderr is not None
    for line in child.stdout:
        report: dict[str, Any] = json.loads(line)
        if "error" in report:
            raise getattr(errors, report["error"])(report["message"])
        if progress is not None:
            progress(report["done"], report["total"])
    said = child.stderr.read().strip().splitlines()
    if child.wait() != 0:
        reason = said[-1] if said else f"exit code {child.returncode}"
        raise RenderingUnavailable(f"The process that draws failed: {reason}.")
    return np.load(file.with_suffix(".npy"), allow_pickle=False)


def _child(file: Path) -> int:
    """The child's side: do the job in the file, report on stdout, leave the picture beside it."""
    films, job = pickle.loads(file.read_bytes())
    try:
        image = _draw(films, job, lambda done, total: _report(done=done, total=total))
    except PlannerError as error:
        _report(error=type(error).__name__, message=str(error))
        return 1
    np.save(file.with_suffix(".npy"), image)
    return 0


def _report(**values: Any) -> None:
    sys.stdout.write(json.dumps(values) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(_child(Path(sys.argv[1])))
