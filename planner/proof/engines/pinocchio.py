"""Pinocchio: a model by its own parser of MJCF, accelerations by its articulated-body algorithm.

Its parser reads the tree of the first body in the world, the inertias and the armature, but neither gravity nor springs
nor actuators; its algorithm has no damping. Its velocity of a free joint is in the body's frame, its quaternions end with w.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from planner.base.errors import ModelError
from planner.dynamics.poe import rotation
from planner.model.mechanism import Mechanism
from planner.model.space import cross
from planner.proof.engines.applied import joints_with
from planner.proof.engines.text import Prepared

NEEDS = "pin==4.0.0 libpinocchio==4.0.0"

_SIZES = {1: 1, 3: 4, 6: 7}  # numbers of a joint's place by those of its velocity
_WXYZ = np.array([3, 0, 1, 2])  # where x, y, z, w have w, x, y, z


def load() -> Any:
    """The library; an ImportError where it is missing, or another package of this name is there."""
    pinocchio = importlib.import_module("pinocchio")
    if not hasattr(pinocchio, "buildModelFromMJCF"):
        raise ImportError("the package pinocchio that is there has no parser of MJCF")
    return pinocchio


class Pinocchio:
    """A mechanism in Pinocchio."""

    def __init__(self, text: Prepared, mechanism: Mechanism) -> None:
        """Read the text that the mechanism is of.

        Raises:
            ImportError: Pinocchio is not installed.
            ModelError: Its parser refuses the text, or reads other joints.
        """
        self._library = pinocchio = load()
        self.version = str(pinocchio.__version__)
        try:
            model = pinocchio.buildModelFromMJCF(str(text.path))
        except (ValueError, RuntimeError, IndexError) as error:
            raise ModelError(f"Pinocchio's parser refuses the model: {' '.join(str(error).split())}") from None
        self._model = model
        model.gravity.linear = np.array(mechanism.gravity)
        self._data, self._free = model.createData(), []
        self._q, self._v = np.zeros(mechanism.nq, dtype=int), np.zeros(mechanism.nv, dtype=int)
        joints = [(int(n), int(model.idx_qs[i]), int(model.idx_vs[i]), model.names[i]) for i, n in _joints(model)]
        self._place(mechanism, text, joints)
        self._armature, self.lacks_damping = mechanism.armature, mechanism.damping
        self.settings = ["gravity"]
        lacks = np.asarray(model.armature)[self._v] != mechanism.armature
        if np.any(lacks):
            armature = np.empty(model.nv)
            armature[self._v] = mechanism.armature
            model.armature = armature
            self.settings.append(f"armature of {joints_with(mechanism, lacks)}")

    def _place(self, mechanism: Mechanism, text: Prepared, joints: list[tuple[int, int, int, str]]) -> None:
        """Find MuJoCo's joints in Pinocchio's, which are one for all joints of a body."""
        expected = [own.stop - own.start for own in mechanism.joint_links]
        dof = place = j = 0
        for size, q, v, name in joints:
            known = j < len(text.joints) and name in (text.joints[j], f"Composite_{text.joints[j]}")
            while known and size > 0 and j < len(expected):
                n, nq = expected[j], _SIZES[expected[j]]
                self._q[place : place + nq] = q + np.arange(nq)
                self._v[dof : dof + n] = v + np.arange(n)
                if n > 1:  # the quaternion
                    self._q[place + nq - 4 : place + nq] = q + nq - 4 + _WXYZ
                if n == 6:
                    self._free.append((place, dof))
                size, q, v, place, dof, j = size - n, q + nq, v + n, place + nq, dof + n, j + 1
            if size != 0 or not known:
                break
        if j < len(expected) or self._model.nv != mechanism.nv:
            read = ", ".join(name for *_, name in joints)
            raise ModelError(f"Pinocchio's parser reads other joints ({read}) than {', '.join(text.joints)}")

    def acceleration(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """qacc (nv,) at qpos (nq,), qvel (nv,) with the applied forces tau (nv,), in MuJoCo's coordinates."""
        place, speed, force = np.empty(self._model.nq), np.empty(len(v)), np.empty(len(v))
        turned = [(dof, rotation(q[a + 3 : a + 7])) for a, dof in self._free]
        own_v, own_tau = v, tau
        if turned:
            own_v, own_tau = v.copy(), tau.copy()
            for dof, R in turned:
                w, linear = v[dof + 3 : dof + 6], R.T @ v[dof : dof + 3]
                own_v[dof : dof + 3] = linear  # whose rate is not the acceleration: armature resists that
                own_tau[dof : dof + 3] = R.T @ tau[dof : dof + 3] - self._armature[dof : dof + 3] * cross(w, linear)
        place[self._q], speed[self._v], force[self._v] = q, own_v, own_tau
        found = np.array(self._library.aba(self._model, self._data, place, speed, force))[self._v]
        for dof, R in turned:  # of R w: the frame turns
            w = v[dof + 3 : dof + 6]
            found[dof : dof + 3] = R @ (found[dof : dof + 3] + cross(w, own_v[dof : dof + 3]))
        return found


def _joints(model: Any) -> list[tuple[int, int]]:
    """(index, degrees of freedom) of every joint but the universe."""
    return [(i, int(model.nvs[i])) for i in range(1, model.njoints)]
