"""A finished run, which several files look at."""

import pytest
from commands import launch


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """One run of the hopper without pictures."""
    folder = tmp_path_factory.mktemp("run")
    done = launch("run", "hopper", "--height", 12, "--no-video", "--out", "out", cwd=folder)
    return folder, done
