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
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import config as numba_config
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager
from numba.core.sigutils import normalize_signature
from numba.core.typed_passes import (
    AnnotateTypes,
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.untyped_passes import (
    DeadBranchPrune,
    FixupArgs,
    GenericRewrites,
    IRProcessing,
    ReconstructSSA,
    TranslateByteCode,
)

config: Any = numba_config
njit: Any = numba.njit

_TEMPORARY = "slq-planner-"
FASTMATH = frozenset({"contract", "nsz", "arcp"})


@cache
def cache_directory() -> Path:
    """Where compiled kernels live: under NUMBA_CACHE_DIR or the user's cache, else a temporary directory."""
    digest = hashlib.sha256(f"{numba.__version__}".encode())
    for source in sorted(Path(__file__).parents[1].rglob("*.py")):
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


def arguments_of(types: Sequence[str]) -> tuple[Any, ...]:
    """The types that a kernel is called with, as the cache knows them: not by their text."""
    return normalize_signature(f"({', '.join(types)},)")[0]


def is_warm(kernel: Any, types: Sequence[str] | None = None) -> bool:
    """Whether machine code of `kernel` is at hand, in this process or in the cache.

    Args:
        kernel: What `jit` returned.
        types: Of its arguments, as in a Numba signature; None for any.
    """
    if types is None:
        module: str = kernel.__module__.rpartition(".")[2]
        return bool(kernel.signatures) or any(cache_directory().rglob(f"{module}.{kernel.__name__}-*.nbc"))
    arguments = arguments_of(types)
    return arguments in kernel.overloads or kernel._cache.holds(arguments, kernel.targetctx)


class _Cache(FunctionCache):
    """A kernel's machine code on disk: a file for each signature, loaded without all that Numba needs to compile.

    Numba's own cache has one index for all signatures of a function, which two processes must not write at once.
    """

    def _file(self, sig: Any) -> IndexDataCacheFile:
        digest = hashlib.sha256(str(sig).encode()).hexdigest()[:12]
        base, stamp = f"{self._impl.filename_base}-{digest}", self._impl.locator.get_source_stamp()
        return IndexDataCacheFile(self._cache_path, base, stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        data = self._file(sig).load(self._index_key(sig, target_context.codegen()))
        return None if data is None else self._impl.rebuild(target_context, data)

    def save_overload(self, sig: Any, data: Any) -> None:
        if self._impl.check_cachable(data):
            self._impl.locator.ensure_cache_path()
            self._file(sig).save(self._index_key(sig, data.codegen), self._impl.reduce(data))

    def holds(self, sig: Any, target_context: Any) -> bool:
        """Whether there is machine code for arguments of these types."""
        file = self._file(sig)
        name = file._load_index().get(self._index_key(sig, target_context.codegen()))
        return name is not None and os.path.isfile(file._data_path(name))


class _Compiler(CompilerBase):
    """Numba's compiler with the passes that kernels need: they have no closures, no array expressions, no `with`."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)  # everything that Numba knows is loaded here; look-ups need not load it again
        self.state.targetctx.load_additional_registries = lambda: None  # of a context that is this compiler's own

    def define_pipelines(self) -> list[Any]:
        passes = PassManager("kernel")
        for step in _PASSES:
            passes.add_pass(step, step.__name__)
        passes.finalize()
        return [passes]


# Branches are pruned by arguments that are None: that is how a kernel leaves out what a problem does not have.
_PASSES = (
    TranslateByteCode, FixupArgs, IRProcessing, DeadBranchPrune, GenericRewrites, ReconstructSSA,
    NopythonTypeInference, PreLowerStripPhis, IRLegalization, AnnotateTypes, NativeLowering, NoPythonBackend,
)  # fmt: skip


# Kernels and parts count no references (_nrt): they make no arrays.
_OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": set(FASTMATH), "error_model": "numpy", "_nrt": False}


def _compile(function: Callable[..., Any], **options: Any) -> Any:
    # Only our own functions may land in our directory: numba reads the setting when the cache is made.
    kernel = njit(**_OPTIONS, pipeline_class=_Compiler, no_cfunc_wrapper=True, **options)(function)
    previous = config.CACHE_DIR
    config.CACHE_DIR = str(cache_directory())
    try:
        kernel._cache = _Cache(function)  # what njit(cache=True) does, with ours
    finally:
        config.CACHE_DIR = previous
    return kernel


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


class _PartCompiler(_Compiler):
    def define_pipelines(self) -> list[Any]:
        self.state.library = _PartLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        return super().define_pipelines()


def _compile_part(function: Callable[..., Any], **options: Any) -> Any:
    wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(**_OPTIONS, pipeline_class=_PartCompiler, **wrappers, **options)(function)


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


def announce(kernel: Callable[..., Any], types: Sequence[str] | None = None) -> None:
    """Say once that something is about to be compiled, if `kernel` is: the first run takes its time."""
    global _announced
    if not _announced and not is_warm(kernel, types):
        _announced = True
        _log.warning("compiling the numerical core (first run only, up to a minute)")
