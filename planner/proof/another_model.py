"""Another MJCF in place of a plan's own: without what the plan's mechanism took out of its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

from planner.model.mechanism import Mechanism
from planner.model.mjcf.contacts import contact_refusals
from planner.model.mjcf.driven import as_driven
from planner.model.mjcf.edit import take_out
from planner.model.mjcf.refuse import unmodelled
from planner.model.mjcf.survey import Survey
from planner.model.mjcf.text import is_text, model_tree
from planner.model.twin import Twin
from planner.problem.problem import Problem
from planner.proof.compiled_twin import CompiledTwin


def with_model(twin: Twin, mjcf: str | Path | None) -> Twin:
    """A twin with another MJCF, a path or the XML text, in place of its own; with its own for None."""
    if mjcf is None:
        return twin
    root, files = model_tree(mjcf, twin.assets if is_text(mjcf) else None)  # a path brings its own meshes
    return replace(twin, mjcf=ElementTree.tostring(root, encoding="unicode"), assets=files)


def another_model(problem: Problem, twin: Twin, mjcf: str | Path | None) -> CompiledTwin:
    """A twin with another MJCF, a path or the XML text; the twin itself for None.

    A plan that was made with contacts="off" or ignore=(...) is proved without them: that is the machine it is of. Its
    prescribed joints are driven in the other model too.
    """
    compiled = CompiledTwin(with_model(twin, mjcf))
    mechanism = getattr(problem.dynamics, "mechanism", None)
    if mjcf is None or not isinstance(mechanism, Mechanism):
        return compiled
    compiled = _without(mechanism, compiled)
    prescribed = getattr(problem.dynamics, "prescribed", ())
    driven = as_driven(compiled.twin, compiled.model, mechanism, prescribed) if prescribed else compiled.twin
    return compiled if driven is compiled.twin else CompiledTwin(driven)


def _without(mechanism: Mechanism, compiled: CompiledTwin) -> CompiledTwin:
    """The twin without what the mechanism's file had and the mechanism has not."""
    if not mechanism.ignored:
        return compiled
    survey, ignored = Survey(compiled.model), mechanism.ignored
    found = [*unmodelled(survey.model), *contact_refusals(survey, all_of_them=True)]
    kinds = {one.kind for one in found if one.phrase in ignored or one.kind in ignored}
    if not kinds:
        return compiled
    root = ElementTree.fromstring(compiled.twin.mjcf)
    take_out(root, [one for one in found if one.kind in kinds], survey.model)
    return CompiledTwin(replace(compiled.twin, mjcf=ElementTree.tostring(root, encoding="unicode")))
