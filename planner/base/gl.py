"""Choose a headless OpenGL library and import mujoco with it.

MuJoCo reads the environment variable MUJOCO_GL when it is imported, and a library that is not installed makes the
import fail. So only this file imports mujoco, on first use, without OpenGL, and probes the libraries; the one that is
usable is imported with the first picture.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
import os
import sys
from typing import Any

from planner.base.environment import variables_set
from planner.base.errors import RenderingUnavailable

_log = logging.getLogger("planner")

_OFF = ("disable", "disabled", "off", "false", "0")  # values of MUJOCO_GL that disable rendering

# File names of the libraries, as tried by PyOpenGL, which mujoco renders with.
_OSMESA = ("libOSMesa.so", "libOSMesa.so.8", "libOSMesa.so.7", "libOSMesa.so.6")
_EGL = ("libEGL.so", "libEGL.so.1")
_OPENGL = ("libOpenGL.so", "libOpenGL.so.0", "libGL.so", "libGL.so.1")
_drew: list[int] = []  # id of the process that rendered first: in its forks OpenGL would wait forever for its threads


def backend() -> str | None:
    """The first usable value of MUJOCO_GL: the user's, "osmesa" (same pixels on all machines), "egl", or None.

    macOS and Windows always have OpenGL: "native" means that MUJOCO_GL is unchanged.
    """
    if not sys.platform.startswith("linux"):
        return "native"
    wish = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wish in _OFF:
        return None
    return next((name for name in (wish, "osmesa", "egl") if _usable(name)), None)


def load_mujoco() -> Any:
    """Import mujoco with a usable OpenGL library; without one everything but rendering works."""
    if "mujoco" in sys.modules:
        return sys.modules["mujoco"]
    linux = sys.platform.startswith("linux")
    with variables_set({"MUJOCO_GL": "disable"} if linux else {}):  # child processes choose for themselves
        mujoco: Any = importlib.import_module("mujoco")
    if linux and backend() is not None:
        mujoco.GLContext = sys.modules[mujoco.Renderer.__module__].gl_context.GLContext = _context
    if mujoco.get_mju_user_warning() is None:  # MuJoCo's own handler writes a file into the user's folder
        mujoco.set_mju_user_warning(lambda message: _log.info("MuJoCo: %s", message))
    return mujoco


def _context(width: int, height: int) -> Any:
    """An OpenGL context; PyOpenGL, a tenth of a second, is imported with the first one, which few commands need."""
    return importlib.import_module(f"mujoco.{backend()}").GLContext(width, height)


def fatal_error() -> type[Exception]:
    """What MuJoCo raises where it cannot go on, as without memory; MemoryError where it was never loaded."""
    return MemoryError if "mujoco" not in sys.modules else sys.modules["mujoco"].FatalError  # type: ignore[attr-defined]


def load_rollout() -> Any:
    """Import mujoco.rollout, which simulates many models in threads."""
    load_mujoco()
    return importlib.import_module("mujoco.rollout")


def can_render_here() -> bool:
    """Whether this process can render.

    It cannot if mujoco was imported without an OpenGL library before, or in a fork of a process that has rendered.
    """
    if _drew and _drew[0] != os.getpid():
        return False
    chosen = backend()
    if chosen is None or chosen == "native":
        return chosen is not None
    context = getattr(load_mujoco(), "GLContext", None)
    if context is _context:
        return True
    # mujoco.osmesa, mujoco.egl or, at the user's wish, mujoco.glfw; missing or a placeholder without a library
    name = getattr(context, "__module__", "").removeprefix("mujoco.")
    return name in ("osmesa", "egl", chosen) and _usable(name)


def renderer(model: Any, height: int, width: int) -> Any:
    """MuJoCo's Renderer of a model, for pictures of height x width pixels; the caller closes it.

    Raises:
        RenderingUnavailable: OpenGL fails.
    """
    mujoco = load_mujoco()
    if not _drew:
        _drew.append(os.getpid())
    try:
        return mujoco.Renderer(model, height, width)
    except (mujoco.FatalError, RuntimeError, ImportError) as error:
        raise RenderingUnavailable(f"OpenGL refuses to draw: {str(error).splitlines()[0]}.") from error


def require_backend() -> None:
    """Check that an OpenGL library is usable.

    Raises:
        RenderingUnavailable: There is none; the message says what to install.
    """
    if backend() is not None:
        return
    wish = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wish in _OFF:
        raise RenderingUnavailable(f"Rendering is turned off by MUJOCO_GL={wish}; unset it to render.")
    raise RenderingUnavailable(
        "Rendering needs a headless OpenGL library and found none; "
        "install it with: apt-get install libosmesa6 (or, where that is gone, libegl1 libgl1)."
    )


def _usable(name: str) -> bool:
    """Whether mujoco can render after an import with MUJOCO_GL=name."""
    platform = os.environ.get("PYOPENGL_PLATFORM", "").strip().lower()
    if name in ("osmesa", "egl") and platform not in ("", name):
        return False  # mujoco rejects a value that contradicts PyOpenGL's own variable
    if name == "osmesa":
        return _load(_OSMESA) is not None
    if name == "egl":
        return _load(_OPENGL) is not None and _egl_devices() > 0
    # GLFW needs a window system; used only if the user sets it.
    return name == "glfw" and bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _load(names: tuple[str, ...]) -> ctypes.CDLL | None:
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None


def _egl_devices() -> int:
    """Number of EGL devices; 0 if the library has no driver."""
    egl = _load(_EGL)
    if egl is None:
        return 0
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    if not address:
        return 0
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int))(address)
    count = ctypes.c_int(0)
    return count.value if query(0, None, ctypes.byref(count)) else 0
