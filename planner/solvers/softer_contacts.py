"""A problem whose contacts are softer by a factor: a family for a continuation in the contact.

    K / f,    B / sqrt(f),    f a,     f >= 1

of the stiffness, the damping and the ramp of every contact with the ground and between bodies: a machine at rest sinks
f times as deep, its bounces keep their damping ratio, and the force ramp is the same. A hard contact is nearly a
switch, about which the LQ problem knows nothing until it happens; a soft one has a gradient over a longer part of the
way, and its plan takes off and lands as the hard one does (Mordatch, Todorov and Popovic 2012; Posa, Cantu and
Tedrake 2014 relax the complementarity instead). At f = 1 it is the problem itself. Stops of joints and friction stay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.contact.laws import ContactLaw
from planner.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class SofterContacts:
    """A problem of a rigid-body machine with contacts."""

    problem: Problem

    def at(self, factor: float) -> Problem:
        """The problem with contacts that sink `factor` times as deep; the problem itself at 1."""
        if factor == 1.0:
            return self.problem
        dynamics: Any = self.problem.dynamics
        mechanism = replace(
            dynamics.mechanism,
            contacts=tuple(replace(one, law=_softer(one.law, factor)) for one in dynamics.mechanism.contacts),
            body_contacts=tuple(replace(one, law=_softer(one.law, factor)) for one in dynamics.mechanism.body_contacts),
        )
        softer = RigidBodyDynamics(mechanism, dynamics.dt, dynamics.integrator, dynamics.prescribed, dynamics.substeps)
        return replace(self.problem, dynamics=softer, recipe=None)


def _softer(law: ContactLaw, factor: float) -> ContactLaw:
    return replace(
        law, stiffness=law.stiffness / factor, damping=law.damping / math.sqrt(factor), ramp=law.ramp * factor
    )


def has_softer(problem: Problem) -> bool:
    """Whether a problem has contacts that can be made softer."""
    dynamics = problem.dynamics
    return isinstance(dynamics, RigidBodyDynamics) and bool(
        dynamics.mechanism.contacts or dynamics.mechanism.body_contacts
    )
