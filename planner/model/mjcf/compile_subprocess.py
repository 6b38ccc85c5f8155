"""Compile MJCF in a child process with limits of time and memory.

MuJoCo's compiler ignores signals, and a few lines of MJCF can keep it busy for hours, ask for more memory than there
is, or end the process. So a child compiles the model and places its bodies once, and the model comes back as
MuJoCo's binary: what ends the child is one sentence here. The child is a fork, which takes a few milliseconds, because
nothing is imported again. Forks are safe beside other threads on Linux only; elsewhere models are compiled in place.

The child stays for the next text, with limits of its own for each, since a fork of a large process takes longer than
a small model. MuJoCo keeps meshes that it has read, which are nearly all of the work of a model with files: so such a
model is asked of a child that has some of them, or of a new one, to which a fork gives them without a copy.
"""

from __future__ import annotations

import atexit
import faulthandler
import math
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Pipe
from typing import Any, NoReturn

from planner.base.arguments import short_repr
from planner.base.errors import ModelError
from planner.base.gl import load_mujoco

SECONDS = 10  # of the child's processor time, for each text
MEMORY = 2 * 2**30  # bytes, beside those of this process
IDLE = 60.0  # s after which a child that nobody asks ends
_LONGEST_WAIT = 3.0 * SECONDS  # of the clock: other work may keep the processor from the child
_PLACE = "/proc/self/fd/{}"  # MuJoCo reads and writes models under a name
_forking = threading.Lock()  # the filters of warnings are of the process, not of a thread
_kept: list[_Child] = []  # one at most: the child that compiled last, while nobody asks it


def compile_in_subprocess(text: str, assets: dict[str, bytes], name: str) -> Any:
    """MuJoCo's MjModel of an MJCF text and its files; a message calls it `name`.

    Raises:
        ModelError: MuJoCo refuses it, or takes too long, or needs too much memory, or breaks down.
    """
    load_mujoco()
    if sys.platform != "linux":
        return _compile(text, assets, name)
    child = _taken(assets) or _Child(assets)
    try:
        return _asked(child, text, assets, name)
    except EOFError:
        ended_by = child.close()
    if ended_by in (signal.SIGKILL, signal.SIGXCPU):
        raise ModelError(f"MuJoCo takes more than {SECONDS} s to compile {name}, expected a smaller model.")
    raise ModelError(
        f"MuJoCo's compiler breaks down at {name} (signal {ended_by}), expected a model without its cause."
    )


def _taken(assets: dict[str, bytes]) -> _Child | None:
    """The child that was kept, if it has some of these files, or none are needed."""
    with suppress(IndexError):  # none is kept, or another thread was first
        child = _kept.pop()
        if child.knows(assets):
            return child
        child.close()
    return None


def _asked(child: _Child, text: str, assets: dict[str, bytes], name: str) -> Any:
    """A child's model; the child is kept for the next text, and closed where this one failed.

    Raises:
        EOFError: It gave no answer; it is closed, and how it ended is known.
        ModelError: What it says against the text.
    """
    keep = False
    try:
        model = child.compile(text, assets, name)
        keep = True
        return model
    finally:
        if keep and not _kept:
            _kept.append(child)
        else:
            child.close()


@atexit.register
def _close_kept() -> None:
    while _kept:
        _kept.pop().close()


class _Child:
    """A fork of this process that compiles one text after another; it has the files that were there when it began."""

    def __init__(self, assets: dict[str, bytes]) -> None:
        self._files = {id(content): content for content in assets.values()}  # kept, so that no other gets its number
        self._parent, self._status, self._asked = os.getpid(), 0, time.monotonic()
        with _streams_taken():
            self._connection, theirs = Pipe()
            self._model = os.memfd_create("model")
        with _forking, warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of the threads that the child does not have
            self._pid = os.fork()
        if self._pid == 0:
            _serve(theirs, self._model, self._files)
        theirs.close()

    def knows(self, assets: dict[str, bytes]) -> bool:
        """Whether it is a child of this process that waits to be asked and has some of these files, if any."""
        if self._parent != os.getpid() or time.monotonic() - self._asked > 0.5 * IDLE:
            return False
        known = not assets or any(id(content) in self._files for content in assets.values())
        return known and os.waitid(os.P_PID, self._pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None

    def compile(self, text: str, assets: dict[str, bytes], name: str) -> Any:
        """The model of a text; see _asked."""
        new = {id(content): content for content in assets.values() if id(content) not in self._files}
        try:
            self._connection.send((text, {file: id(content) for file, content in assets.items()}, new, name))
            self._files |= new
            if not self._connection.poll(_LONGEST_WAIT):
                raise EOFError
            refused, self._asked = self._connection.recv(), time.monotonic()
        except OSError as error:  # it has ended already
            raise EOFError from error
        if refused:
            raise ModelError(refused)
        try:
            return load_mujoco().MjModel.from_binary_path(_PLACE.format(self._model))
        except ValueError:  # a limit of the sizes of files cut it off; it compiles within the others
            return _compile(text, assets, name)
        finally:
            os.ftruncate(self._model, 0)  # its memory

    def close(self) -> int:
        """End it, if it has not ended by itself; returns the signal that did."""
        if self._connection.closed:
            return self._status
        self._connection.close()
        os.close(self._model)
        if self._parent == os.getpid():
            ended, status = os.waitpid(self._pid, os.WNOHANG)
            if not ended:
                os.kill(self._pid, signal.SIGKILL)
                status = os.waitpid(self._pid, 0)[1]
            self._status = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        return self._status


@contextmanager
def _streams_taken() -> Iterator[None]:
    """A context in which what is opened takes no place of a standard stream that is closed: the child prints there."""
    taken = [os.open(os.devnull, os.O_RDWR)]
    while taken[-1] <= 2:
        taken.append(os.open(os.devnull, os.O_RDWR))
    try:
        yield
    finally:
        for descriptor in taken:
            os.close(descriptor)


def _serve(requests: Any, model: int, files: dict[int, bytes]) -> NoReturn:
    """Compile in this child, text by text, until nobody asks any more."""
    import resource  # of POSIX only

    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's, who ends this child if it is busy
        for kill in (signal.SIGTERM, signal.SIGHUP):
            signal.signal(kill, signal.SIG_DFL)
        faulthandler.disable()
        nothing = os.open(os.devnull, os.O_RDWR)
        for descriptor in map(int, os.listdir("/proc/self/fd")):  # what others hold must not stay open for this child
            if descriptor <= 2:  # C++ prints there why it ends
                os.dup2(nothing, descriptor)
            elif descriptor not in (nothing, model, requests.fileno()):
                with suppress(OSError):  # that of the list itself
                    os.close(descriptor)
        _limit(resource.RLIMIT_CORE, 0)
        while requests.poll(IDLE):
            text, names, new, name = requests.recv()
            files |= new
            with open("/proc/self/statm") as sizes:
                now = int(sizes.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            _limit(resource.RLIMIT_AS, now + MEMORY)
            _limit(resource.RLIMIT_CPU, math.ceil(time.process_time()) + SECONDS)
            requests.send(_answer(text, {file: files[number] for file, number in names.items()}, name, model))
    finally:
        os._exit(0)


def _answer(text: str, assets: dict[str, bytes], name: str, place: int) -> str:
    """Compile a text and write its model; returns why not, or ""."""
    try:
        model = _compile(text, assets, name)
        _place(model, name)
        load_mujoco().mj_saveModel(model, _PLACE.format(place), None)
    except ModelError as error:
        return str(error)
    except MemoryError:
        return f"MuJoCo needs more than {MEMORY / 2**30:g} GB for {name}, expected a smaller model."
    return ""


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
            raise ModelError(
                f"{name} has an element named {short_repr(text)}, expected a name of printable characters."
            )


def _reason(error: Exception) -> str:
    reason = " ".join(str(error).split()) or "it does not say why"
    if "unknown exception" in reason or "allocate memory" in reason:
        reason = f"it asks for more than {MEMORY / 2**30:g} GB, or than there is ({reason.rstrip('.!')})"
    return reason if reason.endswith((".", "!", "?")) else f"{reason}."
