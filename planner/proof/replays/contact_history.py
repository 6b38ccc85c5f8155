"""ContactHistory: pairs of geoms in contact during a MuJoCo simulation, contact points and forces.

Forces are those of the forward pass at the beginning of a step: of the state at that instant, not of a Runge-Kutta
stage of the last step. The sum over all contacts is stored at every step, single contacts of a long simulation as means
over several steps, to limit memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.file_law import is_watched
from planner.model.mjcf.model_index import named

MAX_SAMPLES = 20_000  # 10 MB of arrays with a dozen pairs in contact
MAX_PAIRS = 32  # maximum number of pairs with individual forces; a heap of blocks has hundreds
_AT_ONCE = 4096  # contacts summed per call: one by one would be slower than MuJoCo's steps
_CONTACT = np.dtype(
    [("step", int), ("geoms", int, 2), ("point", float, 3), ("frame", float, 9), ("wrench", float, 6),
     ("margin", float), ("distance", float)]
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class ContactHistory:
    """Contact forces between geoms over a simulation; several contact points of a pair count as one contact.

    Attributes:
        names: (C,) the two geoms of each pair ever in contact, e.g. "left heel on belt", in the order of the model.
        t: (S,) s; each sample is the mean of an equal number of simulator steps.
        forces: (S, C, 3) N on the geom named first, in the world frame, friction included.
        points: (S, C, 3) application points in the world frame, weighted by the normal force; NaN without contact.
    """

    names: tuple[str, ...]
    t: np.ndarray
    forces: np.ndarray
    points: np.ndarray

    @classmethod
    def none(cls) -> ContactHistory:
        """The history of a machine without contacts."""
        return cls((), np.zeros(0), np.zeros((0, 0, 3)), np.zeros((0, 0, 3)))


class Touch(NamedTuple):
    """Contact of two geoms over a simulation; depths are relative to the onset of force, in units of length.

    The depth of a pair that makes no force (mjcf.contact_edits.watch) is that of its surfaces.
    """

    geoms: tuple[int, int]
    first: int  # step
    at_start: float  # depth at step 0; 0 without contact
    deepest: float  # over all steps
    force: float  # largest normal force
    last: int  # step
    met_again: float  # largest depth after the two had parted


class ContactRecorder:
    """Records the contacts of a simulation, step by step."""

    def __init__(self, model: Any, steps: int, records: bool | None = None) -> None:
        """For M steps of MuJoCo's model; `records` is False if contacts are not needed."""
        mujoco, self._model = load_mujoco(), model
        self._step, self._forward, self._force_of = mujoco.mj_step, mujoco.mj_forward, mujoco.mj_contactForce
        self._checks = mujoco.mj_checkPos, mujoco.mj_checkVel, mujoco.mj_checkAcc
        self._integrate = _integrating(model)
        self.records = may_touch(model) if records is None else records  # whether contacts are recorded
        self._each = -(-(steps + 1) // MAX_SAMPLES)  # steps per sample
        # Of each pair of geoms (S, 7), by sample: the force's impulse (3,), the normal force, and its moment (3,).
        self._seen: dict[tuple[int, int], np.ndarray] = {}
        self._force = np.zeros(steps + 1)
        self._point = np.full((steps + 1, 3), np.nan)
        self._first: tuple[int, int, int] | None = None
        self._touches: dict[tuple[int, int], Touch] = {}
        self._waiting, self._filled = np.empty(_AT_ONCE if self.records else 0, _CONTACT), 0  # contacts not yet summed
        self._columns = [self._waiting[name] for name in _CONTACT.names or ()]

    @property
    def force(self) -> np.ndarray:
        """(M+1,) sum of the normal contact forces."""
        self._sum_up()
        return self._force

    @property
    def point(self) -> np.ndarray:
        """(M+1, 3) application point of that sum; NaN without contact."""
        self._sum_up()
        return self._point

    @property
    def contact_extremes(self) -> tuple[Touch, ...]:
        """Onset, depths and largest force of each pair of geoms in contact."""
        self._sum_up()
        return tuple(self._touches.values())

    @property
    def first(self) -> tuple[int, int, int] | None:
        """The two geoms of the first contact, and its step."""
        self._sum_up()
        return self._first

    def look(self, i: int, data: Any) -> None:
        """Record the contacts of step i, by a forward pass at the state in `data`."""
        if self.records:
            self._forward(self._model, data)
            self._record(i, data)

    def step(self, i: int, data: Any) -> None:
        """Record the contacts of step i and advance: mj_step in two parts that share one forward pass."""
        model = self._model
        if not self.records:
            self._step(model, data)
            return
        position, velocity, acceleration = self._checks
        position(model, data)
        velocity(model, data)
        self._forward(model, data)
        self._record(i, data)
        acceleration(model, data)
        self._integrate(model, data)

    def _record(self, i: int, data: Any) -> None:
        """Store the contacts of a forward pass in `data`, to be summed later."""
        count = data.ncon
        if not count:
            return
        if self._filled + count > len(self._waiting):
            self._sum_up()
            if count > len(self._waiting):
                self._waiting = np.empty(count, _CONTACT)
                self._columns = [self._waiting[name] for name in _CONTACT.names or ()]
        first, contact = self._filled, data.contact
        self._filled = until = first + count
        steps, geoms, points, frames, wrenches, margins, distances = self._columns
        steps[first:until], geoms[first:until], points[first:until] = i, contact.geom, contact.pos
        frames[first:until], margins[first:until] = contact.frame, contact.includemargin
        distances[first:until] = contact.dist
        for c in range(count):
            self._force_of(self._model, data, c, wrenches[first + c])

    def _sum_up(self) -> None:
        """Add the stored contacts to the sums; those of one step are not separated."""
        contacts, self._filled = self._waiting[: self._filled], 0
        if not len(contacts):
            return
        normal, points = contacts["wrench"][:, 0], contacts["point"]
        at, which = np.unique(contacts["step"], return_inverse=True)
        total = np.bincount(which, weights=normal)
        if self._first is None and np.any(pressed := normal > 0.0):
            (one, other), step = contacts["geoms"][pressed][0], contacts["step"][pressed][0]
            self._first = int(one), int(other), int(step)
        moment = np.stack([np.bincount(which, weights=normal * column) for column in points.T], axis=1)
        self._force[at], loaded = total, total > 0.0
        self._point[at[loaded]] = moment[loaded] / total[loaded, None]
        begins, are_geoms = contacts["margin"], contacts["geoms"].min(axis=1) >= 0  # a flex has no geom
        depths = np.where(is_watched(begins), 0.0, begins) - contacts["distance"]
        deep = (depths > 0.0) & are_geoms
        self._touch(contacts[deep], depths[deep])
        self._by_pairs(contacts[(normal > 0.0) & are_geoms])

    def _touch(self, contacts: np.ndarray, all_depths: np.ndarray) -> None:
        """Update the penetration depths of pairs of geoms, those of the contacts (C,)."""
        pairs, which = np.unique(contacts["geoms"], axis=0, return_inverse=True)
        for k, (one, other) in enumerate(pairs.tolist()):
            depths, steps = all_depths[which == k], contacts["step"][which == k]
            new = Touch((one, other), int(steps[0]), 0.0, 0.0, 0.0, int(steps[0]), 0.0)
            before = self._touches.get((one, other), new)
            parted = before.met_again > 0.0 or np.diff(steps, prepend=before.last) > 1
            again = float(
                np.max(depths, where=np.logical_or.accumulate(np.broadcast_to(parted, steps.shape)), initial=0.0)
            )
            force = max(before.force, float(contacts["wrench"][which == k, 0].max()))
            start = max(before.at_start, float(np.max(depths, where=steps == 0, initial=0.0)))
            deepest = max(before.deepest, float(depths.max()))
            self._touches[one, other] = before._replace(
                at_start=start,
                deepest=deepest,
                force=force,
                last=int(steps[-1]),
                met_again=max(before.met_again, again),
            )

    def _by_pairs(self, contacts: np.ndarray) -> None:
        """Add contacts between geoms to the sums of their pairs."""
        # The force is on the geom whose body comes later in the model: on a foot, not on the belt or world.
        body, geoms = self._model.geom_bodyid, contacts["geoms"]
        sign = np.where(body[geoms[:, 0]] > body[geoms[:, 1]], -1.0, 1.0)[:, None]
        pairs = np.where(sign > 0.0, geoms[:, ::-1], geoms)
        normal = contacts["wrench"][:, :1]
        force = sign * np.einsum("cji,cj->ci", contacts["frame"].reshape(-1, 3, 3), contacts["wrench"][:, :3])
        rows = np.concatenate([force, normal, normal * contacts["point"]], axis=1)
        found, firsts, which = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
        for k in np.argsort(firsts):
            pair = (int(found[k, 0]), int(found[k, 1]))
            if pair not in self._seen:
                if len(self._seen) >= MAX_PAIRS:
                    continue
                self._seen[pair] = np.zeros((-(-len(self._force) // self._each), 7))
            own = which == k
            np.add.at(self._seen[pair], contacts["step"][own] // self._each, rows[own])

    def history(self, t: np.ndarray) -> ContactHistory:
        """The history of all steps, at the times t (M+1,)."""
        self._sum_up()
        names = tuple(f"{self._name(one)} on {self._name(other)}" for one, other in sorted(self._seen))
        if not names:
            return ContactHistory.none()
        S, C = -(-len(t) // self._each), len(names)
        sample = np.arange(len(t)) // self._each
        steps = np.bincount(sample, minlength=S)
        forces, points = np.zeros((S, C, 3)), np.full((S, C, 3), np.nan)
        for c, pair in enumerate(sorted(self._seen)):
            sums = self._seen[pair]
            touching = sums[:, 3] > 0.0
            forces[touching, c] = sums[touching, :3] / steps[touching, None]
            points[touching, c] = sums[touching, 4:] / sums[touching, 3:4]
        return ContactHistory(names, np.bincount(sample, weights=t, minlength=S) / steps, forces, points)

    def sentence(self, timestep: float) -> str:
        """A sentence about the first contact of a machine planned without contacts; "" for none."""
        first = self.first
        if first is None:
            return ""
        one, other, i = first
        shapes = " and ".join(named(self._model, "geom", geom) for geom in (one, other))
        return f"{shapes} touch from t = {i * timestep:.4g} s, of which the plan knows nothing."

    def _name(self, geom: int) -> str:
        model = self._model
        return model.geom(geom).name or model.body(int(model.geom_bodyid[geom])).name or f"geom {geom}"


def _integrating(model: Any) -> Callable[[Any, Any], None]:
    """The second half of mj_step, from accelerations on; chosen once, since a comparison of enums takes as long."""
    mujoco, kind = load_mujoco(), int(model.opt.integrator)
    if kind == int(mujoco.mjtIntegrator.mjINT_RK4):
        return lambda model, data: mujoco.mj_RungeKutta(model, data, 4)
    return mujoco.mj_Euler if kind == int(mujoco.mjtIntegrator.mjINT_EULER) else mujoco.mj_implicit


def may_touch(model: Any) -> bool:
    """Whether two geoms of a model may ever be in contact, by its contact masks."""
    bits = load_mujoco().mjtDisableBit
    if model.opt.disableflags & (bits.mjDSBL_CONTACT | bits.mjDSBL_CONSTRAINT):
        return False
    if model.npair or model.nflex:
        return True
    fits = (model.geom_contype[:, None] & model.geom_conaffinity[None]) != 0
    body = model.body_weldid[model.geom_bodyid]
    return bool(np.any((fits | fits.T) & (body[:, None] != body[None])))
