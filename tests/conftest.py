"""What all tests share: signals that a shell takes away from its background jobs, a drawing library, blank plots."""

import base64
import contextlib
import gc
import os
import signal
import sys
from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from planner.base import gl

PICTURES = {"view", "paper"}  # folders whose tests draw
PIXEL = base64.b64decode("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAAAAAA6fptVAAAACklEQVR4nGP4DwABAQEAsTj2FAAAAABJRU5ErkJggg==")


gc.set_threshold(50_000, 20, 20)  # by default a third of the collection's time goes to a search for garbage


def pytest_configure():
    # A shell starts background jobs with Ctrl-C ignored, which they and their children would inherit.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Parsing the package is a third of a short command: modules stay compiled, as they do for a user.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False


@pytest.fixture(autouse=True)
def _signals():
    """A command that runs in this process takes kills into its own hands: the test run gets them back."""
    before = {kill: signal.getsignal(kill) for kill in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for kill, handler in before.items():
        signal.signal(kill, handler)


@pytest.fixture(autouse=True)
def _blank_plots(request, monkeypatch):
    """Matplotlib takes nine tenths of `planner run`: outside of the tests of pictures its files are a pixel.

    Processes of their own and fixtures of a wider scope draw as ever, and so do tests marked `pictures`.
    """
    if request.path.parent.name in PICTURES or request.node.get_closest_marker("pictures"):
        return

    def write(_, file, *, format=None, **__):
        content = PIXEL if (format or Path(file).suffix[1:]) == "png" else b"<svg xmlns='http://www.w3.org/2000/svg'/>"
        with contextlib.nullcontext(file) if hasattr(file, "write") else open(file, "wb") as opened:
            opened.write(content)

    monkeypatch.setattr(Figure, "savefig", write)
    monkeypatch.setattr(FigureCanvasAgg, "print_png", write)  # which plots.style.save() calls by itself


@pytest.fixture(scope="session")
def quick():
    """For tests marked render."""
    from quick_pictures import quick_pictures

    with quick_pictures():
        yield


@pytest.fixture(autouse=True)
def _quick(request):
    if request.node.get_closest_marker("render"):
        request.getfixturevalue("quick")


def pytest_collection_finish():
    gc.freeze()  # five thousand tests and their modules stay to the end: no search for garbage looks at them again


def pytest_collection_modifyitems(items):
    if gl.backend() is None:
        missing = pytest.mark.skip(reason="no headless OpenGL library: apt-get install libosmesa6")
        for item in items:
            if item.get_closest_marker("render"):
                item.add_marker(missing)
