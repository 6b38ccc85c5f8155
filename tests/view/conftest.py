"""Pages of made-up proofs have no machine: they have no 3-D view, except in its own tests."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def _no_view(request):
    with pytest.MonkeyPatch.context() as patch:
        if request.path.name != "test_view_3d.py":
            patch.setattr("planner.view.report.page._view", lambda plan, proof: "")
        yield
