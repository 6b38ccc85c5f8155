"""Draw a proof's strip of poses and its film in the background, beside its rollouts.

Child processes draw, so that a thread of this one has little to do. What comes in its way is raised by finish().
"""

from __future__ import annotations

import argparse
import threading
import time
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from planner.base.gl import backend
from planner.cli.console import Console
from planner.model.mjcf.model_index import compile_model
from planner.model.twin import Twin
from planner.proof import Proof

NAMES = ("strip.png", "video.mp4")
_PATIENCE = 0.1  # s between two looks at the progress


def checked_looks(arguments: argparse.Namespace, twin: Twin | None, *, film: bool = True) -> dict[str, Any]:
    """Width, height and camera that the flags ask for, as arguments of render_video.

    Where it is no `film` but a strip, also whether that is transparent, as arguments of render_strip.

    Raises:
        PlannerError: A size that no film can have, or a camera that the model does not have.
    """
    from planner.view.render.camera import angles_of_camera
    from planner.view.render.video import check_size

    looks: dict[str, Any] = {"camera": arguments.camera} | ({} if film else {"transparent": arguments.transparent})
    if arguments.size is not None:
        looks |= dict(zip(("width", "height"), arguments.size, strict=True))
        check_size(*arguments.size, even=film)
    if isinstance(arguments.camera, str) and twin is not None:
        angles_of_camera(compile_model(twin.mjcf, twin.assets), arguments.camera)
    return looks


class _Stopped(Exception):
    """The film is no longer wanted."""


class BackgroundRender:
    """Strip and film of a proof on their way into a folder; a context manager, at whose end nothing draws any more."""

    def __init__(
        self, proof: Proof, folder: Path, keep: Collection[str], console: Console,
        looks: dict[str, Any] | None = None, transparent: bool = False,
    ) -> None:  # fmt: skip
        """Begin with the files that are not named in `keep`. Without an OpenGL library there is nothing to do.

        `looks` are width, height and camera of the film (checked_looks()); the strip has the camera, and may be
        `transparent`.
        """
        self.names = tuple(name for name in NAMES if name not in keep) if backend() is not None else ()
        self._proof, self._folder, self._console = proof, folder, console
        self._looks, self._transparent = looks or {}, transparent
        self._stop, self._error = threading.Event(), None
        self._done = (0, 0)  # frames, and frames in all
        self._thread = threading.Thread(target=self._draw, name="film", daemon=True)
        if self.names:
            self._thread.start()

    def finish(self, deadline: float | None = None) -> bool:
        """Wait for the files, until a deadline of time.monotonic() at most, and show how far they are.

        Returns whether they are finished.

        Raises:
            RenderingUnavailable: The OpenGL library is there but does not work.
            FileError: A file cannot be written.
        """
        show = self._console.progress("video")
        while self._thread.is_alive():
            self._thread.join(_PATIENCE)
            if deadline is not None and time.monotonic() >= deadline and self._thread.is_alive():
                return False
            if 0 < self._done[0] < self._done[1]:
                show(*self._done)
        if self._error is not None:
            raise self._error
        if self._done[1]:
            show(*self._done)
        return True

    def __enter__(self) -> BackgroundRender:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        with suppress(RuntimeError):  # it was never started
            self._thread.join()

    def _draw(self) -> None:
        from planner.view.render.video import render_strip, render_video

        try:
            if "strip.png" in self.names:
                strip, camera = self._folder / "strip.png", self._looks.get("camera")
                render_strip(self._proof.replay, strip, camera=camera, transparent=self._transparent)
            if "video.mp4" in self.names:
                render_video(self._proof, self._folder / "video.mp4", progress=self._count, **self._looks)
        except _Stopped:
            pass
        except BaseException as error:
            self._error = error

    def _count(self, done: int, total: int) -> None:
        if self._stop.is_set():
            raise _Stopped
        self._done = (done, total)
