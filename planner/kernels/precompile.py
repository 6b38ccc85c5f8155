"""Compiling several kernels at once on a cold start, each family of them in a process of its own.

Numba compiles one function at a time in a process; the cache on disk is shared. So what a problem needs is compiled by
as many processes as there are families, and this one then finds it in the cache. Kernels of a family have parts in
common, which its process compiles once.
"""

from __future__ import annotations

import functools
import gc
import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from planner.kernels.hopper import second as hopper_second
from planner.kernels.hopper import step as hopper
from planner.kernels.lq import active_set, bounded_riccati, quadratic, riccati, second_order, tracked_trajectory
from planner.kernels.numba.jit import announce, arguments_of, cache_is_shared, is_warm
from planner.kernels.tree import batch as tree_batch
from planner.kernels.tree import linearize as tree_linearize
from planner.kernels.tree import step as tree_step
from planner.kernels.tree import tree_line_search as tree_search
from planner.kernels.tree import tree_second_order as tree_second
from planner.kernels.tree.residuals import evaluate as residuals
from planner.kernels.tree.residuals import motor_work

if TYPE_CHECKING:
    from planner.kernels.tree.mechanism_table import Model

_TABLE, _ROWS, _BLOCKS = "int64[::1]", "float64[:, ::1]", "float64[:, :, ::1]"
_HOPPER = ("int64", "float64", "float64[::1]")
_SEARCH = (_ROWS, "int64", "boolean")

# Every kernel that takes seconds, by name, with the types that it is called with.
KERNELS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "riccati dense": (riccati.riccati_dense, (_TABLE, "float64", "float64")),
    "riccati structured": (riccati.riccati_structured, (_TABLE, "float64", "float64")),
    "riccati dense bounded": (bounded_riccati.riccati_dense_bounded, (_TABLE, "float64", "float64", "boolean")),
    "riccati structured bounded": (
        bounded_riccati.riccati_structured_bounded,
        (_TABLE, "float64", "float64", "boolean"),
    ),
    "choose active": (active_set.update_active_set, (_TABLE, "float64", "boolean")),
    "gradients": (quadratic.gradients, (_TABLE,)),
    "begin following": (tracked_trajectory.load_tracked, (_TABLE, _TABLE)),
    "keep followed": (tracked_trajectory.store_tracked, (_TABLE, _TABLE)),
    "costates": (second_order.costates, (_TABLE, "float64")),
    "tree second order": (
        tree_second.second_order,
        (_TABLE, _TABLE, _TABLE, "float64", _ROWS, _ROWS, _ROWS, _BLOCKS),
    ),
    "residuals": (residuals.quadratize_residuals, (_TABLE, _TABLE, _TABLE, _TABLE, "none")),
    "residuals solids": (residuals.quadratize_residuals, (_TABLE, _TABLE, _TABLE, _TABLE, "boolean")),
    "works": (motor_work.works, (_TABLE, _TABLE, _TABLE, _TABLE, _ROWS)),
    "tree derivatives": (tree_batch.derivatives, (_TABLE, _TABLE, *[_ROWS] * 3, *[_BLOCKS] * 3)),
    "tree forward": (tree_batch.forward, (_TABLE, _TABLE, *[_ROWS] * 5)),
    "tree inverse": (tree_batch.inverse, (_TABLE, _TABLE, *[_ROWS] * 4)),
    "hopper search": (hopper.search_step, (*_HOPPER, _TABLE, *_SEARCH)),
    "hopper linearize": (hopper.linearize_nominal, (*_HOPPER, _TABLE)),
    "hopper second order": (hopper_second.second_order, (*_HOPPER, _ROWS, _ROWS, _ROWS, _BLOCKS)),
}

# Kernels with a variant for machines with forces from outside the joints (contacts, stops, exponential torques,
# friction loss and the like), and one without the code of these (see Model.external).
_EXTERNAL_VARIANTS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "tree search": (tree_search.search_step, (_TABLE, _TABLE, _TABLE, *_SEARCH)),
    "tree structured": (
        tree_linearize.linearize_structured,
        (_TABLE, _TABLE, "float64", _ROWS, _ROWS, _BLOCKS, _BLOCKS),
    ),
    "tree dense": (tree_linearize.linearize_dense, (_TABLE, _TABLE, "float64", _ROWS, _ROWS, _BLOCKS)),
    "tree steps": (tree_step.steps, (_TABLE, _TABLE, "float64[::1]", _ROWS, _ROWS, _ROWS, "boolean")),
    "tree rates": (tree_step.rates, (_TABLE, _TABLE, _ROWS, _ROWS, _ROWS)),
}
for _name, (_kernel, _types) in _EXTERNAL_VARIANTS.items():
    KERNELS[_name] = (_kernel, (*_types, "none"))
    KERNELS[f"{_name} external"] = (_kernel, (*_types, "boolean"))
for _name in ("tree search", "tree search external"):  # the last arguments are the table of residuals, and solids
    _kernel, _types = KERNELS[_name]
    KERNELS[_name] = (_kernel, (*_types, "none", "none"))
    KERNELS[f"{_name} residuals"] = (_kernel, (*_types, _TABLE, "none"))
    KERNELS[f"{_name} residuals solids"] = (_kernel, (*_types, _TABLE, "boolean"))

# Kernels that have parts in common: one process compiles them, and the parts once.
_FAMILIES = (
    (
        "riccati dense", "riccati structured", "riccati dense bounded", "riccati structured bounded", "choose active",
        "gradients", "begin following", "keep followed",
    ),
    (
        "tree search", "tree search external", "tree search residuals", "tree search external residuals",
        "tree search residuals solids", "tree search external residuals solids",
        "tree steps", "tree steps external", "tree rates", "tree rates external", "tree forward", "tree inverse",
    ),
    ("tree structured", "tree structured external", "tree dense", "tree dense external", "tree derivatives"),
    ("hopper search", "hopper linearize"),
    ("tree second order", "costates"),
    ("residuals", "residuals solids", "works"),
    ("hopper second order",),
)  # fmt: skip

# What only `hessian="exact"` needs, a third of all there is to compile.
SECOND_ORDER = ("tree second order", "costates", "hopper second order")


def variant(name: str, model: Model, residuals: bool = False) -> str:
    """The name of the kernel that a model needs: of those that have variants, the one for what acts on it."""
    return name + (" external" if model.external else "") + (" residuals" if residuals else "")


@functools.cache  # a kernel that is compiled stays so, and single steps ask thousands of times
def announce_named(name: str) -> None:
    """Say once that something is about to be compiled, if this kernel is."""
    announce(*KERNELS[name])


def compile_these(names: Iterable[str]) -> None:
    """Compile kernels of KERNELS into the cache."""
    collecting = gc.isenabled()
    gc.disable()  # a tenth of the time, and nothing that Numba makes is garbage before it is done
    try:
        for name in names:
            kernel, types = KERNELS[name]
            kernel.compile(arguments_of(types))
    finally:
        if collecting:
            gc.enable()


def compile_together(names: Iterable[str]) -> None:
    """Have kernels compiled, all at once where the machine has the processors and the cache is on disk."""
    cold = {name for name in names if not is_warm(*KERNELS[name])}
    if not cold:
        return
    families = [[name for name in family if name in cold] for family in _FAMILIES if not cold.isdisjoint(family)]
    own, *others = families
    announce(*KERNELS[own[0]])
    if (os.cpu_count() or 1) == 1 or not cache_is_shared():
        return  # compiled one after the other, when they are called
    package = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([package, os.environ.get("PYTHONPATH", "")])}
    children: list[subprocess.Popen[bytes]] = []
    try:
        for family in others:
            code = f"from planner.kernels.precompile import compile_these; compile_these({family!r})"
            children.append(subprocess.Popen([sys.executable, "-c", code], env=environment, stderr=subprocess.DEVNULL))
        compile_these(own)
        for child in children:
            child.wait()  # what a child could not do is compiled here, when it is called
    finally:
        for child in children:
            child.kill()
