"""CompiledTwin: a twin and the MuJoCo model of its text, compiled once for all steps of a proof.

Steps, integrators and flags are options of the compiled model, so each use sets them on a copy of its own. Also lists
elements of the user's file that a problem's model lacks, for the headline of a proof.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.capabilities import capabilities_of
from planner.model.mechanism import Mechanism
from planner.model.mjcf.contacts import contact_refusals
from planner.model.mjcf.equalities import set_hard
from planner.model.mjcf.model_file import mjcf_source
from planner.model.mjcf.model_index import ModelIndex, compile_model
from planner.model.mjcf.prescribed_joints import prescribed_twin
from planner.model.mjcf.text import is_text, model_tree
from planner.model.mjcf.unmodelled_features import UnmodelledFeatures, unmodelled_features
from planner.model.mjcf.unsupported import modelled, take_out, unsupported_elements
from planner.model.twin import URDF_KEYS, Twin
from planner.model.urdf.write import as_mjcf, is_urdf
from planner.problem.problem import Problem
from planner.proof.replays.simulation import NATIVE_IMPLICIT, ROSENBROCK


class CompiledTwin:
    """A twin whose model is compiled from its text on first use and cached."""

    def __init__(self, twin: Twin, unused: Collection[int] = ()) -> None:
        self.twin = twin  # the text and the maps between its state and the plan's
        self.unused = frozenset(unused)  # actuators that the plan does not have: their controls stay 0
        self.is_changed = False  # the model was modified after compilation

    def __getstate__(self) -> dict[str, Any]:
        """The attributes without a model that can be compiled again from the text."""
        return {name: part for name, part in vars(self).items() if name != "model" or self.is_changed}

    @cached_property
    def model(self) -> Any:
        """MuJoCo's model, read-only; modify a copy() instead."""
        model = compile_model(self.twin.mjcf, self.twin.assets)
        kinds = load_mujoco().mjtDyn  # the same equation, whose exact variant MuJoCo's RK4 integrates wrongly
        exact = model.actuator_dyntype == int(kinds.mjDYN_FILTEREXACT)
        if np.any(exact):
            model = copy.copy(model)
            model.actuator_dyntype[exact] = int(kinds.mjDYN_FILTER)
        return model

    def check(self, nu: int) -> None:
        """Raise ModelError unless the model has the twin's states, and nu controls."""
        model, nw = self.model, self.twin.to_x.shape[1]
        have = (model.nq + model.nv + model.na, len(self.controls))
        if have != (nw, nu):
            raise ModelError(
                f"the model has nq + nv + na = {have[0]} states and {have[1]} controls, expected {nw} and {nu}: "
                "it is not the machine that the plan was made for."
            )

    @cached_property
    def controls(self) -> np.ndarray:
        """(nu,) indices of the plan's controls in MuJoCo's ctrl."""
        return np.array([i for i in range(self.model.nu) if i not in self.unused], dtype=np.int64)

    def commands(self, us: np.ndarray) -> np.ndarray:
        """MuJoCo's ctrl (..., model.nu) of a plan's controls (..., nu)."""
        if not self.unused:
            return us
        ctrl = np.zeros((*us.shape[:-1], self.model.nu))
        ctrl[..., self.controls] = us
        return ctrl

    def copy(self) -> Any:
        """A copy of the model that the caller may modify."""
        return copy.copy(self.model)

    def changed(self, change: Callable[[Any], object]) -> CompiledTwin:
        """The same twin with a model modified by `change`."""
        other, model = CompiledTwin(self.twin, self.unused), self.copy()
        change(model)
        other.__dict__["model"] = model  # the cached property's attribute
        other.is_changed = True
        return other

    def stepping(self, timestep: float, integrator: str = "RK4") -> Any:
        """A copy with MuJoCo's step `timestep`, s, and one of its integrators, without reset on divergence.

        For a plan with implicit damping, MuJoCo's own steps are IMPLICITFAST.
        """
        mujoco, model = load_mujoco(), self.copy()
        model.opt.timestep = timestep
        set_hard(model, timestep)
        model.opt.integrator = getattr(
            mujoco.mjtIntegrator, f"mjINT_{NATIVE_IMPLICIT if integrator == ROSENBROCK else integrator}"
        )
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # else MuJoCo resets a diverged state
        return model


def with_model(twin: Twin, mjcf: Any) -> Twin:
    """A twin with another MJCF or URDF, a path, text or spec, in place of its own; with its own for None."""
    if mjcf is None:
        return twin
    if is_urdf(mjcf):
        text, files, _ = as_mjcf(mjcf, **{key: twin.origin[key] for key in URDF_KEYS if key in twin.origin})
        return replace(twin, mjcf=text, assets=files)
    mjcf, files = mjcf_source(mjcf, twin.assets if is_text(mjcf) else None)  # a path brings its own meshes
    root, files = model_tree(mjcf, files)
    return replace(twin, mjcf=ElementTree.tostring(root, encoding="unicode"), assets=files)


def another_model(problem: Problem, twin: Twin, mjcf: Any) -> CompiledTwin:
    """A twin with another MJCF, a path, text or spec; the twin itself for None.

    A plan made with contacts="off" or ignore=(...) is proved without these elements. Its prescribed joints have motors
    in the other model too.
    """
    compiled = CompiledTwin(with_model(twin, mjcf))
    mechanism = capabilities_of(problem.dynamics).mechanism
    if mjcf is None or mechanism is None:
        return compiled
    compiled = _without(mechanism, compiled)
    prescribed = getattr(problem.dynamics, "prescribed", ())
    driven = prescribed_twin(compiled.twin, compiled.model, mechanism, prescribed) if prescribed else compiled.twin
    return compiled if driven is compiled.twin else CompiledTwin(driven)


def _without(mechanism: Mechanism, compiled: CompiledTwin) -> CompiledTwin:
    """The twin without the elements removed from the mechanism's file."""
    if not mechanism.original:
        return compiled
    survey = ModelIndex(compiled.model)
    found = [*unsupported_elements(survey.model), *modelled(survey.model), *contact_refusals(survey, all_of_them=True)]
    lacks = unmodelled_features(mechanism.original, mechanism.mjcf, mechanism.assets).kinds
    kinds = lacks & {one.kind for one in found}
    if not kinds:
        return compiled
    root = ElementTree.fromstring(compiled.twin.mjcf)
    take_out(root, [one for one in found if one.kind in kinds], survey.model)
    return CompiledTwin(replace(compiled.twin, mjcf=ElementTree.tostring(root, encoding="unicode")))


_found: WeakKeyDictionary[Problem, UnmodelledFeatures] = WeakKeyDictionary()


def left_out(problem: Problem, compiled: CompiledTwin | None = None) -> tuple[str, ...]:
    """Short phrases for elements of the user's file that a problem's model lacks: "contacts of 1 pair", "1 equality".

    Ranges and clamps are not included: the steps of a proof report where a trajectory reaches one.

    Args:
        problem: With a twin; without one the result is empty.
        compiled: Its twin, or the twin in the user's file, if already compiled.

    Raises:
        ModelError: MuJoCo refuses one of the two texts.
    """
    return unmodelled_of(problem, compiled).phrases


def unmodelled_of(problem: Problem, compiled: CompiledTwin | None = None) -> UnmodelledFeatures:
    """All elements of the user's file that a problem's model lacks; of dynamics without a mechanism, the twin lacks."""
    twin, machine = problem.twin, capabilities_of(problem.dynamics)
    if twin is None:
        return UnmodelledFeatures()
    if problem not in _found:
        model = compiled.model if compiled is not None and compiled.twin.mjcf == twin.mjcf else None
        given = compiled.model if compiled is not None and compiled.twin.mjcf == twin.original else None
        # The text before motors were added to prescribed joints: those edits remove no moving element.
        contacts = machine.contacts or machine.mechanism is None
        _found[problem] = unmodelled_features(
            twin.original, twin.planned, twin.assets, contacts, model, twin.sim_of(problem.x0), given
        )
    return _found[problem]
