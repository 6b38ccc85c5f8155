"""The pytest fixture assert_plan_holds(plan, model): a stored plan is proved again, and fails with what changed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import pytest

if TYPE_CHECKING:  # every run of pytest loads this file, and few of them prove a plan
    from planner.sweeps.regression import PlanComparison


class AssertPlanHolds(Protocol):
    """What the fixture gives: see assert_plan_holds."""

    def __call__(
        self, plan: str | Path, model: str | Path | None = None, *, tolerances: Mapping[str, float] | None = None
    ) -> PlanComparison:
        """The plan proved again; the test has failed unless it holds."""
        ...


@pytest.fixture
def assert_plan_holds() -> AssertPlanHolds:
    """A function that fails the test unless a stored plan still holds.

    assert_plan_holds("plan.npz", "arm.urdf", tolerances={"rad": 0.1}) proves the plan again, as `planner check` does,
    and wants: nothing worse than the numbers stored beside it, PASS, the model as it was (MJCF or URDF; by default the
    one that the plan was made from), and no tolerance in the plan's file above those of `tolerances`, by unit; a file
    with default tolerances alone needs none. It returns the PlanComparison.
    """
    return _assert_plan_holds


def _assert_plan_holds(
    plan: str | Path, model: str | Path | None = None, *, tolerances: Mapping[str, float] | None = None
) -> PlanComparison:
    from planner.base.errors import PlannerError
    from planner.sweeps.regression import check
    from planner.sweeps.stored_model import ModelState

    __tracebackhide__ = True
    if Path(plan).is_dir():
        pytest.fail(f"{plan} is a folder, expected one plan.npz: one test for each plan.")
    try:
        (found,) = check(plan, model=model)
    except PlannerError as error:
        pytest.fail(str(error))
    if not found.passed or found.proof is None or not found.proof.passed:
        pytest.fail(str(found))
    if found.model is None or found.model.state is ModelState.UNREAD:
        pytest.fail(f'{found.line}. Expected a model to compare with: assert_plan_holds("{plan}", "FILE").')
    allowed = dict(tolerances or {})
    wider = {unit: value for unit, value in found.tolerances.items() if value > allowed.get(unit, 0.0)}
    if wider:
        asked = ", ".join(f"{value:g} {unit}" for unit, value in wider.items())
        pytest.fail(
            f"{plan} asks for a tolerance of {asked}, which the test does not know of: expected "
            f"tolerances={allowed | wider} in the test if that is meant."
        )
    return found
