"""A finished run, which several files look at."""

import pytest
from commands import ARM, launch


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """One run of the two-link arm without a film."""
    folder = tmp_path_factory.mktemp("run")
    done = launch("run", *ARM, "--mass2", 0.3, "--no-video", "--out", "out", cwd=folder)
    return folder, done
