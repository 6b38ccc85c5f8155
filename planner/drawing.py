"""Films into pictures: the frames of a video, of two side by side, a strip, a still.

If this process cannot draw, because mujoco was imported before there was a choice of a library, the same films are
drawn in a child process (python -m planner.drawing JOBFILE ...).
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from planner import errors, gl, overlay
from planner.encode import Encoder
from planner.errors import PlannerError, RenderingUnavailable
from planner.film import Film
from planner.scene import Scene, best_rows
from planner.stage import Stage

Progress = Callable[[int, int], object]

_HOLD = 1.0  # s, how long the last frame stays
_VIDEO_OVERSIZE = 1.5  # two thirds of the time that 2 takes, and in motion nobody sees the difference


@dataclass(frozen=True)
class Job:
    """What to make of films.

    Attributes:
        kind: "video", "strip" or "frame".
        width: Pixels of the whole picture.
        height: Pixels.
        fps: Of a video.
        speed: Of a video; None for stills.
        output: Where to write a video.
        shown: The path that an error names, where output is a temporary one.
    """

    kind: str
    width: int
    height: int
    fps: float = 0.0
    speed: float | None = None
    output: str = ""
    shown: str = ""


def carry_out(films: Sequence[Film], job: Job, progress: Progress | None = None) -> np.ndarray:
    """Do the job, here or in a child process. The picture; of a video, the last frame.

    Args:
        films: One, or for a video or a still two of the same plan, at the same times, to be shown side by side.
        job: What to make.
        progress: Called with (frames done, frames in all) of a video.
    """
    if gl.can_render_here():
        return _draw(films, job, progress)
    return _draw_in_child(films, job, progress)


def _draw(films: Sequence[Film], job: Job, progress: Progress | None) -> np.ndarray:
    if job.kind == "strip":
        return _draw_strip(films[0], job)
    with ExitStack() as scenes:
        views = [scenes.enter_context(_View(films, number, job)) for number in range(len(films))]

        def picture(frame: int) -> np.ndarray:
            return np.concatenate([view.draw(frame) for view in views], axis=1)

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


class _View:
    """One film of a picture, with its words. A context manager."""

    def __init__(self, films: Sequence[Film], number: int, job: Job) -> None:
        film = self._film = films[number]
        self._stage = film.stage or Stage(title="")
        first, last = number == 0, number == len(films) - 1
        # What the division leaves over goes to the last.
        width = job.width // len(films) + (job.width % len(films) if last else 0)
        beside = [other for other in films if other is not film]
        self._words = overlay.Overlay(
            self._stage, width, job.height, largest=np.max([other.largest for other in films], axis=0),
            speed=job.speed if last else None, legend=first, caption=film.caption, unstable=film.unstable,
        )  # fmt: skip
        oversize = _VIDEO_OVERSIZE if job.kind == "video" else 2.0
        self._scene = Scene(film, width, job.height, oversize=oversize, beside=beside)

    def __enter__(self) -> _View:
        self._scene.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._scene.__exit__(*error)

    def draw(self, frame: int) -> np.ndarray:
        """Frame number `frame`: (height, width, 3), uint8."""
        drawn, film = self._scene.draw(frame), self._film
        return self._words.write(drawn, film.t[frame], film.readings[frame], self._marks())

    def _marks(self) -> list[overlay.Mark]:
        """The goal's label and where it stands in the last drawn picture."""
        if self._stage.goal_line is None:
            return []
        ends = [self._scene.project(np.asarray(end)) for end in self._stage.goal_line]
        seen = [end for end in ends if end is not None]
        return [(max(seen), f" {self._stage.goal_label}", "lm")] if seen else []  # behind the end further right


def _draw_strip(film: Film, job: Job) -> np.ndarray:
    gap = max(1, round(job.height / 270))
    if film.stage is None or film.stage.accompany is None:  # one camera for all poses, so that their heights compare
        middle = 0.5 * (film.shift.min(axis=0) + film.shift.max(axis=0))
        film = replace(film, shift=np.tile(middle, (len(film), 1)))
    rows = best_rows(film, job.width, job.height)
    columns = math.ceil(len(film) / rows)
    tile = (job.width - gap * (columns - 1)) // columns
    high = (job.height - gap * (rows - 1)) // rows
    unit = min(job.height / 540, tile / 160)
    band = min(round(30 * unit), high // 3)
    strip = np.full((job.height, job.width, 3), 255, np.uint8)
    # What the division leaves over goes to both sides.
    left = (job.width - tile * columns - gap * (columns - 1)) // 2
    with Scene(film, tile, high - band, ghost=False) as scene:
        for frame, t in enumerate(film.t):
            row, column = (frame // columns) * (high + gap), left + (frame % columns) * (tile + gap)
            picture = overlay.write_time(scene.draw(frame), t, band, unit, unstable=t >= film.unstable)
            strip[row : row + high, column : column + tile] = picture
    return strip


def _draw_in_child(films: Sequence[Film], job: Job, progress: Progress | None) -> np.ndarray:
    with tempfile.TemporaryDirectory(prefix="planner-") as folder:
        files = [Path(folder) / f"job{number}.npz" for number in range(len(films))]
        for film, file in zip(films, files, strict=True):
            film.save(file, **asdict(job))
        # The child must find this very package, whatever folder it is started in.
        places = [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, places))}
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", "planner.drawing", *map(str, files)],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip
        try:
            return _follow(child, files[0], progress)
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


def _child(files: list[Path]) -> int:
    """The child's side: do the job in the files, report on stdout, leave the picture beside the first."""
    loaded = [Film.load(file) for file in files]
    try:
        films, job = [film for film, _ in loaded], Job(**loaded[0][1])
        image = _draw(films, job, lambda done, total: _report(done=done, total=total))
    except PlannerError as error:
        _report(error=type(error).__name__, message=str(error))
        return 1
    np.save(files[0].with_suffix(".npy"), image)
    return 0


def _report(**values: Any) -> None:
    sys.stdout.write(json.dumps(values) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(_child([Path(file) for file in sys.argv[1:]]))
