"""Thrust below weight: a machine in the air that its thrusters cannot carry in any attitude falls, whatever it does.

The forces of thrusters sum to at most F = sum |f_a|, whichever way they point. A machine of mass m that nothing else
pushes, with F < m g, has a centre of mass that accelerates downwards by at least g - F / m from the start to the end.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from planner.dynamics.quasi_static import weight
from planner.model.actuators import INTEGRATOR
from planner.model.capabilities import capabilities_of, roots, thrusters
from planner.model.mechanism import Mechanism
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.problem.problem import Problem


class MissingThrust(NamedTuple):
    """What the thrusters of a machine push together at most, in any attitude, and what it weighs, both N."""

    thrust: float
    weight: float


def missing_thrust(problem: Problem) -> MissingThrust | None:
    """Thrust and weight of a machine in the air whose thrusters push less than it weighs; None for all others.

    Drag does not count: air may carry a machine as it carries a glider, but none that is at rest.
    """
    mechanism = capabilities_of(problem.dynamics).mechanism
    if mechanism is None or prescribed_dofs_of(problem.dynamics).size or not _flies_alone(mechanism):
        return None
    acts, lifts, x0 = mechanism.actuators, thrusters(mechanism), problem.x0
    pushes = np.zeros(mechanism.nu)
    for one in acts.wrenches:
        pushes[one.actuator] += np.linalg.norm(one.force)
    given = np.full((2, mechanism.nu), [[-np.inf], [np.inf]]) if problem.bounds is None else np.array(
        [problem.bounds.lower.min(axis=0), problem.bounds.upper.max(axis=0)]
    )[:, : mechanism.nu]  # fmt: skip
    given = np.where(acts.dynamics == INTEGRATOR, acts.activation_range.T, given)
    own = np.flatnonzero(acts.activation >= 0)  # a filter begins at its activation
    begins = x0[mechanism.nq + mechanism.nv + acts.activation[own]]
    given[:, own] = [np.minimum(given[0, own], begins), np.maximum(given[1, own], begins)]
    with np.errstate(invalid="ignore"):  # no gain times no bound
        forces = np.clip(acts.gain * given + acts.bias[:, 0], *acts.force_range.T)
    total = float(np.where(lifts, pushes, 0.0) @ np.nan_to_num(np.abs(forces).max(axis=0), nan=np.inf, posinf=1e300))
    return MissingThrust(total, weight(mechanism)) if total < weight(mechanism) else None


def _flies_alone(mechanism: Mechanism) -> bool:
    """Whether thrusters, gravity and drag are all that acts on one free body and its links from outside."""
    base = slice(0, 6)
    if not mechanism.joint_links or mechanism.joint_links[0] != base or len(set(roots(mechanism).tolist())) > 1:
        return False
    lifts = thrusters(mechanism)
    pushed = mechanism.actuators.acts_on[~lifts, base].any() or mechanism.stiffness[base].any()
    touches = mechanism.contacts or mechanism.body_contacts or mechanism.loops or mechanism.gravcomp_mass.any()
    return bool(lifts.any()) and not (pushed or touches)
