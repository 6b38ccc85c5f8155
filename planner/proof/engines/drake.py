"""Drake: a model by its own parser of MJCF, accelerations by the articulated-body algorithm of its MultibodyPlant.

Its parser reads gravity, damping, and the armature of hinge and slide joints with a supported actuator; it ignores
springs, friction loss and `general` actuators. Its velocity of a free joint is (angular, linear), both in the world
frame, that of a ball joint angular in the parent frame. A ball joint has three angles, recomputed for every state:
angles are never integrated.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from planner.base.errors import ModelError
from planner.dynamics.product_of_exponentials import rotation
from planner.model.mechanism import Mechanism
from planner.proof.engines.motion import Prepared, joints_with

NEEDS = "drake==1.51.1"


def load() -> list[Any]:
    """Its modules plant, parsing and math; raises ImportError if it is missing."""
    return [importlib.import_module(f"pydrake.{name}") for name in ("multibody.plant", "multibody.parsing", "math")]


class Drake:
    """A mechanism in Drake."""

    def __init__(self, text: Prepared, mechanism: Mechanism) -> None:
        """Parse the text of the mechanism.

        Raises:
            ImportError: Drake is not installed.
            ModelError: Its parser rejects the text, or reads other joints.
        """
        plants, parsing, self._math = load()
        self.version = importlib.metadata.version("drake")
        self._plant = plant = plants.MultibodyPlant(0.0)  # continuous: no step, no contacts, no joint limits
        with _quiet():
            try:
                parsing.Parser(plant).AddModels(str(text.path))
                plant.Finalize()
            except RuntimeError as error:
                raise ModelError(f"Drake's parser refuses the model: {' '.join(str(error).split())}") from None
        self._q, self._v = np.zeros(mechanism.nq, dtype=int), np.zeros(mechanism.nv, dtype=int)
        self._turning: list[tuple[int, slice, bool]] = []  # quaternion address, velocity slice, is a ball joint
        self._place(mechanism, text)
        self.settings: list[str] = []
        self._set_gravity(mechanism)
        self.lacks_damping, armature = self._lacks(mechanism)
        self._armature = np.zeros(mechanism.nv)
        self._armature[self._v] = armature
        if np.any(armature):
            self.settings.append(f"armature of {joints_with(mechanism, armature != 0.0)}, by the mass matrix")
        self._context = plant.CreateDefaultContext()

    def _place(self, mechanism: Mechanism, text: Prepared) -> None:
        """Map MuJoCo's joints to Drake's."""
        plant = self._plant
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        own = {one.name(): one for one in joints} | {
            one.child_body().name(): one for one in joints if one.num_velocities() == 6
        }
        sizes = [links.stop - links.start for links in mechanism.joint_links]
        found = [
            own.get(body if n == 6 else name) for name, body, n in zip(text.joints, text.bodies, sizes, strict=True)
        ]
        if plant.num_velocities() != mechanism.nv or not all(
            one is not None and one.num_velocities() == n for one, n in zip(found, sizes, strict=True)
        ):
            raise ModelError(f"Drake's parser reads other joints ({', '.join(own)}) than {', '.join(text.joints)}")
        self._joints: list[Any] = found
        place = 0
        for joint, links in zip(found, mechanism.joint_links, strict=True):
            assert joint is not None
            q, v, n = joint.position_start(), joint.velocity_start(), links.stop - links.start
            self._v[links] = v + (np.array([3, 4, 5, 0, 1, 2]) if n == 6 else np.arange(n))
            if n == 1:
                self._q[place] = q
            elif n == 3:  # three angles, set from the quaternion
                self._q[place : place + 4] = q, q, q, q
                self._turning.append((place, links, True))
            else:
                self._q[place : place + 7] = q + np.array([4, 5, 6, 0, 1, 2, 3])
                self._turning.append((place + 3, slice(links.start + 3, links.stop), False))
            place += {1: 1, 3: 4, 6: 7}[n]

    def _set_gravity(self, mechanism: Mechanism) -> None:
        field = self._plant.mutable_gravity_field()
        if not np.array_equal(field.gravity_vector(), mechanism.gravity):
            field.set_gravity_vector(np.array(mechanism.gravity))
            self.settings.append("gravity")

    def _lacks(self, mechanism: Mechanism) -> tuple[np.ndarray, np.ndarray]:
        """Damping and armature (nv,) that Drake has not read."""
        plant = self._plant
        damping, armature = mechanism.damping.copy(), mechanism.armature.copy()
        links_of = dict(zip((joint.index() for joint in self._joints), mechanism.joint_links, strict=True))
        for joint, links in zip(self._joints, mechanism.joint_links, strict=True):
            if links.stop - links.start < 6:  # free joints have none
                damping[links] -= joint.default_damping_vector()
        for index in plant.GetJointActuatorIndices():
            actuator = plant.get_joint_actuator(index)
            if (joint := actuator.joint().index()) in links_of:
                armature[links_of[joint]] -= actuator.default_reflected_inertia()
        return damping, armature

    def acceleration(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Accelerations qacc (nv,) at qpos (nq,), qvel (nv,) with the forces tau (nv,), in MuJoCo's coordinates."""
        plant, context = self._plant, self._context
        place, speed, force = np.empty(plant.num_positions()), np.empty(len(v)), np.empty(len(v))
        place[self._q], own_v, own_tau, turned = q, v.copy(), tau.copy(), []
        for address, dofs, ball in self._turning:
            R = rotation(q[address : address + 4])
            own_v[dofs], own_tau[dofs] = R @ v[dofs], R @ tau[dofs]
            turned.append((dofs, R))
            if ball:
                angles = self._math.RollPitchYaw(self._math.RotationMatrix(R)).vector()
                place[self._q[address] : self._q[address] + 3] = angles
        speed[self._v], force[self._v] = own_v, own_tau
        plant.SetPositions(context, place)
        plant.SetVelocities(context, speed)
        plant.get_applied_generalized_force_input_port().FixValue(context, force)
        rates = plant.EvalTimeDerivatives(context).CopyToVector()[plant.num_positions() :]
        if np.any(self._armature):
            inertia = plant.CalcMassMatrix(context) + np.diag(self._armature)
            rates = rates - np.linalg.solve(inertia, self._armature * rates)
        found = rates[self._v]
        for dofs, R in turned:
            found[dofs] = R.T @ found[dofs]
        return found


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the parser's warnings of cameras, lights and the like."""
    log = logging.getLogger("drake")
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(before)
