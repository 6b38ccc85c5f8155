"""Compile MJCF in a child process with limits of time and memory.

MuJoCo's compiler ignores signals, and a few lines of MJCF can keep it busy for hours, ask for more memory than there
is, or end the process. So a child compiles the model and places its bodies once, and the model comes back as
MuJoCo's binary: what ends the child is one sentence here. The child is a fork, which takes a few milliseconds, because
nothing is imported again. Forks are safe beside other threads on Linux only; elsewhere models are compiled in place.
"""

from __future__ import annotations

import faulthandler
import os
import select
import signal
import sys
import threading
import time
import warnings
from typing import Any, NoReturn

import numpy as np

from planner.base.arguments import shown
from planner.base.errors import ModelError
from planner.base.gl import load_mujoco

SECONDS = 10  # of the child's processor time
MEMORY = 2 * 2**30  # bytes, beside those of this process
_LONGEST_WAIT = 3.0 * SECONDS  # of the clock: other work may keep the processor from the child
_MODEL, _REFUSED = b"model", b"refused"  # how an answer begins
_NAME = "model.mjb"
_forking = threading.Lock()  # the filters of warnings are of the process, not of a thread


def compiled(text: str, assets: dict[str, bytes], name: str) -> Any:
    """MuJoCo's MjModel of an MJCF text and its files; a message calls it `name`.

    Raises:
        ModelError: MuJoCo refuses it, or takes too long, or needs too much memory, or breaks down.
    """
    mujoco = load_mujoco()
    if sys.platform != "linux":
        return _compile(text, assets, name)
    answer, ended_by = _asked(text, assets, name)
    if answer.startswith(_MODEL):
        return mujoco.MjModel.from_binary_path(_NAME, {_NAME: answer[len(_MODEL) :]})
    if answer.startswith(_REFUSED):
        raise ModelError(answer[len(_REFUSED) :].decode())
    if ended_by in (signal.SIGKILL, signal.SIGXCPU):
        raise ModelError(f"MuJoCo takes more than {SECONDS} s to compile {name}, expected a smaller model.")
    raise ModelError(
        f"MuJoCo's compiler breaks down at {name} (signal {ended_by}), expected a model without its cause."
    )


def _asked(text: str, assets: dict[str, bytes], name: str) -> tuple[bytes, int]:
    """A child's answer, a model or why not, or a part of it, and then the signal that ended it."""
    ours, theirs = os.pipe()
    with _forking, warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of the threads that the child does not have
        child = os.fork()
    if child == 0:
        _answer(text, assets, name, theirs)
    os.close(theirs)
    parts, ends, ended = [], time.monotonic() + _LONGEST_WAIT, False
    try:
        while not ended and select.select([ours], [], [], max(0.0, ends - time.monotonic()))[0]:
            parts.append(os.read(ours, 2**20))
            ended = not parts[-1]
    finally:
        os.close(ours)
        if not ended:  # it takes too long, or nobody waits for it any more
            os.kill(child, signal.SIGKILL)
        status = os.waitpid(child, 0)[1]
    ended_by = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
    return b"" if ended_by else b"".join(parts), ended_by


def _answer(text: str, assets: dict[str, bytes], name: str, answer: int) -> NoReturn:
    """Compile in this child, write the answer, and end."""
    import resource  # of POSIX only

    try:
        for kill in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(kill, signal.SIG_DFL)
        faulthandler.disable()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # C++ prints there why it ends
        with open("/proc/self/statm") as sizes:
            now = int(sizes.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        _limit(resource.RLIMIT_AS, now + MEMORY)
        _limit(resource.RLIMIT_CPU, SECONDS)
        _limit(resource.RLIMIT_CORE, 0)
        try:
            model = _compile(text, assets, name)
            _place(model, name)
            content = np.empty(load_mujoco().mj_sizeModel(model), dtype=np.uint8)
            load_mujoco().mj_saveModel(model, None, content)
            words = _MODEL + content.tobytes()
        except ModelError as error:
            words = _REFUSED + str(error).encode()
        except MemoryError:
            more = f"MuJoCo needs more than {MEMORY / 2**30:g} GB for {name}, expected a smaller model."
            words = _REFUSED + more.encode()
        with open(answer, "wb") as pipe:
            pipe.write(words)
    finally:
        os._exit(0)


def _limit(what: int, soft: int) -> None:
    """Lower a limit of this process to `soft`, unless it is lower already."""
    import resource

    hard = resource.getrlimit(what)[1]
    resource.setrlimit(what, (soft if hard == resource.RLIM_INFINITY else min(soft, hard), hard))


def _compile(text: str, assets: dict[str, bytes], name: str) -> Any:
    mujoco = load_mujoco()
    try:
        model = mujoco.MjModel.from_xml_string(text, assets)
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise ModelError(f"MuJoCo refuses {name}: {_reason(error)}") from None
    _check_names(model, name)
    return model


def _place(model: Any, name: str) -> None:
    """What every use of the model does first, with the memory that it takes."""
    mujoco = load_mujoco()
    try:
        mujoco.mj_kinematics(model, mujoco.MjData(model))
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise ModelError(f"MuJoCo refuses {name}: {_reason(error)}") from None


def _check_names(model: Any, name: str) -> None:
    """Raise ModelError for names with line ends or a terminal's escapes: they could forge a line of the output."""
    for one in bytes(model.names).split(b"\0"):
        text = one.decode(errors="replace")
        if not text.isprintable():
            raise ModelError(f"{name} has an element named {shown(text)}, expected a name of printable characters.")


def _reason(error: Exception) -> str:
    reason = " ".join(str(error).split()) or "it does not say why"
    if "unknown exception" in reason or "allocate memory" in reason:
        reason = f"it asks for more than {MEMORY / 2**30:g} GB ({reason.rstrip('.!')})"
    return reason if reason.endswith((".", "!", "?")) else f"{reason}."
