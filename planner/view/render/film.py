"""Film: a replay as plain arrays, one row per frame. It can be pickled and drawn in another process.

A replay that ran away stays in its last finite pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from planner.base.arguments import array
from planner.base.errors import PlannerError
from planner.problem.appearance import Appearance, Ghost

if TYPE_CHECKING:
    from planner.model.mechanism import Mechanism
    from planner.proof.replays.contact_history import ContactHistory
    from planner.proof.replays.replaying import Replay
    from planner.proof.robustness.perturbation import Push

# A frame shows the mean force over this time, s: a light foot rings with each simulator step, and an arrow of single
# samples would flicker.
_EXPOSURE = 0.01
_PATH = 240  # poses along the whole motion, for trails and the place of the camera


class Caption(NamedTuple):
    """Words under a film that is shown beside another."""

    mode: str  # open loop or with gains
    verdict: str  # "PASS", "FAIL" or ""
    why: str = ""  # it fails, in a word or two


@dataclass(frozen=True, eq=False)
class Film:
    """Frames of a replay, not yet drawn: F frames, P times along the whole replay, C pairs of shapes that touch."""

    mjcf: str
    appearance: Appearance
    t: np.ndarray  # (F,) s
    qpos: np.ndarray  # (F, nq) of the simulated machine
    ghost_qpos: np.ndarray  # (F, nq) of the ghost: the plan, or the motion that the appearance gives
    forces: np.ndarray  # (F, C, 3) contact forces, in the world
    points: np.ndarray  # (F, C, 3) where they act; NaN without contact
    readings: np.ndarray  # (F, R, 2) the readouts, in the simulation and in the plan
    largest: np.ndarray  # (R,) largest magnitude of each readout in the whole replay
    shift: np.ndarray  # (F, 3) displacement of the camera's point
    path_t: np.ndarray  # (P,) s
    path_qpos: np.ndarray  # (P, nq) of the simulated machine
    path_ghost_qpos: np.ndarray  # (P, nq) of the ghost
    unstable: float = math.inf  # s, when the simulation ran away
    caption: Caption | None = None
    assets: dict[str, bytes] = field(default_factory=dict)  # files that the model's text names
    words: tuple[str, ...] = ()  # under each pose of a strip, in place of its time
    pushes: tuple[Push, ...] = ()  # of the simulated machine

    @classmethod
    def of(cls, replay: Replay, t: np.ndarray, caption: Caption | None = None) -> Film:
        """The frames of a replay at times t (F,), s, linearly between the simulator's steps.

        Raises:
            PlannerError: The replay begins with, or its plan holds, infinite or undefined numbers, or the ghost
                is no motion of this machine.
        """
        from planner.problem.default_appearance import appearance_of  # children that draw a film do without it

        known = _known(replay)
        if known == 0 or not np.all(np.isfinite(replay.plan_xs)):
            name = "plan_xs" if known else "its first state"
            raise PlannerError(f"the replay: {name} holds infinite or undefined numbers; there is nothing to draw.")
        appearance = appearance_of(replay.plan.problem)
        sampled = replay.t[:known]  # beyond, the last pose stays
        xs = interpolate(t, sampled, replay.xs[:known])
        plan_xs = interpolate(t, replay.t, replay.plan_xs)
        indices = [readout.index for readout in appearance.readouts]
        path = np.linspace(replay.t[0], replay.t[-1], _PATH)
        ghost_t, ghost = _ghost(replay, appearance.ghost)
        forces, points = _arrows(replay.contacts, t)
        return cls(
            mjcf=replay.twin.mjcf,
            appearance=replace(appearance, plots=(), pictures=None),  # functions cannot be pickled
            t=t,
            qpos=interpolate(t, sampled, replay.qpos[:known]),
            ghost_qpos=_positions(replay, interpolate(t, ghost_t, ghost)),
            forces=forces,
            points=points,
            readings=np.stack([xs[:, indices], plan_xs[:, indices]], axis=-1),
            largest=np.abs(np.concatenate([replay.xs[:known], replay.plan_xs])[:, indices]).max(axis=0),
            shift=np.zeros((len(xs), 3)) if appearance.accompany is None else xs[:, list(appearance.accompany)],
            path_t=path,
            path_qpos=interpolate(path, sampled, replay.qpos[:known]),
            path_ghost_qpos=_positions(replay, interpolate(path, ghost_t, ghost)),
            unstable=float(replay.t[known]) if known < len(replay.t) else math.inf,
            caption=caption,
            assets=replay.twin.assets,
            pushes=replay.pushes,
        )

    @classmethod
    def of_poses(cls, mechanism: Mechanism, poses: dict[str, np.ndarray]) -> Film:
        """A frame for each pose qpos (nq,) of a machine, by the words under it."""
        from planner.problem.default_appearance import default_appearance

        qpos, none = np.array(list(poses.values())), np.zeros((len(poses), 0, 3))
        t = np.arange(float(len(poses)))
        return cls(
            mjcf=mechanism.mjcf, appearance=replace(default_appearance(mechanism), readouts=(), plots=()), t=t,
            qpos=qpos, ghost_qpos=qpos, forces=none, points=none, readings=np.zeros((len(poses), 0, 2)),
            largest=np.zeros(0), shift=np.zeros((len(poses), 3)), path_t=t, path_qpos=qpos, path_ghost_qpos=qpos,
            assets=mechanism.assets, words=tuple(poses),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.t)

    @property
    def views(self) -> tuple[Film, ...]:
        """The film once for each camera of its appearance."""
        own = self.appearance
        return tuple(replace(self, appearance=own.seen_from(view)) for view in own.views) or (self,)


def _ghost(replay: Replay, ghost: Ghost | None) -> tuple[np.ndarray, np.ndarray]:
    """Times (K,) and states (K, nx) of the ghost."""
    if ghost is None:
        return replay.t, replay.plan_xs
    states = array("the ghost's states", ghost.states, ("K", replay.plan_xs.shape[1]))
    if len(states) < 2:
        raise PlannerError(f"the ghost has {len(states)} states, expected two or more: a motion.")
    return np.linspace(replay.t[0], replay.t[-1], len(states)), states


def _positions(replay: Replay, xs: np.ndarray) -> np.ndarray:
    """(F, nq) of states (F, nx)."""
    return replay.twin.sim_of(xs)[:, : replay.qpos.shape[1]]


def _arrows(contacts: ContactHistory, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Forces and points (F, C, 3) of the contacts at each t."""
    forces, points = np.zeros((len(t), len(contacts.names), 3)), np.full((len(t), len(contacts.names), 3), np.nan)
    for c in range(len(contacts.names)):
        exposure = max(_EXPOSURE, float(contacts.t[1] - contacts.t[0]))  # the samples of a long replay are longer
        points[:, c] = _last_known(t, contacts.t, contacts.points[:, c], exposure)
        for axis in range(3):
            forces[:, c, axis] = _exposed(t, contacts.t, contacts.forces[:, c, axis], exposure)
    return forces, points


def _known(replay: Replay) -> int:
    """Number of samples before the first that is not finite."""
    finite = np.isfinite(replay.qpos).all(axis=1) & np.isfinite(replay.xs).all(axis=1)
    return finite.size if finite.all() else int(np.argmin(finite))


def interpolate(t: np.ndarray | float, knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The values (M+1, k) at the knots (M+1,), linearly at t (F,), or at one time: (F, k) or (k,)."""
    columns = [np.interp(t, knots, column) for column in values.T]
    return np.stack(columns, axis=-1) if columns else np.zeros((*np.shape(t), 0))


def _exposed(t: np.ndarray, knots: np.ndarray, force: np.ndarray, exposure: float) -> np.ndarray:
    """The force (S,) at the knots, averaged over the exposure around each t: (F,)."""
    impulse = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(knots))])
    middle = np.clip(t, knots[0], knots[-1])
    start, end = np.maximum(middle - exposure / 2, knots[0]), np.minimum(middle + exposure / 2, knots[-1])
    return (np.interp(end, knots, impulse) - np.interp(start, knots, impulse)) / (end - start)


def _last_known(t: np.ndarray, knots: np.ndarray, point: np.ndarray, exposure: float) -> np.ndarray:
    """The point (S, 3) at each t: the nearest sample within the exposure that is not NaN, (F, 3)."""
    known = np.flatnonzero(np.all(np.isfinite(point), axis=1))
    if len(known) == 0:
        return np.full((len(t), 3), np.nan)
    after = np.clip(np.searchsorted(knots[known], t), 1, max(len(known) - 1, 1))
    pair = np.stack([known[np.maximum(after - 1, 0)], known[np.minimum(after, len(known) - 1)]], axis=-1)  # (F, 2)
    distance = np.abs(knots[pair] - t[:, None])
    nearest = np.take_along_axis(pair, np.argmin(distance, axis=1)[:, None], axis=1)[:, 0]
    recent = np.min(distance, axis=1) <= exposure
    return np.where(recent[:, None], point[nearest], np.nan)
