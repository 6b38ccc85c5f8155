"""Films, strips and stills of a replay: the simulated machine solid, the plan as a ghost."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from planner.base import gl
from planner.base.arguments import array, count, number, short_repr
from planner.base.errors import PlannerError
from planner.base.files import PathLike, file_error, write_atomically
from planner.model.mjcf.model_index import compile_model
from planner.problem.default_appearance import appearance_of
from planner.proof.original_model import OPEN_LOOP_MISSES
from planner.proof.replays.replaying import Replay
from planner.view.plots.style import MODE_WORDS
from planner.view.render.camera import angles_of_camera, checked_direction, scenery_of, swept_points
from planner.view.render.drawing import Job, carry_out, frames_of
from planner.view.render.encoder import FILMS, Encoder
from planner.view.render.film import Caption, Film
from planner.view.render.marks import screen_difference

if TYPE_CHECKING:
    from planner.model.mechanism import Mechanism
    from planner.proof import Proof

Progress = Callable[[int, int], object]

_HOLD = 1.0  # s, how long the last frame stays
_LARGEST = 4096  # pixels; scene.py draws twice as large, and OpenGL gives little more than 8192
_MAX_SECONDS, _MAX_FRAMES = 600.0, 100_000  # that a film plays in slow motion; that any film has
_UNSEEN = 4.0 / 500.0  # of the motion's largest side, about 500 pixels of a film: at 4 pixels a ghost is drawn in full


def render_video(
    shown: Replay | Proof,
    path: PathLike,
    *,
    width: int = 1280,
    height: int = 720,
    fps: float = 30,
    speed: float | None = None,
    camera: str | Sequence[float] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write a film of a replay, or of both replays of a proof side by side, as H.264 in MP4, as GIF or as animated PNG.

    Args:
        shown: A replay, or a proof for its open-loop replay at the left and the one with gains at the
            right, each with the ghost of the plan; one of them where both pass or fail and look the same. A replay that
            ran away stays in its last pose.
        path: The file, ending in .mp4, or in .gif or .apng for pages that show no videos.
        width: Pixels, even.
        height: Pixels, even.
        fps: Frames per second.
        speed: Playback speed, 0.25 is four times slow motion; None takes the appearance's.
        camera: Azimuth and elevation of the line of sight, degrees, as of MuJoCo's viewer, or the name of a camera of
            the model, in whose direction the film looks from where it sees the whole motion; None takes the
            appearance's.
        progress: Called with (frames done, frames in all).

    Returns:
        The path.

    Raises:
        PlannerError: An argument is wrong.
        RenderingUnavailable: No OpenGL library was found.
        FileError: The file cannot be written.
    """
    if not isinstance(shown, Replay) and not hasattr(shown, "replays"):
        raise _wrong("shown", shown, "a Proof or a Replay", "render_video(planner.prove(plan), path)")
    _check_suffix(path, *FILMS)
    check_size(width, height, even=True)
    number("fps", fps, greater_than=0.0)
    replays: dict[Replay, Caption | None] = {shown: None} if isinstance(shown, Replay) else _captioned(shown)
    first = next(iter(replays))
    if speed is None:
        speed = appearance_of(first.plan.problem).speed
    number("speed", speed, greater_than=0.0)
    start, end = float(first.t[0]), float(first.t[-1])
    _check_length(end - start, fps, speed)
    frames = max(1, math.ceil((end - start) * fps / speed - 1e-9))
    t = np.minimum(start + np.arange(frames + 1) * speed / fps, end)
    films = [_seen_from(Film.of(replay, t, caption), camera) for replay, caption in replays.items()]
    gl.require_backend()
    with write_atomically(path) as hidden:
        job, total = Job("video", width, height, fps, speed), len(films[0])
        with closing(frames_of(films, job)) as drawn, Encoder(hidden, width, height, fps, path, _HOLD) as encoder:
            for done, image in enumerate(drawn, 1):
                encoder.write(image)
                if progress is not None:
                    progress(done, total)
    return Path(path)


def _check_length(seconds: float, fps: float, speed: float) -> None:
    """Refuse a film of a motion of so many seconds that would be drawn for hours."""
    plays, most = seconds / speed, max(seconds, _MAX_SECONDS)
    if plays > most:
        raise PlannerError(
            f"{seconds:g} s at speed {speed:g} play for {plays:.4g} s, {plays * fps:,.0f} frames; expected at most "
            f"{most:g} s: a speed of {math.ceil(1e4 * seconds / most) / 1e4:g} or more."
        )
    if not plays * fps <= _MAX_FRAMES:
        rate, least = math.floor(_MAX_FRAMES / plays), plays * speed / _MAX_FRAMES
        write = f"fps of {rate} or less" if rate else f"a speed of {least:.3g} or more"
        raise PlannerError(
            f"{seconds:g} s at speed {speed:g} and {fps:g} fps are {plays * fps:,.0f} frames, expected at most "
            f"{_MAX_FRAMES}: {write}."
        )


def one_replay_shows_both(proof: Proof) -> bool:
    """Whether both modes of a proof pass or both fail, and no point of the machine is visibly apart in them."""
    if len({_reproduces(proof, mode) for mode in MODE_WORDS}) > 1:
        return False
    one, other = (Film.of(proof.replays[mode], np.zeros(1)) for mode in MODE_WORDS)
    if math.isfinite(min(one.unstable, other.unstable)):
        return False
    model = compile_model(one.mjcf, one.assets)
    scenery = scenery_of(model, one.appearance)[0]
    first, second = (swept_points(model, film.path_qpos, scenery) for film in (one, other))
    return screen_difference(first, second) <= _UNSEEN * float(np.ptp(first, axis=0).max())


def _reproduces(proof: Proof, mode: str) -> bool:
    """Whether this mode alone would do; the first that does is the proof's."""
    return mode == proof.mode or (mode == "feedback" and proof.mode == "open-loop" and not proof.lost_with_gains)


def _captioned(proof: Proof) -> dict[Replay, Caption | None]:
    """The replays of a proof, open loop first, with the words under each; one for both where they look the same."""
    if one_replay_shows_both(proof):
        caption = _caption(proof, proof.mode or "open-loop")
        return {proof.replays["open-loop"]: caption._replace(mode="open loop, and with gains the same")}
    return {proof.replays[mode]: _caption(proof, mode) for mode in MODE_WORDS}


def _caption(proof: Proof, mode: str) -> Caption:
    """What the verdict says about one mode, and why it fails where the picture hardly shows that."""
    sections, reproduces = proof.sections, _reproduces(proof, mode)
    if reproduces and proof.passed:
        return Caption(MODE_WORDS[mode], "PASS" if mode == proof.mode else "")
    why = ""
    if reproduces:
        why = "not optimal"
    elif proof.mode is None and sections[f"refined_{mode.replace('-', '_')}"].passed:
        failed = (section.title for section in sections.values() if section.failures)
        why = "in your file" if sections["your_file"].failures else next(failed, "")
    elif mode == "open-loop" and proof.mode == "feedback" and sections["refined_open_loop"].passed:
        in_file = any(one.name == OPEN_LOOP_MISSES and one.value for one in sections["your_file"].measured)
        why = "in your file" if in_file else "goal" if sections["order"].passed else "step convergence"
    return Caption(MODE_WORDS[mode], "FAIL", why)


def render_strip(
    replay: Replay, path: PathLike, *, poses: int = 8, width: int = 1920, height: int = 540,
    camera: str | Sequence[float] | None = None, transparent: bool = False,
) -> Path:  # fmt: skip
    """Write a PNG with poses at equal times side by side, as in the paper's figures.

    Args:
        replay: The replay to show.
        path: The file, ending in .png.
        poses: How many poses, with the first and the last one.
        width: Of the whole picture, pixels.
        height: Pixels.
        camera: See render_video.
        transparent: Without sky and floor, on a transparent ground.

    Returns:
        The path.

    Raises:
        PlannerError: An argument is wrong.
        RenderingUnavailable: No OpenGL library was found.
        FileError: The file cannot be written.
    """
    _check_replay(replay, "render_strip(proof.replay, path)")
    _check_strip(path, width, height, poses, least=2)
    film = _seen_from(Film.of(replay, np.linspace(replay.t[0], replay.t[-1], poses)), camera)
    return _write_strip(film, Job("strip", width, height, transparent=transparent), path)


def render_poses(
    mechanism: Mechanism, poses: dict[str, np.ndarray], path: PathLike, *, width: int = 1920, height: int = 540
) -> Path:
    """Write a PNG with some poses of a machine side by side, e.g. its keyframes.

    Args:
        mechanism: The machine.
        poses: qpos (nq,) by the words under each; one or more.
        path: The file, ending in .png.
        width: Of the whole picture, pixels.
        height: Pixels.

    Returns:
        The path.

    Raises:
        PlannerError: An argument is wrong.
        RenderingUnavailable: No OpenGL library was found.
        FileError: The file cannot be written.
    """
    if not hasattr(mechanism, "mjcf"):
        raise _wrong("mechanism", mechanism, "a Mechanism", "render_poses(planner.Mechanism.from_mjcf(file), ...)")
    if not isinstance(poses, dict):
        raise _wrong("poses", poses, "positions by the words under them", '{"home": np.zeros(mechanism.nq)}')
    _check_strip(path, width, height, len(poses), least=1)
    poses = {words: array(f"poses[{words!r}]", qpos, (mechanism.nq,)) for words, qpos in poses.items()}
    return _write_strip(Film.of_poses(mechanism, poses), Job("strip", width, height), path)


def _check_strip(path: PathLike, width: int, height: int, poses: int, least: int) -> None:
    _check_suffix(path, ".png")
    check_size(width, height)
    count("poses", poses, minimum=least, maximum=max(least, width // 16))  # 16 pixels each


def _write_strip(film: Film, job: Job, path: PathLike) -> Path:
    gl.require_backend()
    picture = carry_out([film], job)
    with write_atomically(path) as hidden:
        try:
            Image.fromarray(picture).save(hidden, format="PNG")
        except OSError as error:
            raise file_error(error, path) from error
    return Path(path)


def render_frame(
    replay: Replay, t: float, *, width: int = 1280, height: int = 720, camera: str | Sequence[float] | None = None,
    transparent: bool = False,
) -> np.ndarray:  # fmt: skip
    """Draw one picture of a replay.

    Args:
        replay: The replay to show.
        t: The instant to show, s.
        width: Of the picture, pixels.
        height: Of the picture, pixels.
        camera: See render_video.
        transparent: With an alpha channel, and without sky, floor and panels of words.

    Returns:
        (height, width, 3), uint8; (height, width, 4) of a transparent one.

    Raises:
        PlannerError: An argument is wrong.
        RenderingUnavailable: No OpenGL library was found.
    """
    _check_replay(replay, "render_frame(proof.replay, t)")
    check_size(width, height)
    number("t", t, minimum=float(replay.t[0]), maximum=float(replay.t[-1]))
    film = _seen_from(Film.of(replay, np.array([float(t)])), camera)
    gl.require_backend()
    return carry_out([film], Job("frame", width, height, transparent=transparent))


def _seen_from(film: Film, camera: str | Sequence[float] | None) -> Film:
    """The film from one camera in this direction, placed so that it sees the whole motion."""
    if camera is None:
        return film
    if isinstance(camera, str):
        azimuth, elevation = angles_of_camera(compile_model(film.mjcf, film.assets), camera)
    else:
        azimuth, elevation = checked_direction(camera)
    own = replace(film.appearance, azimuth=azimuth, elevation=elevation, may_turn=False, distance=None, views=())
    return replace(film, appearance=own)


def _check_replay(replay: Replay, example: str) -> None:
    if not isinstance(replay, Replay):
        raise _wrong("replay", replay, "a Replay", example)


def _wrong(name: str, value: object, expected: str, example: str) -> PlannerError:
    """That an argument is of another kind than expected."""
    return PlannerError(f"{name} is {short_repr(value)}, expected {expected}, e.g. {example}.")


def _check_suffix(path: PathLike, *suffixes: str) -> None:
    if not isinstance(path, (str, os.PathLike)):
        raise _wrong("path", path, f"a name ending in {' or '.join(suffixes)}", repr(f"motion{suffixes[0]}"))
    if Path(path).suffix.lower() not in suffixes:
        raise PlannerError(f"the file is {os.fspath(path)!r}, expected a name ending in {' or '.join(suffixes)}.")


def check_size(width: int, height: int, *, even: bool = False) -> None:
    """Refuse a size, pixels, that no picture can have, or no film where it is to be `even`."""
    for name, value in (("width", width), ("height", height)):
        if count(name, value, minimum=16, maximum=_LARGEST) % 2 and even:
            raise PlannerError(f"{name} is {value!r}, expected an even number of pixels: H.264 films need it.")
