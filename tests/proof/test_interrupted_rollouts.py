"""Step 5 of a proof: rollouts that were interrupted go on, and none is lost or taken for another's."""

from itertools import pairwise

import numpy as np
import pytest
from rolled_out_plans import coarse, ends

from planner.base.errors import FileError
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.monte_carlo import RolloutCheckpoint
from planner.proof.robustness.perturbed import MonteCarloSettings, perturbed
from planner.proof.robustness.rollouts import MODES, Rollouts
from planner.proof.robustness.success import SuccessRule

ALL = SuccessRule("always", lambda ends: np.ones(len(ends), dtype=bool))


def test_an_interrupted_run_loses_nothing(tree, tmp_path, monkeypatch):
    twin, path, seen = coarse(tree), tmp_path / "rollouts.npz", []
    whole = perturbed(tree, twin, MonteCarloSettings(24, rule=ALL), progress=lambda *counts: seen.append(counts))
    assert seen[0] == (16, 16 + 8 + 24 + 2 * 4 * 20)  # the first look, the second, open loop, the margins' most
    assert all(later <= former for (_, former), (_, later) in pairwise(seen))
    assert seen[-1][0] == seen[-1][1]

    def stop(done, total):
        if done == 32:  # of 16 and 8 with gains: eight of open loop
            raise KeyboardInterrupt

    monkeypatch.setattr(Rollouts, "batch_size", 8)
    with pytest.raises(KeyboardInterrupt):
        perturbed(tree, twin, MonteCarloSettings(24, rule=ALL), partial=path, progress=stop)
    monkeypatch.undo()
    ran = []
    monkeypatch.setattr(Rollouts, "run", lambda self, batch, mode, *rest, run=Rollouts.run: (
        ran.append((len(batch.models), mode)), run(self, batch, mode, *rest))[1])  # fmt: skip
    resumed = perturbed(tree, twin, MonteCarloSettings(24, rule=ALL), partial=path)
    assert ran[0] == (16, "open-loop")
    assert sum(number for number, _ in ran) == seen[-1][0] - 32
    assert resumed.to_dict() == whole.to_dict()
    for mode in MODES:
        np.testing.assert_array_equal(resumed.fans[mode], whole.fans[mode])
    ran.clear()
    perturbed(tree, twin, MonteCarloSettings(20, rule=ALL), partial=path)
    assert not ran


def test_other_rollouts_are_not_taken_for_these(tree, tmp_path):
    twin, path = coarse(tree), tmp_path / "rollouts.npz"
    perturbed(tree, twin, MonteCarloSettings(2, seed=1), partial=path)
    other = perturbed(tree, twin, MonteCarloSettings(2, seed=2), partial=path)
    np.testing.assert_array_equal(ends(other), ends(perturbed(tree, twin, MonteCarloSettings(2, seed=2))))
    path.write_bytes(b"no archive")
    np.testing.assert_array_equal(ends(other), ends(perturbed(tree, twin, MonteCarloSettings(2, seed=2), partial=path)))
    with pytest.raises(FileError):
        RolloutCheckpoint(tmp_path, "mark")


def test_a_budget_stops(arm):
    none = perturbed(arm, CompiledTwin(arm.twin), MonteCarloSettings(16), budget=1e-6)
    assert none.done == 0
    assert "Stopped after" in none.section.not_applicable
    assert not np.isfinite(none.margin["feedback"])
    assert none.to_dict()["rollouts"] == {"asked": 16, "done": 0}
    assert none.robustness == "undecided"
    assert none.section.passed
