"""How kernels are compiled and where the machine code is kept.

Numba stamps a cache entry with the file of the function itself only: editing a kernel's callee would leave stale
callers. So the cache directory is keyed on a hash of all kernel sources. Floating point is relaxed by `contract,
nsz, arcp` only: results are reproducible, and a NaN survives to be seen.
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
from numba import njit
from numba.core import config as numba_config
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder

config: Any = numba_config

_TEMPORARY = "slq-planner-"
FASTMATH = frozenset({"contract", "nsz", "arcp"})


@cache
def cache_directory() -> Path:
    """Where compiled kernels live: under NUMBA_CACHE_DIR or the user's cache, else a temporary directory."""
    digest = hashlib.sha256(f"{numba.__version__}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
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


def is_warm(kernel: Callable[..., Any]) -> bool:
    """Whether machine code of `kernel` is at hand, in this process or in the cache."""
    if getattr(kernel, "signatures", ()):
        return True
    module: str = kernel.__module__.rpartition(".")[2]
    return any(cache_directory().rglob(f"{module}.{kernel.__name__}-*.nbc"))


def _compile(function: Callable[..., Any], **options: Any) -> Any:
    # Only our own functions may land in our directory: numba reads the setting when it decorates.
    previous = config.CACHE_DIR
    config.CACHE_DIR = str(cache_directory())
    try:
        return njit(cache=True, nogil=True, fastmath=set(FASTMATH), error_model="numpy", **options)(function)
    finally:
        config.CACHE_DIR = previous


class _PartLibrary(JITCodeLibrary):
    """Code that is optimised and turned into machine code only as a part of the kernels that link it."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    @property
    def codegen(self) -> Any:
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Nothing here is known to the execution engine."""


class _PartCompiler(CompilerBase):
    def define_pipelines(self) -> list[Any]:
        self.state.library = _PartLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        return [DefaultPassBuilder.define_nopython_pipeline(self.state)]


def _compile_part(function: Callable[..., Any], **options: Any) -> Any:
    wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(
        nogil=True, fastmath=set(FASTMATH), error_model="numpy", pipeline_class=_PartCompiler, **wrappers, **options
    )(function)


def jit(function: Callable[..., Any]) -> Any:
    """Compile a kernel, cached on disk."""
    return _compile(function)


def part(function: Callable[..., Any]) -> Any:
    """Compile a function that only kernels call, into each of them."""
    return _compile_part(function)


def inline(function: Callable[..., Any]) -> Any:
    """Compile a helper that must be inlined into kernels (calls spill every vector register)."""
    return _compile_part(function, forceinline=True)


_log = logging.getLogger("planner")
_announced = False


def announce(kernel: Callable[..., Any]) -> None:
    """Say once that something is about to be compiled, if `kernel` is: the first run takes its time."""
    global _announced
    if not _announced and not is_warm(kernel):
        _announced = True
        _log.warning("compiling the numerical core (first run only, up to a minute)")
