"""What all tests share: those that draw need a headless OpenGL library."""

import inspect

import pytest

from planner.base import gl
from planner.proof.verdict import prove


@pytest.fixture(autouse=True, scope="session")
def _proofs_without_rollouts():
    """Proofs take their 512 perturbed rollouts, some seconds each, only in the tests that ask for them."""
    inspect.unwrap(prove).__kwdefaults__["rollouts"] = 0


def pytest_collection_modifyitems(items):
    if gl.backend() is None:
        missing = pytest.mark.skip(reason="no headless OpenGL library: apt-get install libosmesa6")
        for item in items:
            if item.get_closest_marker("render"):
                item.add_marker(missing)
