"""Problems with other contacts: families for a continuation in the contact, from an easy one to the problem at f = 1.

    SofterContacts      K / f,          B / sqrt(f),    f a        of every contact
    DistantContacts     K min(1, 8/f),  as stiff,       f a        of what is driven with what is not

of the stiffness, the damping and the ramp. A hard contact is nearly a switch, about which the LQ problem knows nothing
until it happens. On softer ones a machine at rest sinks f times as deep, its bounces keep their damping ratio, and the
force ramp is the same: there is a gradient over a longer part of the way, and the plan takes off and lands as the hard
one does. An object that is never touched has no gradient at all. The law's surface is half a ramp above the body's, so
a long ramp is a force at a distance: it begins at f a / 2, and is K a where the surfaces touch. (Mordatch, Todorov and
Popovic 2012 have both; Posa, Cantu and Tedrake 2014 relax the complementarity instead.) Stops of joints and friction
stay.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from planner.dynamics.contacts import body_contact_forces, contact_forces
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.capabilities import roots
from planner.model.contact.body_contact import BodyContact
from planner.problem.problem import Problem

SOFT_FACTOR = 10.0  # of the depth that contacts sink in, at which a continuation in the contact begins
REACH = 2.0  # distance at which a force at a distance begins, over the gap at the start


@dataclass(frozen=True, eq=False)
class SofterContacts:
    """A problem of a rigid-body machine with contacts, which sink `factor` times as deep at first."""

    problem: Problem
    factor: float = SOFT_FACTOR

    def at(self, factor: float) -> Problem:
        """The problem with contacts that sink `factor` times as deep; the problem itself at 1."""

        def softer(one: Any) -> Any:
            law = one.law
            own = {"stiffness": law.stiffness / factor, "damping": law.damping / math.sqrt(factor)}
            return replace(one, law=replace(law, **own, ramp=law.ramp * factor))

        return self.problem if factor == 1.0 else _with_contacts(self.problem, softer, softer)


@dataclass(frozen=True, eq=False)
class DistantContacts:
    """A problem whose machine is to move objects that no actuator drives, and begins apart from some of them."""

    problem: Problem

    def at(self, factor: float) -> Problem:
        """The problem with ramps `factor` times as long between what is driven and objects; the problem itself at 1."""

        def longer(pair: BodyContact) -> BodyContact:
            if pair not in self._pushing:
                return pair
            law, softer = pair.law, max(1.0, factor / 8.0)  # half a ramp deep the force is an eighth of K a
            own = {"stiffness": law.stiffness / softer, "damping": law.damping / math.sqrt(softer)}
            return replace(pair, law=replace(law, **own, ramp=law.ramp * factor))

        return self.problem if factor == 1.0 else _with_contacts(self.problem, lambda plane: plane, longer)

    @cached_property
    def factor(self) -> float:
        """The factor at which every object feels what may push it at the start; 1 where all is in touch."""
        return max((2.0 * REACH * gap / pair.law.ramp for pair, gap in self._pushing.items()), default=1.0)

    @cached_property
    def _pushing(self) -> dict[BodyContact, float]:
        """Smooth contacts of a driven tree with one that is not, and their gaps at the start, m, 0 in touch."""
        if not has_softer(self.problem):
            return {}
        dynamics: Any = self.problem.dynamics
        mechanism, x0 = dynamics.mechanism, self.problem.x0
        root = roots(mechanism)
        driven = set(root[mechanism.directly_actuated].tolist())
        depths = body_contact_forces(mechanism, *np.split(x0[: mechanism.nq + mechanism.nv], [mechanism.nq])).depths
        pushing = {}
        for pair, depth in zip(mechanism.body_contacts, depths, strict=True):
            trees = [int(root[part.link]) in driven for part in (pair.first, pair.second) if part.link >= 0]
            if sorted(trees) == [False, True] and pair.law.ramp > 0.0:
                pushing[pair] = max(0.0, -float(depth))
        return pushing


def _with_contacts(problem: Problem, plane: Callable[[Any], Any], pair: Callable[[Any], Any]) -> Problem:
    """The problem with each contact with a plane and each of two bodies replaced."""
    dynamics: Any = problem.dynamics
    mechanism = replace(
        dynamics.mechanism,
        contacts=tuple(map(plane, dynamics.mechanism.contacts)),
        body_contacts=tuple(map(pair, dynamics.mechanism.body_contacts)),
    )
    other = RigidBodyDynamics(mechanism, dynamics.dt, dynamics.integrator, dynamics.prescribed, dynamics.substeps)
    return replace(problem, dynamics=other, recipe=None)


def has_softer(problem: Problem) -> bool:
    """Whether a problem has contacts that can be made softer."""
    dynamics = problem.dynamics
    return isinstance(dynamics, RigidBodyDynamics) and bool(
        dynamics.mechanism.contacts or dynamics.mechanism.body_contacts
    )


def stays_on_feet(problem: Problem, xs: np.ndarray) -> bool:
    """Whether each body that planes carry at some knot of xs (N+1, nx) is carried at all, and no bodies may touch."""
    if not has_softer(problem):
        return False
    dynamics: Any = problem.dynamics
    mechanism = dynamics.mechanism
    q, qd = np.split(xs[:, : mechanism.nq + mechanism.nv], [mechanism.nq], axis=1)
    pressed = np.any(contact_forces(mechanism, q, qd).forces, axis=2)  # (N+1, contacts)
    links = np.array([contact.link for contact in mechanism.contacts])
    loaded = np.array([pressed[:, links == link].any(axis=1) for link in np.unique(links)])
    return not mechanism.body_contacts and bool(np.all(loaded.all(axis=1) == loaded.any(axis=1)))
