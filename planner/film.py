"""Film: everything a renderer needs to know about a replay, as plain arrays, one row per frame.

Made here from a Replay, drawn elsewhere, perhaps in another process: a film goes into an .npz without pickle.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from planner.errors import PlannerError
from planner.stage import Readout, Stage

if TYPE_CHECKING:
    from planner.replay import Replay

# A frame shows the mean force over this time, s, as a camera's exposure would: a light foot rings with each
# simulator step, and one sample out of that would make the arrow flicker.
_EXPOSURE = 0.01

_ARRAYS = ("t", "qpos", "ghost_qpos", "force", "point", "readings", "largest", "rise")


@dataclass(frozen=True, eq=False)
class Film:
    """Frames of a replay, not yet drawn.

    Attributes:
        mjcf: The model's XML text.
        stage: How it is shown; None shows the whole model, the plan in the same place.
        t: (F,) s.
        qpos: (F, nq) of the simulated machine.
        ghost_qpos: (F, nq) of the plan.
        force: (F,) contact force.
        point: (F, 3) where it acts; NaN without contact.
        readings: (F, R, 2) the readouts, in the simulation and in the plan.
        largest: (R,) largest magnitude of each readout in the whole replay.
        rise: (F,) how far the camera's point is raised.
    """

    mjcf: str
    stage: Stage | None
    t: np.ndarray
    qpos: np.ndarray
    ghost_qpos: np.ndarray
    force: np.ndarray
    point: np.ndarray
    readings: np.ndarray
    largest: np.ndarray
    rise: np.ndarray

    @classmethod
    def of(cls, replay: Replay, t: np.ndarray) -> Film:
        """The frames of a replay at the times t.

        Positions are interpolated linearly between the simulator's steps, which are far shorter than a frame.

        Args:
            replay: What to show.
            t: (F,) s, within the replay.

        Raises:
            PlannerError: The replay holds infinite or undefined numbers.
        """
        for name in ("qpos", "xs", "plan_xs"):
            if not np.all(np.isfinite(getattr(replay, name))):
                raise PlannerError(f"Replay: {name} holds infinite or undefined numbers; there is nothing to draw.")
        stage = stage_of(replay)
        shown = stage or Stage(title="")
        xs = _interpolate(t, replay.t, replay.xs)
        plan_xs = _interpolate(t, replay.t, replay.plan_xs)
        indices = [readout.index for readout in shown.readouts]
        index, fraction = shown.follow or (0, 0.0)
        nq = replay.qpos.shape[1]
        return cls(
            mjcf=replay.twin.mjcf,
            stage=stage,
            t=t,
            qpos=_interpolate(t, replay.t, replay.qpos),
            ghost_qpos=replay.twin.sim_of(plan_xs)[:, :nq],
            force=_exposed(t, replay.t, replay.contact_force),
            point=_last_known(t, replay.t, replay.contact_point),
            readings=np.stack([xs[:, indices], plan_xs[:, indices]], axis=-1),
            largest=np.abs(np.concatenate([replay.xs, replay.plan_xs])[:, indices]).max(axis=0),
            rise=fraction * xs[:, index],
        )

    def __len__(self) -> int:
        return len(self.t)

    def save(self, path: Path, **extra: Any) -> None:
        """Write the film, and JSON values beside it, to an .npz file."""
        stage = None if self.stage is None else asdict(replace(self.stage, plots=()))
        meta = json.dumps({"mjcf": self.mjcf, "stage": stage, "extra": extra})
        np.savez(path, meta=np.array(meta), **{name: getattr(self, name) for name in _ARRAYS})

    @classmethod
    def load(cls, path: Path) -> tuple[Film, dict[str, Any]]:
        """The film in a file that save() wrote, and what was beside it."""
        with np.load(path, allow_pickle=False) as file:
            meta = json.loads(str(file["meta"]))
            arrays = {name: file[name] for name in _ARRAYS}
        stage = meta["stage"]
        if stage is not None:
            stage["readouts"] = tuple(Readout(**readout) for readout in stage["readouts"])
            stage = Stage(**stage)
        return cls(mjcf=meta["mjcf"], stage=stage, **arrays), meta["extra"]


def stage_of(replay: Replay) -> Stage | None:
    """The stage of the replayed problem, if it has one."""
    return getattr(replay.plan.problem, "stage", None)


def _interpolate(t: np.ndarray, knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The values (M+1, k) at the knots (M+1,), linearly at t (F,): (F, k)."""
    columns = [np.interp(t, knots, column) for column in values.T]
    return np.stack(columns, axis=-1) if columns else np.zeros((len(t), 0))


def _exposed(t: np.ndarray, knots: np.ndarray, force: np.ndarray) -> np.ndarray:
    """The force (M+1,) at the knots, averaged over the exposure around each t: (F,)."""
    impulse = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(knots))])
    start = np.clip(t - _EXPOSURE / 2, knots[0], knots[-1])
    end = np.clip(t + _EXPOSURE / 2, knots[0], knots[-1])
    return (np.interp(end, knots, impulse) - np.interp(start, knots, impulse)) / (end - start)


def _last_known(t: np.ndarray, knots: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The point (M+1, 3) at each t: the nearest sample within the exposure that is not NaN, (F, 3)."""
    known = np.flatnonzero(np.all(np.isfinite(point), axis=1))
    if len(known) == 0:
        return np.full((len(t), 3), np.nan)
    after = np.clip(np.searchsorted(knots[known], t), 1, max(len(known) - 1, 1))
    pair = np.stack([known[np.maximum(after - 1, 0)], known[np.minimum(after, len(known) - 1)]], axis=-1)  # (F, 2)
    distance = np.abs(knots[pair] - t[:, None])
    nearest = np.take_along_axis(pair, np.argmin(distance, axis=1)[:, None], axis=1)[:, 0]
    seen = np.min(distance, axis=1) <= _EXPOSURE
    return np.where(seen[:, None], point[nearest], np.nan)
