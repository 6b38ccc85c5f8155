"""Where the force of a contact begins: margins and gaps, which releases of MuJoCo combine in different ways.

A contact that is to make no force is watched: MuJoCo detects it and says how deep it is (`watch`).
"""

from __future__ import annotations

from functools import cache
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import Pair, compile_model
from planner.model.mjcf.text import written

WATCHED_MARGIN = -1e3  # m, where the force of a watched pair would begin


def force_begins(model: Any, pair: Pair) -> float:
    """How far apart a pair's surfaces are where its force begins, m: of margins and gaps, as this MuJoCo has them.

    Below 0 where they press only once they are as deep in each other.
    """
    geoms = tuple(f'margin="{model.geom_margin[geom]}" gap="{model.geom_gap[geom]}"' for geom in pair.geoms)
    for k in range(model.npair):
        if {int(model.pair_geom1[k]), int(model.pair_geom2[k])} == set(pair.geoms):
            return _begins("", "", f'margin="{model.pair_margin[k]}" gap="{model.pair_gap[k]}"')
    return _begins(*geoms, "")


@cache
def _begins(first: str, second: str, pair: str) -> float:
    """Where force begins between a plane and a ball with these margins: releases add them, or take the larger one.

    WATCHED_MARGIN where the ball is not seen at all.
    """
    data = _plane_and_ball(first, second, pair)
    return float(data.contact[0].includemargin) if data.ncon else WATCHED_MARGIN


def _plane_and_ball(first: str = "", second: str = "", explicit: str = "") -> Any:
    """MuJoCo's data of a ball 0.1 m deep in a plane, with attributes of both geoms and of their <pair>, if any."""
    pair = f'<contact><pair geom1="a" geom2="b" {explicit}/></contact>' if explicit else ""
    model = compile_model(
        f'<mujoco><worldbody><geom name="a" type="plane" size="1 1 1" {first}/><body pos="0 0 .9"><freejoint/>'
        f'<geom name="b" size="1" {second}/></body></worldbody>{pair}</mujoco>'
    )
    data = load_mujoco().MjData(model)
    load_mujoco().mj_fwdPosition(model, data)
    return data


def watch(section: ElementTree.Element, first: str, second: str) -> None:
    """Add a <pair> of two geoms whose contact MuJoCo detects and that makes no force; it replaces their own contact."""
    margin, gap = _watched()
    ElementTree.SubElement(section, "pair", {"geom1": first, "geom2": second, "margin": margin, "gap": gap})


@cache
def _watched() -> tuple[str, str]:
    """Margin and gap with which MuJoCo detects contact at distance 0 without a force: before 4.0, or from it on."""
    for margin in (0.0, WATCHED_MARGIN):
        texts = written(margin), written(-WATCHED_MARGIN)
        data = _plane_and_ball(explicit='margin="{}" gap="{}"'.format(*texts))
        if data.ncon and not data.nefc:
            return texts
    raise AssertionError(f"MuJoCo {load_mujoco().__version__} has no contact without force")


def is_watched(includemargin: np.ndarray) -> np.ndarray:
    """Whether contacts with these margins, m, make no force at any depth: see `watch`."""
    return includemargin <= 0.5 * WATCHED_MARGIN


def watched_pairs(model: Any) -> set[frozenset[int]]:
    """The pairs of geoms of a compiled model that are watched."""
    none = (model.pair_margin <= 0.5 * WATCHED_MARGIN) | (model.pair_margin - model.pair_gap <= 0.5 * WATCHED_MARGIN)
    return {frozenset((int(model.pair_geom1[k]), int(model.pair_geom2[k]))) for k in np.flatnonzero(none)}
