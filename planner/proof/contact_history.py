"""ContactHistory: which shapes touch while MuJoCo simulates, where, and with what force.

Forces are those of the forward pass with which a step begins: of the state at that instant, not of a stage of the last
step. The sum over all contacts is kept at every step. Of single contacts a long simulation keeps means over
several steps, so that memory stays within bounds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.survey import named

MOST_SAMPLES = 20_000  # 10 MB of arrays where a dozen pairs of shapes touch
MOST_PAIRS = 32  # with a force of their own; a heap of blocks has hundreds


@dataclass(frozen=True, eq=False)
class ContactHistory:
    """Forces between shapes over a simulation; a pair of shapes may touch at several points, which count as one.

    Attributes:
        names: (C,) the two shapes of each pair that ever touched, e.g. "left heel on belt", in the order of the model.
        t: (S,) s; each sample is the mean of as many steps of the simulator.
        forces: (S, C, 3) on the shape named first, in the world, friction included.
        points: (S, C, 3) where they act, in the world: the mean weighted by the normal force; NaN without contact.
    """

    names: tuple[str, ...]
    t: np.ndarray
    forces: np.ndarray
    points: np.ndarray

    @classmethod
    def none(cls) -> ContactHistory:
        """The history of a machine that touches nothing."""
        return cls((), np.zeros(0), np.zeros((0, 0, 3)), np.zeros((0, 0, 3)))


class Touch(NamedTuple):
    """The contact of two geoms over a simulation; depths count from where force begins, in units of length."""

    geoms: tuple[int, int]
    first: int  # step
    at_start: float  # depth at step 0; 0 where they do not touch there
    deepest: float  # over all steps


class ContactRecorder:
    """Records the contacts of a simulation, step by step."""

    def __init__(self, model: Any, steps: int, records: bool | None = None) -> None:
        """For M steps of MuJoCo's model; `records` is False where nobody asks for contacts."""
        self._mujoco, self._model = load_mujoco(), model
        self.records = may_touch(model) if records is None else records  # whether there is anything to record
        self._each = -(-(steps + 1) // MOST_SAMPLES)  # steps per sample
        # Of each pair of geoms, by sample: the force's impulse (3,), the normal force, and its moment (3,).
        self._seen: dict[tuple[int, int], dict[int, np.ndarray]] = {}
        self.force = np.zeros(steps + 1)  # sum of the normal contact forces
        self.point = np.full((steps + 1, 3), np.nan)  # where it acts; NaN without contact
        self.touches: dict[tuple[int, int], Touch] = {}  # of each pair of geoms
        self.first: tuple[int, int, int] | None = None  # the two geoms of the first contact, and its step

    def look(self, i: int, data: Any) -> None:
        """Record the contacts of step i, by a forward pass at the state that `data` has."""
        if self.records:
            self._mujoco.mj_forward(self._model, data)
            self._record(i, data)

    def step(self, i: int, data: Any) -> None:
        """Record the contacts of step i and take it: mj_step in its parts, so that one forward pass serves both."""
        mujoco, model = self._mujoco, self._model
        if not self.records:
            mujoco.mj_step(model, data)
            return
        mujoco.mj_checkPos(model, data)
        mujoco.mj_checkVel(model, data)
        self.look(i, data)
        mujoco.mj_checkAcc(model, data)
        kinds = mujoco.mjtIntegrator
        if model.opt.integrator == kinds.mjINT_RK4:
            mujoco.mj_RungeKutta(model, data, 4)
        elif model.opt.integrator == kinds.mjINT_EULER:
            mujoco.mj_Euler(model, data)
        else:
            mujoco.mj_implicit(model, data)

    def _record(self, i: int, data: Any) -> None:
        """The contacts that a forward pass has left in `data`."""
        mujoco, model = self._mujoco, self._model
        total, moment, wrench = 0.0, np.zeros(3), np.zeros(6)
        for c in range(data.ncon):
            contact = data.contact[c]
            mujoco.mj_contactForce(model, data, c, wrench)
            total += wrench[0]
            moment += wrench[0] * contact.pos
            one, other = (int(geom) for geom in contact.geom)
            if self.first is None:
                self.first = one, other, i
            self._touch(i, (one, other), float(contact.includemargin - contact.dist))
            if wrench[0] > 0.0 and min(one, other) >= 0:  # a flex has no geom
                self._add(i // self._each, one, other, contact.frame.reshape(3, 3).T @ wrench[:3], wrench[0], contact)
        self.force[i] = total
        if total > 0.0:
            self.point[i] = moment / total

    def history(self, t: np.ndarray) -> ContactHistory:
        """The history of all steps, at the times t (M+1,)."""
        names = tuple(f"{self._name(one)} on {self._name(other)}" for one, other in sorted(self._seen))
        if not names:
            return ContactHistory.none()
        S, C = -(-len(t) // self._each), len(names)
        sample = np.arange(len(t)) // self._each
        steps = np.bincount(sample, minlength=S)
        forces, points = np.zeros((S, C, 3)), np.full((S, C, 3), np.nan)
        for c, pair in enumerate(sorted(self._seen)):
            for s, sums in self._seen[pair].items():
                forces[s, c] = sums[:3] / steps[s]
                points[s, c] = sums[4:] / sums[3]
        return ContactHistory(names, np.bincount(sample, weights=t, minlength=S) / steps, forces, points)

    def sentence(self, timestep: float) -> str:
        """The first contact of a machine that was planned without any; "" for none."""
        if self.first is None:
            return ""
        one, other, i = self.first
        shapes = " and ".join(named(self._model, "geom", geom) for geom in (one, other))
        return f"{shapes} touch from t = {i * timestep:.4g} s, of which the plan knows nothing."

    def _touch(self, i: int, geoms: tuple[int, int], depth: float) -> None:
        """Remember how deep two geoms are in each other at step i."""
        if depth <= 0.0 or min(geoms) < 0:  # a flex has no geom
            return
        before = self.touches.get(geoms)
        if before is None:
            self.touches[geoms] = Touch(geoms, i, depth if i == 0 else 0.0, depth)
        else:
            start = max(before.at_start, depth) if i == 0 else before.at_start
            self.touches[geoms] = Touch(geoms, before.first, start, max(before.deepest, depth))

    def _add(self, sample: int, one: int, other: int, force: np.ndarray, normal: float, contact: Any) -> None:
        """A contact's force on `other`."""
        # It is told of the shape whose body comes later in the model: of a foot, not of the belt or world under it.
        body = self._model.geom_bodyid
        if body[one] > body[other]:
            one, other, force = other, one, -force
        if (other, one) not in self._seen and len(self._seen) >= MOST_PAIRS:
            return
        sums = self._seen.setdefault((other, one), {}).setdefault(sample, np.zeros(7))
        sums += (*force, normal, *(normal * contact.pos))

    def _name(self, geom: int) -> str:
        model = self._model
        return model.geom(geom).name or model.body(int(model.geom_bodyid[geom])).name or f"geom {geom}"


def may_touch(model: Any) -> bool:
    """Whether two geoms of a model could ever make contact, as far as its masks tell."""
    bits = load_mujoco().mjtDisableBit
    if model.opt.disableflags & (bits.mjDSBL_CONTACT | bits.mjDSBL_CONSTRAINT):
        return False
    if model.npair or model.nflex:
        return True
    fits = (model.geom_contype[:, None] & model.geom_conaffinity[None]) != 0
    body = model.body_weldid[model.geom_bodyid]
    return bool(np.any((fits | fits.T) & (body[:, None] != body[None])))
