"""Pinocchio: a model by its own parser of MJCF, accelerations by its articulated-body algorithm.

Its parser reads the tree, the inertias and the armature, but not gravity, springs or actuators; its algorithm has no
damping. Its velocity of a free joint is in the body frame, its quaternions are (x, y, z, w).
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from planner.base.errors import ModelError
from planner.dynamics.product_of_exponentials import rotation
from planner.model.mechanism import Mechanism
from planner.model.space import cross
from planner.proof.engines.motion import Prepared, joints_with

NEEDS = "pin==4.0.0 libpinocchio==4.0.0"

_WXYZ = np.array([3, 0, 1, 2])  # indices of w, x, y, z in x, y, z, w


def load() -> Any:
    """The library; raises ImportError if it is missing or is another package of the same name."""
    pinocchio = importlib.import_module("pinocchio")
    if not hasattr(pinocchio, "buildModelFromMJCF"):
        raise ImportError("the package pinocchio that is there has no parser of MJCF")
    return pinocchio


class Pinocchio:
    """A mechanism in Pinocchio."""

    def __init__(self, text: Prepared, mechanism: Mechanism) -> None:
        """Parse the text of the mechanism.

        Raises:
            ImportError: Pinocchio is not installed.
            ModelError: Its parser rejects the text, or reads other joints.
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
        self._place(mechanism, text)
        self._armature, self.lacks_damping = mechanism.armature, mechanism.damping
        self.settings = ["gravity"]
        lacks = np.asarray(model.armature)[self._v] != mechanism.armature
        if np.any(lacks):
            armature = np.empty(model.nv)
            armature[self._v] = mechanism.armature
            model.armature = armature
            self.settings.append(f"armature of {joints_with(mechanism, lacks)}")

    def _place(self, mechanism: Mechanism, text: Prepared) -> None:
        """Map MuJoCo's joints to Pinocchio's."""
        model, own = self._model, {name: i for i, name in enumerate(self._model.names)}
        sizes = [links.stop - links.start for links in mechanism.joint_links]
        found = [own.get(name, 0) for name in text.joints]  # 0 is the universe, which is fixed
        if [model.nvs[i] for i in found] != sizes or model.nv != mechanism.nv:
            read = ", ".join(list(model.names)[1:])
            raise ModelError(f"Pinocchio's parser reads other joints ({read}) than {', '.join(text.joints)}")
        place = 0
        for i, n, links in zip(found, sizes, mechanism.joint_links, strict=True):
            q, numbers = int(model.idx_qs[i]), int(model.nqs[i])
            self._v[links] = int(model.idx_vs[i]) + np.arange(n)
            self._q[place : place + numbers] = q + np.arange(numbers)
            if n > 1:
                self._q[place + numbers - 4 : place + numbers] = q + numbers - 4 + _WXYZ
            if n == 6:
                self._free.append((place, links.start))
            place += numbers

    def acceleration(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Accelerations qacc (nv,) at qpos (nq,), qvel (nv,) with the forces tau (nv,), in MuJoCo's coordinates."""
        place, speed, force = np.empty(self._model.nq), np.empty(len(v)), np.empty(len(v))
        turned = [(dof, rotation(q[a + 3 : a + 7])) for a, dof in self._free]
        own_v, own_tau = v, tau
        if turned:
            own_v, own_tau = v.copy(), tau.copy()
            for dof, R in turned:
                w, linear = v[dof + 3 : dof + 6], R.T @ v[dof : dof + 3]
                own_v[dof : dof + 3] = linear  # armature acts on the classical acceleration instead
                own_tau[dof : dof + 3] = R.T @ tau[dof : dof + 3] - self._armature[dof : dof + 3] * cross(w, linear)
        place[self._q], speed[self._v], force[self._v] = q, own_v, own_tau
        found = np.array(self._library.aba(self._model, self._data, place, speed, force))[self._v]
        for dof, R in turned:  # derivative of R w in the rotating frame
            w = v[dof + 3 : dof + 6]
            found[dof : dof + 3] = R @ (found[dof : dof + 3] + cross(w, own_v[dof : dof + 3]))
        return found
