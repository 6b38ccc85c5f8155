"""Another MJCF in place of a plan's own: without what the plan's mechanism took out of its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

from planner.model.mechanism import Mechanism
from planner.model.mjcf.driven import as_driven
from planner.model.mjcf.edit import take_out
from planner.model.mjcf.refuse import found
from planner.model.twin import Twin
from planner.problem.problem import Problem
from planner.proof.replaying import compile_model, with_model


def another_model(problem: Problem, twin: Twin, mjcf: str | Path | None) -> Twin:
    """A twin with another MJCF, a path or the XML text; the twin itself for None.

    A plan that was made with contacts="off" or ignore=(...) is proved without them: that is the machine it is of. Its
    prescribed joints are driven in the other model too.

    Raises:
        ModelError: A file that cannot be read or that MuJoCo refuses.
    """
    if mjcf is None:
        return twin
    twin = with_model(twin, mjcf)
    mechanism = getattr(problem.dynamics, "mechanism", None)
    if not isinstance(mechanism, Mechanism):
        return twin
    return as_driven(_without(mechanism, twin), mechanism, getattr(problem.dynamics, "prescribed", ()))


def _without(mechanism: Mechanism, twin: Twin) -> Twin:
    """The twin without what the mechanism's file had and the mechanism has not."""
    if not mechanism.ignored:
        return twin
    model = compile_model(twin.mjcf, twin.assets)
    kinds = {one.kind for one in found(model) if one.phrase in mechanism.ignored or one.kind in mechanism.ignored}
    if not kinds:
        return twin
    root = ElementTree.fromstring(twin.mjcf)
    take_out(root, kinds, model)
    return replace(twin, mjcf=ElementTree.tostring(root, encoding="unicode"))
