"""Footholds of feet that step: where a machine with a gait, or with phases, stands at a goal.

Its feet go to a goal with it: it is displaced and turned along the ground as a whole, its joints as they are, to where
its frames are nearest to their targets, and there the feet that step have the stance of the start. What a target asks
for besides, a height or a lean, is left to the legs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from planner.dynamics.inverse_kinematics import POSTURE_WEIGHT, Target, integrate_base, residuals
from planner.dynamics.kinematics import frame_pose, jacobian
from planner.dynamics.resting_poses import along_plane
from planner.kernels.tree.mechanism_table import chain_of
from planner.model.mechanism import Frame, Mechanism
from planner.problem.tasks.pose_constraints import Feet


class Stance(NamedTuple):
    """A machine displaced along the ground, before its legs meet what is left of its targets."""

    q: np.ndarray  # (nq,)
    feet: Feet  # with the places to which they go


def carried_stance(
    feet: Feet, steps: frozenset[int], start: np.ndarray, q: np.ndarray, targets: Sequence[Target]
) -> Stance | None:
    """The stance of the start carried along to targets; None where no foot steps, or none can be carried.

    Args:
        feet: The feet at the start.
        steps: Links of the feet that step; the others stay where they are.
        start: (nq,) the configuration there.
        q: (nq,) the configuration of the joints.
        targets: Of frames.
    """
    mechanism, stepping = feet.mechanism, np.isin(feet.links, list(steps))
    base = _base_dofs(mechanism, feet.links[stepping])
    if not base.any():
        return None
    trunk, n = Frame(int(np.flatnonzero(base)[-1]), np.eye(4)), feet.normals[stepping][0]
    ways = np.eye(mechanism.nv)[:, base]
    ways = ways @ along_plane(mechanism, start, ways, np.array([trunk.link]), n)
    if not ways.shape[1]:
        return None
    pad = np.zeros(mechanism.space.nx - mechanism.nq)
    away = mechanism.space.difference(np.append(start, pad), np.append(q, pad))[: mechanism.nv]
    joints = integrate_base(mechanism, q, np.where(base, away, 0.0))  # the base where it was at the start
    turns = POSTURE_WEIGHT * (n @ jacobian(mechanism, start, trunk)[3:] @ ways)  # it turns only where that is asked for

    def errors(s: np.ndarray) -> np.ndarray:
        at, found = integrate_base(mechanism, joints, ways @ s), [turns @ s]
        for one in targets:
            r, _, angles = residuals(mechanism, at, one)
            found.extend(r / np.where(angles, one.turn_scale, one.metre_scale))
        return np.array(found)

    from scipy.optimize import least_squares  # 0.4 s that `planner run` need not pay

    displacement = ways @ least_squares(errors, np.zeros(ways.shape[1])).x
    there, places = integrate_base(mechanism, start, displacement), feet.places.copy()
    for k in np.flatnonzero(stepping):
        places[k] = frame_pose(mechanism, there, feet.frames[k])[:3, 3]
    return Stance(integrate_base(mechanism, joints, displacement), replace(feet, places=places))


def _base_dofs(mechanism: Mechanism, links: np.ndarray) -> np.ndarray:
    """(nv,) bool, the degrees of freedom that carry all the links (C,) and that no actuator drives; none of no link."""
    carry = np.full(mechanism.nv, bool(len(links)))
    for link in np.unique(links):
        carry &= np.isin(np.arange(mechanism.nv), chain_of(mechanism.parent, int(link)))
    return carry & ~mechanism.directly_actuated
