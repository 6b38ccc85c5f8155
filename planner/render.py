"""Films, strips and stills of a replay: the simulated machine solid, the plan as a ghost beside it.

Headless: gl.py finds a library to draw with. If this process cannot draw, because mujoco was imported before
there was a choice, the same film is drawn in a child process (python -m planner.render JOBFILE).
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from planner import errors, gl, overlay
from planner.arguments import count, number
from planner.default_stage import stage_of
from planner.encode import Encoder
from planner.errors import PlannerError, RenderingUnavailable
from planner.files import PathLike, file_error, write_atomically
from planner.film import Film
from planner.scene import Scene, best_rows
from planner.stage import Stage

if TYPE_CHECKING:
    from planner.replay import Replay

Progress = Callable[[int, int], object]

_HOLD = 1.0  # s, how long the last frame stays
_VIDEO_OVERSIZE = 1.5  # two thirds of the time that 2 takes, and in motion nobody sees the difference
_LARGEST = 4096  # pixels; scene.py draws twice as large, and OpenGL gives little more than 8192
_LONGEST = 100_000  # frames


def render_video(
    replay: Replay,
    path: PathLike,
    *,
    width: int = 1280,
    height: int = 720,
    fps: float = 60,
    speed: float | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write a film of a replay: H.264 in MP4, for any browser or player.

    Args:
        replay: What to show.
        path: The file, ending in .mp4.
        width: Pixels, even.
        height: Pixels, even.
        fps: Frames per second.
        speed: Playback speed, 0.25 is four times slow motion; None takes the stage's.
        progress: Called with (frames done, frames in all).

    Returns:
        The path.

    Raises:
        PlannerError: An argument is wrong.
        RenderingUnavailable: No OpenGL library was found.
        FileError: The file cannot be written.
    """
    _check_suffix(path, ".mp4")
    _check_size(width, height, even=True)
    number("fps", fps, above=0.0)
    if speed is None:
        speed = (stage_of(replay.plan.problem) or Stage(title="")).speed
    number("speed", speed, above=0.0)
    start, end = float(replay.t[0]), float(replay.t[-1])
    if not (end - start) * fps / speed < _LONGEST:
        raise PlannerError(
            f"{end - start:g} s at speed {speed:g} and {fps:g} fps are more than {_LONGEST} frames; "
            "raise the speed or lower fps."
        )
    frames = max(1, math.ceil((end - start) * fps / speed - 1e-9))
    film = Film.of(replay, np.minimum(start + np.arange(frames + 1) * speed / fps, end))
    gl.require_backend()
    with write_atomically(path) as hidden:
        job = _Job("video", width, height, fps, speed, str(hidden.absolute()), str(path))
        _carry_out(film, job, progress)
    return Path(path)


def render_strip(replay: Replay, path: PathLike, *, poses: int = 8, width: int = 1920, height: int = 540) -> Path:
    """Write a PNG with poses at equal times side by side, as in the paper's figures.

    Args:
        replay: What to show.
        path: The file, ending in .png.
        poses: How many, the first and the last included.
        width: Of the whole picture, pixels.
        height: Pixels.

    Returns:
        The path.

    Raises:
        PlannerError: An argument is wrong.
        RenderingUnavailable: No OpenGL library was found.
        FileError: The file cannot be written.
    """
    _check_suffix(path, ".png")
    _check_size(width, height)
    count("poses", poses, least=2, most=max(2, width // 16))  # 16 pixels each
    film = Film.of(replay, np.linspace(replay.t[0], replay.t[-1], poses))
    gl.require_backend()
    with write_atomically(path) as hidden:
        picture = _carry_out(film, _Job("strip", width, height), None)
        try:
            Image.fromarray(picture).save(hidden, format="PNG")
        except OSError as error:
            raise file_error(error, path) from error
    return Path(path)


def render_frame(replay: Replay, t: float, *, width: int = 1280, height: int = 720) -> np.ndarray:
    """One picture of a replay.

    Args:
        replay: What to show.
        t: When, s.
        width: Pixels.
        height: Pixels.

    Returns:
        (height, width, 3), uint8.

    Raises:
        PlannerError: An argument is wrong.
        RenderingUnavailable: No OpenGL library was found.
    """
    _check_size(width, height)
    if not replay.t[0] <= t <= replay.t[-1]:
        raise PlannerError(f"t must be from {replay.t[0]:g} to {replay.t[-1]:g} s, got {t!r}.")
    film = Film.of(replay, np.array([float(t)]))
    gl.require_backend()
    return _carry_out(film, _Job("frame", width, height), None)


@dataclass(frozen=True)
class _Job:
    """What to make of a film.

    Attributes:
        kind: "video", "strip" or "frame".
        width: Pixels.
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


def _carry_out(film: Film, job: _Job, progress: Progress | None) -> np.ndarray:
    """Do the job, here or in a child process. The picture; of a video, the last frame."""
    if gl.can_render_here():
        return _draw(film, job, progress)
    return _draw_in_child(film, job, progress)


def _draw(film: Film, job: _Job, progress: Progress | None) -> np.ndarray:
    if job.kind == "strip":
        return _draw_strip(film, job)
    stage = film.stage or Stage(title="")
    words = overlay.Overlay(stage, job.width, job.height, largest=film.largest, speed=job.speed)
    oversize = _VIDEO_OVERSIZE if job.kind == "video" else 2.0
    with Scene(film, job.width, job.height, oversize=oversize) as scene:

        def picture(frame: int) -> np.ndarray:
            drawn = scene.draw(frame)
            return words.write(drawn, film.t[frame], film.readings[frame], _marks(scene, stage))

        if job.kind == "frame":
            return picture(0)
        hold = round(_HOLD * job.fps)
        total = len(film) + hold
        with Encoder(Path(job.output), job.width, job.height, job.fps, job.shown) as encoder:
            image = np.empty(0)
            for done in range(total):
                if done < len(film):
                    image = picture(done)
                encoder.write(image)
                if progress is not None:
                    progress(done + 1, total)
        return image


def _draw_strip(film: Film, job: _Job) -> np.ndarray:
    gap = max(1, round(job.height / 270))
    # One camera for all poses, so that their heights compare.
    film = replace(film, rise=np.full(len(film), 0.5 * (film.rise.min() + film.rise.max())))
    rows = best_rows(film, job.width, job.height)
    columns = math.ceil(len(film) / rows)
    tile = (job.width - gap * (columns - 1)) // columns
    high = (job.height - gap * (rows - 1)) // rows
    strip = np.full((job.height, job.width, 3), 255, np.uint8)
    # What the division leaves over goes to both sides.
    left = (job.width - tile * columns - gap * (columns - 1)) // 2
    unit = min(job.height / 540, tile / 160)
    with Scene(film, tile, high, ghost=False) as scene:
        for frame in range(len(film)):
            row, column = (frame // columns) * (high + gap), left + (frame % columns) * (tile + gap)
            picture = overlay.write_time(scene.draw(frame), film.t[frame], unit)
            strip[row : row + high, column : column + tile] = picture
    return strip


def _marks(scene: Scene, stage: Stage) -> list[overlay.Mark]:
    """The goal's label and where it stands in the last drawn picture."""
    marks: list[overlay.Mark] = []
    if stage.goal_line is not None:
        ends = [scene.project(np.asarray(end)) for end in stage.goal_line]
        seen = [end for end in ends if end is not None]
        if seen:
            marks.append((max(seen), f" {stage.goal_label}", "lm"))  # behind the end that is further right
    return marks


def _draw_in_child(film: Film, job: _Job, progress: Progress | None) -> np.ndarray:
    with tempfile.TemporaryDirectory(prefix="planner-") as folder:
        file = Path(folder) / "job.npz"
        film.save(file, **asdict(job))
        # The child must find this very package, whatever folder it is started in.
        places = [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, places))}
        child = subprocess.Popen(
            [sys.executable, "-P", "-m", "planner.render", str(file)],
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
    """The child's side: do the job in the file, report on stdout, leave the picture beside the file."""
    film, job = Film.load(file)
    try:
        image = _draw(film, _Job(**job), lambda done, total: _report(done=done, total=total))
    except PlannerError as error:
        _report(error=type(error).__name__, message=str(error))
        return 1
    np.save(file.with_suffix(".npy"), image)
    return 0


def _report(**values: Any) -> None:
    sys.stdout.write(json.dumps(values) + "\n")
    sys.stdout.flush()


def _check_suffix(path: PathLike, suffix: str) -> None:
    if Path(path).suffix.lower() != suffix:
        raise PlannerError(f"The file's name must end in {suffix}, got {os.fspath(path)!r}.")


def _check_size(width: int, height: int, *, even: bool = False) -> None:
    for name, value in (("width", width), ("height", height)):
        if count(name, value, least=16, most=_LARGEST) % 2 and even:
            raise PlannerError(f"{name} is {value!r}, expected an even number of pixels: H.264 films need it.")


if __name__ == "__main__":
    sys.exit(_child(Path(sys.argv[1])))
