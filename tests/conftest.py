"""What all tests share: signals that a shell takes away from its background jobs, and a library to draw with."""

import signal

import pytest

from planner.base import gl


def pytest_configure():
    # A shell starts background jobs with Ctrl-C ignored, which they and their children would inherit.
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items):
    if gl.backend() is None:
        missing = pytest.mark.skip(reason="no headless OpenGL library: apt-get install libosmesa6")
        for item in items:
            if item.get_closest_marker("render"):
                item.add_marker(missing)
