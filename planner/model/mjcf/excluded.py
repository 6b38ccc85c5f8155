"""Bodies of a model that are not to touch each other, said beside its file: `exclude = [["palm", "thumb"]]`.

They are part of the model for planning, replay and film, in any format; the verdict names them. Shapes of a file often
overlap where the real robot's do not.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any
from xml.etree.ElementTree import SubElement

from planner.base.arguments import did_you_mean, short_repr
from planner.base.errors import ModelError, PlannerError
from planner.model.mjcf.model_file import ModelFile
from planner.model.mjcf.model_index import NEVER_REPLAYED, ModelIndex, compile_model

BodyPair = tuple[str, str]


def excluded_pairs(value: Any) -> tuple[BodyPair, ...]:
    """Pairs of names from a list of them; none for None.

    Raises:
        PlannerError: It is no list of pairs of two names.
    """
    pairs = [] if value is None else value
    if not isinstance(pairs, list | tuple) or not all(
        isinstance(pair, list | tuple) and len(pair) == 2 and all(isinstance(name, str) and name for name in pair)
        and pair[0] != pair[1] for pair in pairs
    ):  # fmt: skip
        raise PlannerError(
            f'exclude is {short_repr(value)}, expected a list of pairs of two bodies or shapes: [["palm", "thumb"]].'
        )
    return tuple((str(first), str(second)) for first, second in pairs)


def with_excluded(file: ModelFile, given: Sequence[BodyPair]) -> ModelFile:
    """A file in which the bodies of each pair do not touch, compiled again; a shape stands for its body.

    Raises:
        ModelError: A name that the model does not have, two shapes of one body, or a shape of a body without a name.
    """
    if not given:
        return file
    root, model = copy.deepcopy(file.root), file.survey.model
    bodies = {model.body(i).name: i for i in range(model.nbody)}
    shapes = {model.geom(i).name: int(model.geom_bodyid[i]) for i in range(model.ngeom)}
    places = {name: place for name, place in (shapes | bodies).items() if name}
    section, texts = SubElement(root, "contact"), SubElement(root, "custom")
    for k, pair in enumerate(given, 1):
        for name in pair:
            if name not in places:
                hint = did_you_mean(name, list(places))
                raise ModelError(f"exclude names {name!r}, expected a body or a shape of {file.name}.{hint}")
        first, second = (model.body(places[name]).name for name in pair)
        if not (first and second):
            raise ModelError(
                f"exclude names {pair[0]!r} and {pair[1]!r}, of a body without a name: expected one with it."
            )
        if first == second:
            raise ModelError(f"exclude names {pair[0]!r} and {pair[1]!r}, which belong to one body: they never touch.")
        SubElement(section, "exclude", {"body1": first, "body2": second})
        phrase = f"contact of {first} and {second}, which `exclude` names"
        SubElement(texts, "text", {"name": f"{NEVER_REPLAYED}exclude {k}", "data": phrase})
    survey = ModelIndex(compile_model(root, file.files, file.name))
    return file._replace(root=root, survey=survey, is_compiled=True)
