"""The contact law of a pair as MuJoCo computes it from the file's own numbers: a law with a lead (model.contact.laws).

MuJoCo's constraint (documentation, "Computation"; engine_core_constraint.c, mj_diagApprox and mj_makeImpedance) gives a
row of velocity v, penetration r and acceleration a = J qacc the force

    max(0, -b v + k d r - a) / R,   R = A (1 - d)/d,   b = 2/(dmax timeconst) or -solref[1]/dmax

with k of solref likewise and A the sum of body_invweight0 of both bodies. The force is that of a velocity 1/b later, so

    lead = 1/b,   B = b/R,   K = k d/R

are those of a contact without friction and of an elliptic cone, whose friction has impratio times the B. Each of the
E = 2 (condim - 1) edges of a pyramidal cone has R_py = 2 mu^2/impratio (1 + mu^2) A (1 - d)/d in place of R, and

    B = E b/R_py,   K = E k d/R_py.

K and B are of the impedance dmax of deep contacts, and the law's `impedance` says how d rises to it. A rise of another
power (the last number of solimp) than 2 has no law.

Where the force begins is a matter of margins and gaps, which releases of MuJoCo combine in different ways. A contact
that is to make no force is watched: MuJoCo detects it and says how deep it is (`watch`).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.contact.laws import ContactLaw
from planner.model.mjcf.model_index import ModelIndex, Pair, body_chain, compile_model, disabled, field, named
from planner.model.mjcf.text import written

MIN_IMPEDANCE, MAX_IMPEDANCE = 1e-4, 0.9999  # mjMINIMP, mjMAXIMP
MIN_FRICTION, _TINY = 1e-5, 1e-15  # mjMINMU, mjMINVAL
LEAST_PYRAMID = 1e-3  # of sliding friction: stiffness grows as 1 / mu^2, and rounding with it
# Ramp, m or rad, force ramp, N or N m, and bend of a plan: most machines sink in 0.3 to 5 mm.
FILE_SMOOTHING = (2e-4, 0.0, 0.5)
_DEFAULT_SOLREF = (0.02, 1.0)
ALONG_AXIS = 1e-6  # of a hinge's axis, across an axis of the world


def file_law(model: Any, pair: Pair) -> ContactLaw:
    """The law of any pair of a compiled MJCF, without smoothing.

    Args:
        model: MuJoCo's MjModel.
        pair: Of ModelIndex.pairs.

    Raises:
        ModelError: MuJoCo's force is not of this form: friction that differs along and across, friction with
            another rate than the normal force, or no damping.
    """
    if reason := file_law_reason(model, pair):
        raise ModelError(f"{' and '.join(named(model, 'geom', geom) for geom in pair.geoms)}: {reason}.")
    (K, B), mu, impratio = coefficients(model, pair, math.inf), _friction(pair), _impratio(model)
    lead, pyramidal = 1.0 / rates(model, pair.solref, pair.solimp)[1], is_pyramidal(model, pair)
    cone = "pyramidal" if pyramidal else "elliptic"
    rise = impedance_of(pair.solimp)
    spinning, rolling = (max(float(pair.friction[i]), MIN_FRICTION) for i in (2, 3))
    law = ContactLaw(
        K, B, 0.0, 0.0, 0.0, mu, impratio, 0.0, lead=lead, cone=cone, impedance=rise,
        spinning=spinning if pair.condim > 3 else 0.0, rolling=rolling if pair.condim > 4 else 0.0,
        margin=force_begins(model, pair),
    )  # fmt: skip
    return replace(law, slip_damping=law.tangential_damping)


def coefficients(model: Any, pair: Pair, depth: float) -> tuple[float, float]:
    """K, N/m, and B, N s/m, of a pair with the impedance of a depth, m: K depth is the normal force at rest there."""
    d, (k, b) = impedance_at(pair.solimp, depth), rates(model, pair.solref, pair.solimp)
    A = float(model.body_invweight0[model.geom_bodyid[list(pair.geoms)], 0].sum())
    edges, mu = 1, _friction(pair)
    if is_pyramidal(model, pair):
        edges, A = 2 * (pair.condim - 1), edge_weight(mu, _impratio(model)) * A
    per = edges / max(A * (1.0 - d) / d, _TINY)
    return per * k * d, per * b


def edge_weight(mu: float, impratio: float) -> float:
    """How many times more inverse inertia an edge of a pyramidal cone has than a contact without friction."""
    return 2.0 * mu**2 / impratio * (1.0 + mu**2)


def file_law_reason(model: Any, pair: Pair) -> str:
    """The reason why a pair's force has no `file_law`; "" where it has one."""
    if force_begins(model, pair) < 0.0:
        return f"margin {pair.margin:g}, expected at least 0"
    if model.opt.noslip_iterations > 0:
        return f"noslip_iterations {model.opt.noslip_iterations}, expected 0"
    if model.opt.enableflags & int(load_mujoco().mjtEnableBit.mjENBL_OVERRIDE):
        return "the flag override, expected it disabled"
    for name in ("adhesion", "surfacevel"):  # of MuJoCo 4
        if np.any(field(model, f"geom_{name}", model.ngeom)[list(pair.geoms)]):
            return f"{name}, expected none"
    k, b = rates(model, pair.solref, pair.solimp)
    if not (k > 0.0 and b > 0.0):
        return f"solref {pair.solref[0]:g} {pair.solref[1]:g}, expected stiffness and damping"
    if not has_square_rise(pair.solimp):
        return f"solimp whose impedance rises by a power of {pair.solimp[4]:g}, expected 2"
    if pair.condim > 1 and pair.friction[0] != pair.friction[1]:
        return "other friction along than across, expected one number"
    if pair.condim > 4 and is_pyramidal(model, pair) and pair.friction[0] < LEAST_PYRAMID:
        return f"friction {pair.friction[0]:g} of a pyramid of condim 6, expected at least {LEAST_PYRAMID:g}"
    if pair.condim > 4 and pair.friction[3] != pair.friction[4]:
        return "other rolling friction along than across, expected one number"
    own = pair.condim > 1 and not is_pyramidal(model, pair) and np.any(pair.solreffriction)
    if own and not np.isclose(rates(model, pair.solreffriction, pair.solimp)[1], b, rtol=1e-9):
        return "solreffriction has another damping than solref, expected the same or none"
    return ""


def impedance_of(solimp: np.ndarray) -> tuple[float, float, float, float]:
    """The impedance of a solimp (5,) at the surface and deep inside, the depth between, m, and the midpoint."""
    d0, dmax, midpoint = (float(x) for x in np.clip(solimp[[0, 1, 3]], MIN_IMPEDANCE, MAX_IMPEDANCE))
    width = float(solimp[2])
    if d0 == dmax or width <= _TINY:
        return 0.5 * (d0 + dmax), 0.5 * (d0 + dmax), 1.0, midpoint
    return d0, dmax, width, midpoint


def has_square_rise(solimp: np.ndarray) -> bool:
    """Whether the impedance of a solimp (5,) is constant or rises by a power of 2, as in a law with a lead."""
    first, last, _, _ = impedance_of(solimp)
    return first == last or float(solimp[4]) == 2.0


def impedance_at(solimp: np.ndarray, depth: float) -> float:
    """The impedance of a solimp (5,) at a depth, m."""
    d0, dmax, width, midpoint = impedance_of(solimp)
    x, power = min(depth / width, 1.0), max(float(solimp[4]), 1.0)
    if x <= midpoint:
        return d0 + (dmax - d0) * x**power / midpoint ** (power - 1.0)
    return dmax - (dmax - d0) * (1.0 - x) ** power / (1.0 - midpoint) ** (power - 1.0)


def is_pyramidal(model: Any, pair: Pair) -> bool:
    """Whether a pair has friction by a pyramidal cone."""
    return pair.condim > 1 and model.opt.cone == int(load_mujoco().mjtCone.mjCONE_PYRAMIDAL)


def turns_edges(survey: ModelIndex, pair: Pair) -> bool:
    """Whether a pair's pyramid has edges along a capsule, as MuJoCo lays them, and not along the world's axes."""
    model, joints = survey.model, load_mujoco().mjtJoint
    capsules = [geom for geom in pair.geoms if model.geom_type[geom] == int(load_mujoco().mjtGeom.mjGEOM_CAPSULE)]
    if not is_pyramidal(model, pair) or not capsules:
        return False
    hinges = []
    for body in body_chain(model, int(model.geom_bodyid[capsules[0]])):
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            if model.jnt_type[joint] in (int(joints.mjJNT_FREE), int(joints.mjJNT_BALL)):
                return True
            if model.jnt_type[joint] == int(joints.mjJNT_HINGE):
                hinges.append(survey.home.xaxis[joint])
    along = survey.home.geom_xmat[capsules[0]].reshape(3, 3)[:, 2]
    if not hinges:
        return bool(np.sort(np.abs(along[:2]))[0] > ALONG_AXIS)
    first = np.abs(hinges[0])  # a planar machine's hinges are across its plane, its capsules in it or across, too
    planar = all(np.abs(np.abs(one) - first).max() <= ALONG_AXIS for one in hinges)
    level = np.sort(first)[1] <= ALONG_AXIS and first[2] <= ALONG_AXIS
    across = min(float(np.abs(along @ hinges[0])), float(np.linalg.norm(np.cross(along, hinges[0]))))
    return not (planar and level and across <= ALONG_AXIS)


def _friction(pair: Pair) -> float:
    return max(float(pair.friction[0]), MIN_FRICTION) if pair.condim > 1 else 0.0


def _impratio(model: Any) -> float:
    return max(float(model.opt.impratio), _TINY)


def as_read(model: Any, pair: Pair) -> Pair:
    """A pair as its law has it, for the replayed model: with what refsafe makes of its time constants."""
    shortest = 0.0 if disabled(model, "refsafe") else 2.0 * float(model.opt.timestep)

    def safe(solref: np.ndarray) -> np.ndarray:
        return np.array([max(float(solref[0]), shortest), solref[1]]) if solref[0] > 0.0 and solref[1] > 0.0 else solref

    return pair._replace(solref=safe(pair.solref), solreffriction=safe(pair.solreffriction))


def rates(model: Any, solref: np.ndarray, solimp: np.ndarray) -> tuple[float, float]:
    """k, 1/s^2, and b, 1/s, of a solref (2,) in either format."""
    first, second = map(float, solref)
    dmax = float(np.clip(solimp[1], MIN_IMPEDANCE, MAX_IMPEDANCE))
    if (first > 0.0) != (second > 0.0):  # MuJoCo warns and takes its default
        first, second = _DEFAULT_SOLREF
    if first <= 0.0:
        return -first / dmax**2, -second / dmax
    if not disabled(model, "refsafe"):
        first = max(first, 2.0 * float(model.opt.timestep))
    return 1.0 / max((dmax * first * second) ** 2, _TINY), 2.0 / max(dmax * first, _TINY)


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
