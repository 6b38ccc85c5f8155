"""Find what the text of a plan's mechanism lacks of the file that it was read from.

Two texts are compared as MuJoCo compiles them, so a plan that was just solved and the same plan from its file lack the
same: both have both texts.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.model.mjcf.contact_shapes import shape_of
from planner.model.mjcf.initial_overlaps import initial_overlaps
from planner.model.mjcf.model_index import EDITED, NEVER_REPLAYED, compile_model, contact_pairs, named, texts_of
from planner.model.mjcf.unsupported import UnsupportedElement, modelled, unsupported_elements

_OF = {"frictionloss": "friction loss", "gravcomp": "gravity compensation"}  # in words
_COUNTED = ("equality", "actuator", "mocap")  # the element is out, and not only something of it
_PLURALS = {"equality": "equalities", "body": "bodies", "mocap": "mocap bodies"}

MAX_NAMED = 3  # pairs in a phrase
_NUMBERED = re.compile(r"geom number \d+")

GeomName = tuple[str, int] | str
"""A geom by its name, or by its body and its place there: edits of a text keep both."""


@dataclass(frozen=True)
class UnmodelledFeatures:
    """What a plan's model lacks of the user's file.

    Attributes:
        elements: What is not modelled and was taken out, but for contacts.
        pairs: Pairs of geoms that may touch in the file alone, e.g. "geom 'arm' and geom 'wall'".
        known: The pairs that the plan's model has.
        overlaps: Pairs of the file alone that overlap at the start and their depths, e.g. "base and link1 (0.02 m)":
            see model.mjcf.initial_overlaps.
        overlap_count: How many of `pairs` these are; several geoms may share a name in `overlaps`.
        unreplayed: Phrases of the model itself about what no replay has.
        lost: What was taken out of a file that is not there, in the words of the edited text.
    """

    elements: tuple[UnsupportedElement, ...] = ()
    pairs: tuple[str, ...] = ()
    known: frozenset[frozenset[GeomName]] = frozenset()
    overlaps: tuple[str, ...] = ()
    overlap_count: int = 0
    unreplayed: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()

    @property
    def kinds(self) -> frozenset[str]:
        """The kinds of what was taken out, "contacts" only where all of them were."""
        contacts = {"contacts"} if self.pairs and not self.known else set()
        return frozenset({one.kind for one in self.elements} | contacts)

    @property
    def phrases(self) -> tuple[str, ...]:
        """Short phrases with counts: "contacts of 12 pairs", "friction loss of 2 joints", "1 equality"."""
        return (*self._counted(len(self.pairs)), *self.never_replayed)

    @property
    def in_the_file(self) -> tuple[str, ...]:
        """The phrases about what a replay in the file has: all but those of `never_replayed`."""
        return self._counted(len(self.pairs) - self.overlap_count)

    @property
    def never_replayed(self) -> tuple[str, ...]:
        """The phrases about what no replay has."""
        found = [f"{phrase}, of a file that is not in the plan" for phrase in self.lost]
        if self.overlaps:
            more = f" and {len(self.overlaps) - MAX_NAMED} more pairs" if len(self.overlaps) > MAX_NAMED else ""
            found.append(f"contact of {', '.join(self.overlaps[:MAX_NAMED])}{more}, which overlap at the start")
        return (*found, *self.unreplayed)

    def _counted(self, pairs: int) -> tuple[str, ...]:
        found = [f"contacts of {_counted(pairs, 'pair')}"] if pairs else []
        for (head, noun), number in Counter(map(_words, self.elements)).items():
            found.append(" of ".join(filter(None, (head, _counted(number, noun)))) if noun else head)
        return tuple(found)


def unmodelled_features(
    original: str, planned: str, assets: dict[str, bytes], contacts: bool = True, compiled: Any = None,
    start: np.ndarray | None = None, given: Any = None,
) -> UnmodelledFeatures:  # fmt: skip
    """Compare the text of a file as the user gave it with the text that a plan's mechanism was read from.

    `contacts` tells whether the mechanism has any; one may have none though its text has some. `compiled` is the
    model of a text that was not edited, where there is one already, and `given` that of the original; `start` is
    MuJoCo's state where the plan starts, of which qpos comes first.
    """
    own = compiled if compiled is not None and not original else compile_model(planned, assets)
    known = pairs_by_name(own) if contacts else {}
    if not original:
        given, elements = own, ()
    else:
        given = compile_model(original, assets) if given is None else given
        kept = set(modelled(own))
        elements = (*(one for one in modelled(given) if one not in kept), *unsupported_elements(given))
    pairs = pairs_by_name(given)
    unknown = [pair for key, pair in pairs.items() if key not in known]
    names = tuple(" and ".join(named(given, "geom", geom) for geom in pair) for pair in unknown)
    overlaps: dict[str, float] = {}
    count = 0
    if start is not None and unknown and len(start) >= given.nq == own.nq:
        for pair, depth in initial_overlaps(given, start[: given.nq]).items():
            if names_of(given, pair) not in known:
                shapes = " and ".join(_shape(given, geom) for geom in sorted(pair))
                overlaps[shapes], count = max(depth, overlaps.get(shapes, 0.0)), count + 1
    phrases = tuple(f"{shapes} ({depth:.2g} m)" for shapes, depth in overlaps.items())
    lost = () if original else tuple(phrase for text in texts_of(own, EDITED) for phrase in text.split("; "))
    return UnmodelledFeatures(elements, names, frozenset(known), phrases, count, texts_of(given, NEVER_REPLAYED), lost)


def _shape(model: Any, geom: int) -> str:
    """A geom by its own name or its body's."""
    return model.geom(geom).name or model.body(int(model.geom_bodyid[geom])).name or f"geom {geom}"


def pairs_by_name(model: Any) -> dict[frozenset[GeomName], tuple[int, int]]:
    """The pairs of geoms that may touch, by names that are the same in an edited text."""
    return {names_of(model, pair): pair for pair in contact_pairs(model)}


def names_of(model: Any, pair: Collection[int]) -> frozenset[GeomName]:
    """A pair of geoms by names that are the same in an edited text."""
    return frozenset(_name_of(model, geom) for geom in pair)


def _name_of(model: Any, geom: int) -> GeomName:
    name = model.geom(geom).name
    if (shape := shape_of(name)) != name:  # a point that stands for it in the plan's text
        return _name_of(model, int(model.geom(shape).id))
    if name and not _NUMBERED.fullmatch(name):  # the name that an edit gives to one without
        return name
    body = int(model.geom_bodyid[geom])
    return model.body(body).name or f"body number {body}", geom - int(model.body_geomadr[body])


def _words(one: UnsupportedElement) -> tuple[str, str]:
    """The head and the noun of a phrase about several elements of the same kind; the noun is "" for the model's own."""
    if one.kind in _COUNTED:
        return "", one.kind
    if not one.feature:
        return one.phrase, ""
    return _OF.get(one.kind, one.feature), one.noun


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun if number == 1 else _PLURALS.get(noun, noun + 's')}"
