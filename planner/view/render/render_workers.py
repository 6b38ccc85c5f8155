"""Child processes that draw: several share the frames of a video, and one draws where this process cannot.

Each child (python -m planner.view.render.drawing JOBFILE FIRST STRIDE) draws every STRIDE-th frame and writes to its
stdout, for each, a line of JSON and then the picture's bytes. This process reads the frames in their order.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from planner.base import errors
from planner.base.errors import PlannerError, RenderingUnavailable

_DRAWING = "planner.view.render.drawing"
_ROOT = Path(__file__).parents[3]


def usable_processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
    said = log.read_text(errors="replace").strip().splitlines()
    reason = said[-1] if said else f"exit code {child.returncode}"
    raise RenderingUnavailable(f"The process that draws failed: {reason}.")
