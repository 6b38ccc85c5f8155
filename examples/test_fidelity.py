"""A fidelity regression test of your own: `pytest test_fidelity.py` proves every stored plan again.

Store a plan with its measured values once, here by solving; `planner run CASE --out DIR` writes the same files. From
then on a new release of MuJoCo or of the planner that moves a value for the worse fails the test by name.
"""

from pathlib import Path

import pytest

import planner


@pytest.fixture
def plans(tmp_path: Path) -> Path:
    """A folder of plans with their measured values; yours would lie beside the test and be in version control."""
    planner.solve(planner.cases.two_link(horizon=100)).save(tmp_path / "two-link.npz")
    planner.check(tmp_path, update=True)
    return tmp_path


def test_stored_plans_still_hold(plans: Path) -> None:
    for checked in planner.check(plans):
        assert checked.passed, str(checked)
