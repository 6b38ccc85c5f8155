"""Headless OpenGL: which library draws, and importing mujoco so that it finds it.

MuJoCo decides when it is imported, from the environment variable MUJOCO_GL, how it will draw. Set later, the
variable does nothing; set to a library that is not installed, the import itself dies. So this is the one place
where planner imports mujoco, after looking at what is installed, and never before someone needs it.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
import os
import sys
from typing import Any

from planner.base.errors import RenderingUnavailable

_log = logging.getLogger("planner")

# What MUJOCO_GL may be set to in order to have no drawing at all.
_OFF = ("disable", "disabled", "off", "false", "0")

# File names that the dynamic loader knows the libraries by. PyOpenGL, which mujoco draws through, tries the same.
_OSMESA = ("libOSMesa.so", "libOSMesa.so.8", "libOSMesa.so.7", "libOSMesa.so.6")
_EGL = ("libEGL.so", "libEGL.so.1")
_OPENGL = ("libOpenGL.so", "libOpenGL.so.0", "libGL.so", "libGL.so.1")


def backend() -> str | None:
    """The value of MUJOCO_GL that works here, or None when nothing does.

    The user's own MUJOCO_GL comes first if it is usable, then "osmesa" (software, the same pixels everywhere),
    then "egl". On macOS and Windows the system always has OpenGL, and the answer is "native": leave MUJOCO_GL alone.
    """
    if not sys.platform.startswith("linux"):
        return "native"
    wish = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wish in _OFF:
        return None
    return next((name for name in (wish, "osmesa", "egl") if _usable(name)), None)


def load_mujoco() -> Any:
    """The module mujoco, imported ready to draw if anything here can; without that everything but drawing works."""
    if "mujoco" in sys.modules:
        return sys.modules["mujoco"]
    chosen = backend()
    before = os.environ.get("MUJOCO_GL")
    if chosen != "native":
        os.environ["MUJOCO_GL"] = chosen or "disable"
    try:
        mujoco: Any = importlib.import_module("mujoco")
    finally:
        # The choice is this process's. A child, or the user's next program, shall choose for itself.
        if before is None:
            os.environ.pop("MUJOCO_GL", None)
        else:
            os.environ["MUJOCO_GL"] = before
    if mujoco.get_mju_user_warning() is None:  # MuJoCo's own handler writes a file into the user's folder
        mujoco.set_mju_user_warning(lambda message: _log.info("MuJoCo: %s", message))
    return mujoco


def load_rollout() -> Any:
    """The module mujoco.rollout, which simulates many models at once on threads of its own."""
    load_mujoco()
    return importlib.import_module("mujoco.rollout")


def can_render_here() -> bool:
    """Whether this process can draw. False if mujoco came in before us without a library to draw with."""
    chosen = backend()
    if chosen is None or chosen == "native":
        return chosen is not None
    context = getattr(load_mujoco(), "GLContext", None)
    # mujoco.osmesa or mujoco.egl, and mujoco.glfw when the user wants it; missing or a placeholder without any.
    name = getattr(context, "__module__", "").removeprefix("mujoco.")
    return name in ("osmesa", "egl", chosen) and _usable(name)


def require_backend() -> None:
    """Do nothing if something here can draw.

    Raises:
        RenderingUnavailable: Nothing can; the sentence says what to install.
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
    """Whether mujoco, imported with MUJOCO_GL=name, would draw."""
    platform = os.environ.get("PYOPENGL_PLATFORM", "").strip().lower()
    if name in ("osmesa", "egl") and platform not in ("", name):
        return False  # mujoco refuses to argue with PyOpenGL's own variable
    if name == "osmesa":
        return _load(_OSMESA) is not None
    if name == "egl":
        return _load(_OPENGL) is not None and _egl_devices() > 0
    # Only if the user asks for it by name: a window system draws too.
    return name == "glfw" and bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _load(names: tuple[str, ...]) -> ctypes.CDLL | None:
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None


def _egl_devices() -> int:
    """How many devices EGL offers. The library alone is not enough: it may come without any driver."""
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
