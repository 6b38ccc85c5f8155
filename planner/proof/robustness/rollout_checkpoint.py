"""Finished rollouts in a file, so that a Monte Carlo that was stopped goes on where it was."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path

import numpy as np

from planner.base.files import file_error, write_atomically
from planner.base.gl import load_mujoco
from planner.proof.robustness.perturbation import Perturbation
from planner.proof.robustness.rollouts import Rollouts

_FORMAT = "perturbed 2"


def fingerprint(rollouts: Rollouts, perturbation: Perturbation, seed: int) -> str:
    """Digest of all that a rollout depends on, which their number does not change."""
    plan, twin, problem = rollouts.plan, rollouts.twin, rollouts.plan.problem
    assert problem is not None  # Rollouts has checked
    version = load_mujoco().__version__
    words = (_FORMAT, version, twin.mjcf, sorted(twin.assets), perturbation, seed, rollouts.step, rollouts.integrator)
    digest = hashlib.sha256(repr(words).encode())
    maps = (twin.to_x, twin.to_x_offset, twin.to_sim, twin.to_sim_offset)
    for array in (plan.t, plan.xs, plan.us, plan.K, problem.x0, *maps):
        digest.update(repr(array.shape).encode() + np.ascontiguousarray(array, dtype=float).tobytes())
    for name in sorted(twin.assets):
        digest.update(twin.assets[name])
    return digest.hexdigest()


class RolloutCheckpoint:
    """Arrays of finished rollouts by name, kept in an .npz when there is a path."""

    def __init__(self, path: Path | None, mark: str) -> None:
        """Read the file; one of another plan, or that cannot be read, counts as none."""
        self._path, self._mark = path, mark
        self.arrays: dict[str, np.ndarray] = {}  # along the first axis, the rollouts in order
        if path is None:
            return
        try:
            with np.load(path, allow_pickle=False) as stored:
                if str(stored["fingerprint"]) == mark:
                    self.arrays = {name: stored[name] for name in stored.files if name != "fingerprint"}
        except FileNotFoundError:
            return
        except OSError as error:
            raise file_error(error, path, verb="read") from error
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile):
            self.arrays = {}

    def add(self, **more: np.ndarray) -> None:
        """Append rollouts, and write all of them to the file."""
        have = self.arrays
        self.arrays = have | {n: np.concatenate([have[n], new]) if n in have else new for n, new in more.items()}
        if self._path is not None:
            with write_atomically(self._path) as hidden:
                np.savez(hidden, fingerprint=np.array(self._mark), **self.arrays)  # type: ignore[arg-type]
