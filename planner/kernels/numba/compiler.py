"""Numba's compiler and cache as kernels need them. This file alone builds on Numba's internals (see `jit`)."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import os
import pickle
import sys
import uuid
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
from llvmlite.binding import parse_assembly, parse_bitcode
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, CompileResult
from numba.core.compiler_machinery import PassManager
from numba.core.serialize import dumps
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

njit: Any = numba.njit


@cache
def _content(path: str) -> str:
    """Digest of a source file, wherever it lies and whenever it was written."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


class _LoadedLibrary(JITCodeLibrary):
    """A kernel's library from a file. Its bitcode takes longer to read than its machine code: where it is needed."""

    bitcode: bytes

    def _get_module_for_linking(self) -> Any:
        """What another kernel that calls this one links."""
        if self._shared_module is None:
            self._shared_module = parse_bitcode(self.bitcode)
        return self._shared_module


def _names_only(module: Any) -> bytes:
    """Bitcode that defines what a module defines, by name alone: all that is asked of a module with machine code."""
    defined = [one.name for one in (*module.functions, *module.global_variables) if not one.is_declaration]
    return parse_assembly("\n".join(f'@"{name}" = global i8 0' for name in defined)).as_bitcode()


class Cache:
    """A kernel's machine code on disk: a file for each signature, found by content alone.

    Numba's own cache has one index for all signatures of a function, which two processes must not write at once, and
    finds it by the place and the time of the source. A file here begins with the digest of the rest: one that is
    damaged is compiled again.
    """

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        self._folder, self._name = folder, f"{function.__module__}.{function.__qualname__}"
        self._source = inspect.getfile(function)

    @property
    def cache_path(self) -> str:
        """The folder of the files."""
        return str(self._folder)

    def flush(self) -> None:
        """Delete all that is kept of the kernel."""
        for path in self._folder.glob(f"{self._name}-*.nbc"):
            path.unlink(missing_ok=True)

    def _path(self, sig: Any, codegen: Any) -> Path:
        key = str(sig), codegen.magic_tuple(), sys.implementation.cache_tag, _content(self._source)
        return self._folder / f"{self._name}-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.nbc"

    def _kept(self, sig: Any, target_context: Any) -> bytes | None:
        try:
            data = self._path(sig, target_context.codegen()).read_bytes()
        except OSError:
            return None
        return data[32:] if hashlib.sha256(data[32:]).digest() == data[:32] else None

    def holds(self, sig: Any, target_context: Any) -> bool:
        """Whether there is machine code for arguments of these types."""
        return self._kept(sig, target_context) is not None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel, loaded without all that Numba needs to compile; None where there is none."""
        kept = self._kept(sig, target_context)
        if kept is None:
            return None
        names, (name, kind, (code, bitcode)), *facts = pickle.loads(kept)
        loaded = CompileResult._rebuild(target_context, (name, kind, (code, names)), *facts)
        loaded.library.__class__ = _LoadedLibrary
        loaded.library.bitcode, loaded.library._shared_module = bitcode, None
        return loaded

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel, if the disk has room for it."""
        if data.library.has_dynamic_globals:
            return
        names = _names_only(data.library._get_module_for_linking())
        path, payload = self._path(sig, data.codegen), dumps((names, *data._reduce()))
        temporary = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
        with contextlib.suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
            try:
                temporary.write_bytes(hashlib.sha256(payload).digest() + payload)
                os.replace(temporary, path)
            finally:
                temporary.unlink(missing_ok=True)


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


class _PartLibrary(JITCodeLibrary):
    """Code that is optimized and turned into machine code only as a part of the kernels that link it."""

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


def compile_kernel(function: Callable[..., Any], folder: Path, **options: Any) -> Any:
    """A kernel whose machine code is kept in a folder. It counts no references (_nrt): it makes no arrays."""
    kernel = njit(pipeline_class=_Compiler, _nrt=False, no_cfunc_wrapper=True, **options)(function)
    kernel._cache = Cache(function, folder)
    return kernel


def compile_part(function: Callable[..., Any], **options: Any) -> Any:
    """A function that is compiled into each kernel that calls it."""
    wrappers = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return njit(pipeline_class=_PartCompiler, _nrt=False, **wrappers, **options)(function)
