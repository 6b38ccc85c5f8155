"""Pictures of tests take a third of the time: small maps of shadows, and OpenGL's contexts used again."""

import importlib
from collections import defaultdict
from contextlib import contextmanager
from threading import get_ident

import numpy as np
import pytest

from planner.base import gl
from planner.view.render.scene import Scene


@contextmanager
def quick_pictures():
    """Single pictures have the shadows of a film, and a closed context of OSMesa is taken for the next picture.

    MuJoCo's own map of shadows takes as long as all the rest of a picture, and Mesa compiles its shaders anew in each
    context, which takes longer than a small picture.
    """
    with pytest.MonkeyPatch.context() as patch:
        defaults = Scene.__init__.__kwdefaults__ or {}
        patch.setattr(Scene.__init__, "__kwdefaults__", defaults | {"quick": True})
        if gl.backend() == "osmesa":
            gl.load_mujoco()
            osmesa = importlib.import_module("mujoco.osmesa")
            patch.setattr(osmesa, "GLContext", _pooled(osmesa.GLContext))
        yield


def _pooled(context):
    closed = defaultdict(list)  # by thread, in which a context may still be the current one

    class Pooled(context):
        def free(self):
            closed[get_ident()].append(self)

        def __del__(self):
            pass

    def opened(width, height):
        if not closed[get_ident()]:
            return Pooled(width, height)
        again = closed[get_ident()].pop()
        again._width, again._height, again._buffer = width, height, np.zeros((height, width, 4), np.float32)
        return again

    return opened
