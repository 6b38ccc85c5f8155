"""What all tests share: those that draw need a headless OpenGL library."""

import pytest

from planner import gl


def pytest_collection_modifyitems(items):
    if gl.backend() is None:
        missing = pytest.mark.skip(reason="no headless OpenGL library: apt-get install libosmesa6")
        for item in items:
            if item.get_closest_marker("render"):
                item.add_marker(missing)
