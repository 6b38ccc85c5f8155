"""How kernels are compiled and where the machine code is kept.

Numba stamps a cache entry with the file of the function itself only: editing a kernel's callee would leave stale
callers. So the cache directory is keyed on a hash of all kernel sources, and two checkouts of the same sources share
it. Floating point is relaxed by `contract, nsz, arcp` only: results are reproducible, and a NaN survives to be seen.

`compiler` builds on Numba's internals. Where a version of Numba has others, kernels are compiled by plain njit: they
do the same, and take longer to compile.
"""

from __future__ import annotations

import atexit
import hashlib
import logging
import os
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import config as numba_config
from numba.core.sigutils import normalize_signature

config: Any = numba_config
njit: Any = numba.njit

_log = logging.getLogger("planner")
_TEMPORARY = "slq-planner-"
FASTMATH = ("contract", "nsz", "arcp")
_OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": set(FASTMATH), "error_model": "numpy"}


@cache
def cache_directory() -> Path:
    """Where compiled kernels live: under NUMBA_CACHE_DIR or the user's cache, else a temporary directory."""
    digest, kernels = hashlib.sha256(f"{numba.__version__}".encode()), Path(__file__).parents[1]
    for source in sorted(kernels.rglob("*.py")):
        digest.update(source.relative_to(kernels).as_posix().encode() + source.read_bytes())
    base = os.environ.get("NUMBA_CACHE_DIR") or os.path.join(
        os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "slq-planner"
    )
    directory = Path(base) / digest.hexdigest()[:16]
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError:  # a read-only home: compile for this process only, but do run
        directory = Path(tempfile.mkdtemp(prefix=_TEMPORARY))
        atexit.register(shutil.rmtree, directory, ignore_errors=True)
    return directory


def cache_is_shared() -> bool:
    """Whether other processes find what this one compiles."""
    return not cache_directory().name.startswith(_TEMPORARY)


@cache  # to parse them takes longer than an iteration of two joints
def arguments_of(types: tuple[str, ...]) -> tuple[Any, ...]:
    """The types that a kernel is called with, as the cache knows them: not by their text."""
    return normalize_signature(f"({', '.join(types)},)")[0]


def is_warm(kernel: Any, types: tuple[str, ...] | None = None) -> bool:
    """Whether machine code of a kernel for arguments of these types (None: any) is in this process or in the cache."""
    if types is not None and arguments_of(types) in kernel.overloads:
        return True
    if types is None or not hasattr(kernel._cache, "holds"):
        module: str = kernel.__module__.rpartition(".")[2]
        return bool(kernel.signatures) or any(cache_directory().rglob(f"*{module}.{kernel.__name__}-*.nbc"))
    return kernel._cache.holds(arguments_of(types), kernel.targetctx)


def _plain_kernel(function: Callable[..., Any], folder: Path, **options: Any) -> Any:
    previous, config.CACHE_DIR = config.CACHE_DIR, str(folder)  # numba reads it when the cache is made
    try:
        return njit(cache=True, **options)(function)
    finally:
        config.CACHE_DIR = previous


def _plain_part(function: Callable[..., Any], **options: Any) -> Any:
    return njit(**options)(function)


try:
    from planner.kernels.numba.compiler import compile_kernel as _compile_kernel
    from planner.kernels.numba.compiler import compile_part as _compile_part

    _compile_kernel(cache_is_shared, cache_directory(), **_OPTIONS)  # sets up all that may have changed, runs nothing
    _compile_part(cache_is_shared, **_OPTIONS)
except (ImportError, AttributeError, TypeError, LookupError, NameError) as _error:
    _log.warning("Numba %s is new to planner (%s): compiling kernels by plain njit", numba.__version__, _error)
    _compile_kernel, _compile_part = _plain_kernel, _plain_part


def jit(function: Callable[..., Any]) -> Any:
    """Compile a kernel, cached on disk."""
    return _compile_kernel(function, cache_directory(), **_OPTIONS)


def part(function: Callable[..., Any]) -> Any:
    """Compile a function that only kernels call, into each of them.

    Numba passes an option that is left out on from whichever caller comes first: the machine code would depend on the
    order of compiling. So a part says that it need not be inlined.
    """
    return _compile_part(function, **_OPTIONS, forceinline=False)


def inline(function: Callable[..., Any]) -> Any:
    """Compile a helper that must be inlined into kernels (calls spill every vector register)."""
    return _compile_part(function, **_OPTIONS, forceinline=True)


_announced = False


def announce(kernel: Callable[..., Any], types: tuple[str, ...] | None = None) -> None:
    """Say once that something is about to be compiled, if `kernel` is: the first run takes its time."""
    global _announced
    if not _announced and not is_warm(kernel, types):
        _announced = True
        _log.warning("compiling the numerical core (first run only, up to a minute)")
