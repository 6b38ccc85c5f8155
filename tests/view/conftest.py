"""Pages of made-up proofs have no machine: they have no 3-D view, except in its own tests. Pictures are made quickly."""

import importlib

import numpy as np
import pytest

from planner.base import gl
from planner.view.render.scene import Scene


@pytest.fixture(scope="module", autouse=True)
def _no_view(request):
    with pytest.MonkeyPatch.context() as patch:
        if request.path.name != "test_view_3d.py":
            patch.setattr("planner.view.report.page._view", lambda plan, proof: "")
        yield


@pytest.fixture(scope="session", autouse=True)
def _quick():
    """The shadows of a film for single pictures too, and OpenGL's contexts used again.

    MuJoCo's own map of shadows takes as long as all the rest of a picture, and Mesa compiles its shaders anew in each
    context, which takes four times as long as a small picture.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(Scene.__init__.__kwdefaults__, "quick", True)
        if gl.backend() == "osmesa":
            gl.load_mujoco()
            osmesa = importlib.import_module("mujoco.osmesa")
            patch.setattr(osmesa, "GLContext", _pooled(osmesa.GLContext))
        yield


def _pooled(context):
    free = []

    class Pooled(context):
        def free(self):
            free.append(self)

        def __del__(self):
            pass

    def opened(width, height):
        if not free:
            return Pooled(width, height)
        found = free.pop()
        found._width, found._height = width, height
        found._buffer = np.zeros((height, width, 4), np.float32)
        return found

    return opened
