"""What is compiled for whom, and how machine code is found again: one file a signature, variants by type."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from contact_machines import leg, standing
from numba.core.errors import NumbaError, TypingError
from trees import chain

import planner
from planner.dynamics import RigidBodyDynamics
from planner.kernels import precompile
from planner.kernels.numba import jit
from planner.model.mechanism import Mechanism


def stopped(x, touching):
    """A kernel in two variants."""
    if touching is not None:
        return 2.0 * x
    return x


@pytest.fixture
def kernel(monkeypatch, tmp_path):
    """`stopped`, never compiled before, and another of the same file that a second process would have."""
    monkeypatch.setattr(jit, "cache_directory", lambda: tmp_path)
    return jit.jit(stopped), jit.jit(stopped)


def test_variants_are_kept_apart_and_found_again(kernel):
    first, second = kernel
    plain, touching = ("float64", "none"), ("float64", "boolean")
    assert not jit.is_warm(first)
    assert not jit.is_warm(first, plain)
    assert first(3.0, None) == 3.0
    assert jit.is_warm(first)
    for known in (first, second):  # the second by what is on disk
        assert jit.is_warm(known, plain)
        assert not jit.is_warm(known, touching)
    assert first(3.0, True) == 6.0
    assert jit.is_warm(second, touching)
    results = second(3.0, True), second(3.0, None)
    assert results == (6.0, 3.0)
    assert len(list(jit.cache_directory().rglob("*.nbc"))) == 2


def inner(x):
    """A kernel that another one calls."""
    return x + 1.0


def test_a_kernel_from_disk_is_linked_into_another(monkeypatch, tmp_path):
    """Its bitcode is read then, and not before."""
    monkeypatch.setattr(jit, "cache_directory", lambda: tmp_path)
    assert jit.jit(inner)(1.0) == 2.0
    kept = jit.jit(inner)
    assert kept(1.0) == 2.0
    (loaded,) = kept.overloads.values()
    assert loaded.library._shared_module is None

    def outer(x):
        return 3.0 * kept(x)

    assert jit.jit(outer)(1.0) == 6.0
    assert loaded.library._shared_module is not None


def unknown_to_numba(x):
    """What cannot be compiled."""
    return eval(f"{x}")


def pruned(x, touching):
    """Half of it cannot be compiled."""
    return x if touching is None else unknown_to_numba(x)


def test_what_is_left_out_is_not_even_looked_at(monkeypatch, tmp_path):
    monkeypatch.setattr(jit, "cache_directory", lambda: tmp_path)
    kernel = jit.jit(pruned)
    assert kernel(3.0, None) == 3.0
    with pytest.raises(TypingError):
        kernel(3.0, True)


@pytest.mark.parametrize("touches", [False, True])
def test_a_machine_calls_the_variants_that_are_compiled_ahead(touches):
    """With other types, a kernel would be compiled twice: ahead, and again when it is called."""
    mechanism = Mechanism.from_mjcf(leg() if touches else chain(("hinge",), ("hinge",)))
    for integrator in ("rk4", "semi-implicit-euler"):
        prescribed = () if touches else mechanism.joint_names[:1]
        dynamics = RigidBodyDynamics(mechanism, 1e-3, integrator, prescribed)
        assert all(name.endswith("external") == touches for name in dynamics.kernels)
        xs = np.stack([standing(mechanism) if touches else mechanism.home] * 3)
        us = np.zeros((2, dynamics.nu))
        names = {"tree steps", "tree rates", "tree structured" if dynamics.structured else "tree dense"}
        before = {name: set(precompile.KERNELS[name][0].overloads) for name in names}
        dynamics.step(xs[:2], us)
        dynamics.rates(xs[:2], us)
        dynamics.linearize(xs, us)
        for name in names:
            kernel, types = precompile.KERNELS[f"{name} external" if touches else name]
            assert set(kernel.overloads) - before[name] <= {jit.arguments_of(types)}
            assert jit.is_warm(kernel, types)


def made_up(count):
    """A kernel that takes memory of its own."""
    return np.zeros(count)


def test_a_kernel_cannot_allocate(monkeypatch, tmp_path):
    monkeypatch.setattr(jit, "cache_directory", lambda: tmp_path)
    with pytest.raises(NumbaError):
        jit.jit(made_up)(3)


def test_every_kernel_has_a_process_that_compiles_it():
    families = [name for family in precompile._FAMILIES for name in family]
    assert sorted(families) == sorted(precompile.KERNELS)
    assert set(precompile.SECOND_ORDER) <= set(families)


@pytest.mark.parametrize("damage", [lambda _: b"", lambda data: data[: len(data) // 2], lambda data: data[::-1]])
def test_a_damaged_file_is_compiled_again(kernel, damage):
    first, second = kernel
    assert first(3.0, None) == 3.0
    (file,) = jit.cache_directory().rglob("*.nbc")
    sound = file.read_bytes()
    file.write_bytes(damage(sound))
    assert not jit.is_warm(second, ("float64", "none"))
    assert second(3.0, None) == 3.0
    assert jit.is_warm(jit.jit(stopped), ("float64", "none"))


def test_a_part_is_inlined_or_not_whoever_calls_it_first(monkeypatch, tmp_path):
    """Numba hands `forceinline` down to what does not say itself: machine code would depend on who came first."""
    monkeypatch.setattr(jit, "cache_directory", lambda: tmp_path)
    called = jit.part(lambda x: 0.5 * x)
    inlined = jit.inline(lambda x: called(x) + 1.0)
    assert jit.jit(lambda x: inlined(x))(3.0) == 2.5
    for function, expected in ((called, False), (inlined, True)):
        (compiled,) = function.overloads.values()
        assert ("alwaysinline" in compiled.library.get_llvm_str()) == expected


def test_kernels_import_no_constant_from_outside():
    """It would be compiled into them, and the cache's folder is named by the sources in planner/kernels alone."""
    constant = re.compile(r"^from planner\.(?!kernels).*import .*\b[A-Z][A-Z_]+\b", re.MULTILINE)
    sources = (Path(planner.__file__).parent / "kernels").rglob("*.py")
    assert [path.name for path in sources if constant.search(path.read_text(encoding="utf-8"))] == []


def test_machine_code_for_another_processor_is_another_file(kernel):
    class Another:
        def magic_tuple(self):
            return "x86_64-unknown-linux-gnu", "another-processor", ""

    first, _ = kernel
    types = jit.arguments_of(("float64", "none"))
    assert first._cache._path(types, Another()) != first._cache._path(types, first.targetctx.codegen())
    assert first.targetctx.codegen().magic_tuple()[1:] != Another().magic_tuple()[1:]


RATES = """
import numpy as np
from planner.kernels.hopper import step
from planner.kernels.numba import jit
types = ("float64[::1]", "float64[:, ::1]", "float64[:, ::1]", "float64[:, ::1]")
print(jit.is_warm(step.rates, types), step.__file__)
step.rates(np.ones(3), np.ones((1, 3)), np.ones((1, 1)), np.ones((1, 3)))
"""


def run_python(code, folder, cache, **variables):
    """Output and messages of Python in a process of its own, with the package of a folder."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(cache), **variables}
    done = subprocess.run([sys.executable, "-c", code], env=environment, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def test_two_checkouts_share_what_is_compiled(tmp_path):
    package, cache = Path(planner.__file__).parent, tmp_path / "cache"
    for name, warm in (("one", "False"), ("other", "True")):
        folder = tmp_path / name
        shutil.copytree(package, folder / "planner", ignore=shutil.ignore_patterns("__pycache__", "mjcf"))
        output, _ = run_python(RATES, folder, cache)
        assert output.split() == [warm, str(folder / "planner/kernels/hopper/step.py")]
        assert len(list(cache.rglob("*.nbc"))) == 1


ALONE = """
from planner.kernels.precompile import KERNELS, compile_together, is_warm
compile_together(["tree inverse"])
print(is_warm(*KERNELS["tree inverse"]))
"""


@pytest.mark.slow
@pytest.mark.skipif((os.cpu_count() or 1) == 1, reason="one processor compiles kernels when they are called")
def test_a_kernel_that_alone_is_missing_is_compiled_too(tmp_path):
    output, _ = run_python(ALONE, Path(planner.__file__).parents[1], tmp_path)
    assert output.split() == ["True"]


UNKNOWN_NUMBA = """
import logging, sys
import numba
logging.basicConfig()
sys.modules["numba.core.compiler_machinery"] = None
import numpy as np
from planner.dynamics import HopperDynamics
from planner.kernels.numba import jit
xs, us = np.array([[0.5, -1.0, 0.6], [0.4, 0.0, 0.5]]), np.array([[2.0]])
dynamics = HopperDynamics(0.01)
print(dynamics.step(xs[:1], us).tobytes().hex(), dynamics.linearize(xs, us)[0].tobytes().hex())
print(len(list(jit.cache_directory().rglob("*.nbc"))))
"""


@pytest.mark.slow
def test_a_numba_with_other_internals(tmp_path):
    """Kernels are compiled by plain njit then, with one line said, and do the same."""
    results = [run_python(code, Path(planner.__file__).parents[1], tmp_path / name) for name, code in (
        ("plain", UNKNOWN_NUMBA), ("own", UNKNOWN_NUMBA.replace('sys.modules["numba', 'dict()["numba')),
    )]  # fmt: skip
    assert results[0][0] == results[1][0]
    said = [messages.count("by plain njit") for _, messages in results]
    assert said == [1, 0]


ANOTHER_FIRST = """
from planner.kernels.precompile import compile_these
compile_these(("tree derivatives", "tree dense external", "tree search external residuals"))
"""
HUMAN_STEP = """
import hashlib, planner
plan = planner.solve(planner.cases.human_step())
print(plan.cost, hashlib.sha256(b"".join(a.tobytes() for a in (plan.xs, plan.us, plan.K))).hexdigest())
"""


@pytest.mark.slow
def test_the_order_of_compiling_changes_no_bit_of_a_plan(tmp_path):
    """One cache is filled by a solve alone, the other after a kernel with parts in common."""
    folder = Path(planner.__file__).parents[1]
    run_python(ANOTHER_FIRST, folder, tmp_path / "ahead", PYTHONHASHSEED="1")
    ahead = run_python(HUMAN_STEP, folder, tmp_path / "ahead")[0]
    assert run_python(HUMAN_STEP, folder, tmp_path / "lazily", PYTHONHASHSEED="2")[0] == ahead
