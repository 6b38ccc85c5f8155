"""Find the parameters of a mechanism that differ from another model: the cause of a failed parity.

The other model is read as a mechanism too, and the two are compared joint by joint. Where all parameters agree, the
difference has another cause, and `rigid_parity` names the joint where accelerations differ.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from planner.model.couplings import LoopClosure, PolynomialCoupling
from planner.model.mechanism import Mechanism

_ROUNDING = 1e-12  # relative, of parameters after compilation
_OF_TENDONS = ("dofs", "coefficients", "stiffness", "rest", "damping")
_MAX_NAMED = 4  # maximum number of differences named; further ones are counted


def differences(ours: Mechanism, theirs: Mechanism) -> str:
    """Name the joints and terms that differ, e.g. "mass at joint 'elbow' is 0.55, the plan has 0.5"; "" for nothing.

    Both models have the same numbers of joints and actuators.
    """
    found = list(_all(ours, theirs))
    more = [f"{len(found) - _MAX_NAMED} more"] if len(found) > _MAX_NAMED else []
    return "; ".join([*found[:_MAX_NAMED], *more])


def joint_of(mechanism: Mechanism, dof: int) -> str:
    """Name of a degree of freedom, e.g. joint 'elbow'."""
    for number, (name, links) in enumerate(zip(mechanism.joint_names, mechanism.joint_links, strict=True)):
        if links.start <= dof < links.stop:
            words = f"joint {name!r}" if name else f"joint number {number}"
            return words if links.stop - links.start == 1 else f"{words} (axis {dof - links.start + 1})"
    raise AssertionError(f"no joint has the degree of freedom {dof}")


def actuator_of(mechanism: Mechanism, index: int) -> str:
    """Name of an actuator, e.g. actuator 'motor'."""
    name = mechanism.actuators.names[index]
    return f"actuator {name!r}" if name else f"actuator number {index}"


def _all(ours: Mechanism, theirs: Mechanism) -> Iterator[str]:
    if not _same(ours.gravity, theirs.gravity):
        yield f"gravity is {_shown(theirs.gravity)}, the plan has {_shown(ours.gravity)}"
    if not (np.array_equal(ours.parent, theirs.parent) and np.array_equal(ours.kind, theirs.kind)):
        yield "the joints are of other kinds or carried by other bodies"
        return
    terms = {
        "frame": (ours.T_home, theirs.T_home), "frame (axis or anchor)": (ours.S, theirs.S),
        "reference position": (ours.q_home, theirs.q_home), "mass": (ours.mass, theirs.mass),
        "centre of mass": (ours.com, theirs.com), "inertia": (ours.inertia, theirs.inertia),
        "armature": (ours.armature, theirs.armature), "damping": (ours.damping, theirs.damping),
        "stiffness": (ours.stiffness, theirs.stiffness), "spring reference": (ours.spring_rest, theirs.spring_rest),
        "friction loss": (ours.friction_loss, theirs.friction_loss),
        "solimpfriction": (ours.friction_inertia, theirs.friction_inertia),
        "solreffriction": (ours.friction_rate, theirs.friction_rate),
        "mass with gravity compensation": (ours.gravcomp_mass, theirs.gravcomp_mass),
    }  # fmt: skip
    for dof in range(ours.nv):
        for term, (one, other) in terms.items():
            if not _same(one[dof], other[dof], np.abs(one).max()):
                yield f"{term} at {joint_of(ours, dof)}{_values(one[dof], other[dof])}"
    balls = {
        "stiffness": (ours.ball_stiffness, theirs.ball_stiffness),
        "spring reference": (ours.ball_rest, theirs.ball_rest),
    }
    drags = [sorted((one.link, *one.screw, one.linear, one.quadratic) for one in m.drags) for m in (ours, theirs)]
    if not _same(np.array(drags[0]), np.array(drags[1])):
        yield "the drag of the fluid"
    if len(ours.tendons) != len(theirs.tendons):
        yield f"{len(theirs.tendons)} fixed tendons act, the plan has {len(ours.tendons)}"
    for one, other in zip(ours.tendons, theirs.tendons, strict=False):
        pairs = ((word, np.array(getattr(one, word)), np.array(getattr(other, word))) for word in _OF_TENDONS)
        wrong = [word for word, mine, its in pairs if not _same(mine, its)]
        yield from (f"{word.replace('_', ' ')} of tendon {one.name!r}" for word in wrong)
    for ball, (_, dof) in enumerate(ours.quaternions):
        for term, (one, other) in balls.items():
            if not _same(one[ball], other[ball]):
                yield f"{term} at {joint_of(ours, dof)}{_values(one[ball], other[ball])}"
    if [replace(one, name="") for one in ours.couplings] != [replace(one, name="") for one in theirs.couplings]:
        both = (", ".join(one.name for one in m.couplings) or "none" for m in (theirs, ours))
        yield "its equalities of joints are others: {} there, {} in the plan".format(*both)
    for name in ("loops", "polynomial_couplings"):
        one, other = (tuple(_of_chain(x) for x in getattr(m, name)) for m in (ours, theirs))
        if len(one) != len(other) or not all(_same(x, y) for x, y in zip(one, other, strict=True)):
            yield f"its equalities that close chains are others ({name})"
    a, b = ours.actuators, theirs.actuators
    terms = {
        "gear": (a.moment, b.moment), "gain": (a.gain, b.gain), "bias": (a.bias, b.bias),
        "kind of activation": (a.dynamics.astype(float), b.dynamics.astype(float)),
        "time constant": (a.time_constant, b.time_constant),
    }  # fmt: skip
    if _at_sites(ours) != _at_sites(theirs) or not all(
        _same(x, y) for x, y in zip(_of_sites(ours), _of_sites(theirs), strict=True)
    ):
        yield "what its actuators do at sites is another (site, refsite or gear)"
    if [(law.actuator, law.kind) for law in a.laws] != [(law.actuator, law.kind) for law in b.laws] or not all(
        _same(np.array(x.numbers), np.array(y.numbers)) for x, y in zip(a.laws, b.laws, strict=True)
    ):
        yield "the force laws of its actuators are others"
    for index in range(ours.nu):
        for term, (one, other) in terms.items():
            if not _same(one[index], other[index]):
                where = f" at {joint_of(ours, int(np.abs(one - other)[index].argmax()))}" if term == "gear" else ""
                yield f"{term} of {actuator_of(ours, index)}{where}{_values(one[index], other[index])}"


def _same(one: np.ndarray, other: np.ndarray, scale: float = 0.0) -> bool:
    if one.shape != other.shape:
        return False
    size = max(scale, float(np.abs(one).max(initial=0.0)))
    return bool(np.all(np.abs(one - other) <= _ROUNDING * size))


def _values(ours: np.ndarray, theirs: np.ndarray) -> str:
    """The two values as text, if short enough for a sentence."""
    ours, theirs = np.atleast_1d(ours), np.atleast_1d(theirs)
    wrong = np.flatnonzero(ours != theirs) if ours.ndim == 1 else ()
    if len(wrong) == 1 or ours.size <= 3:
        few = wrong if len(wrong) == 1 else slice(None)
        return f" is {_shown(theirs[few])}, the plan has {_shown(ours[few])}"
    return ""


def _shown(values: np.ndarray) -> str:
    flat = [f"{value:.6g}" for value in np.ravel(values)]
    return flat[0] if len(flat) == 1 else f"({', '.join(flat)})"


def _at_sites(mechanism: Mechanism) -> list[tuple[int, int, int]]:
    """Actuator, link and frame of each wrench at a site."""
    return [(one.actuator, one.link, one.frame) for one in mechanism.actuators.wrenches]


def _of_sites(mechanism: Mechanism) -> list[np.ndarray]:
    """The numbers (9,) of each wrench at a site: place, force and torque."""
    return [np.concatenate([one.place, one.force, one.torque]) for one in mechanism.actuators.wrenches]


def _of_chain(chain: LoopClosure | PolynomialCoupling) -> np.ndarray:
    """The parameters of a loop closure or a cam."""
    if isinstance(chain, PolynomialCoupling):
        return np.array([chain.follower, chain.leader, *chain.offsets, *chain.coefficients], dtype=float)
    return np.array([*chain.links, chain.rigid, *chain.frames.ravel()], dtype=float)
