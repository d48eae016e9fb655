"""MuJoCo, imported in one place after the OpenGL backend is chosen.

MuJoCo reads ``MUJOCO_GL`` once, while it is imported; an import that came too early is repaired here. Without a
display MuJoCo's default (GLFW) cannot work, so EGL is taken where its library is there, else OSMesa. A value of the
user's is kept where it can work at all.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
import platform
import sys
from functools import cache

from strands_robots import settings

PACKAGES = "libegl1 libgl1 libgl1-mesa-dri (EGL) or libosmesa6 (OSMesa)"
"""Debian packages for software rendering."""

DISABLED, WINDOWED = "disable", "glfw"

logger = logging.getLogger(__name__)

LIBRARIES = {"egl": ("libEGL.so.1", "libGL.so.1"), "osmesa": ("libOSMesa.so.8",)}


def loads(backend: str) -> bool:
    """Return True when every library of ``backend`` (egl or osmesa) can be loaded."""
    try:
        for library in LIBRARIES[backend]:
            ctypes.CDLL(library)
    except OSError:
        return False
    return True


def undecided() -> bool:
    """Return True while no backend is set."""
    return not settings.is_set("MUJOCO_GL")


@cache
def prepare() -> str:
    """Choose the backend and set ``MUJOCO_GL``; empty stands for MuJoCo's default."""
    if not undecided():
        wanted = settings.raw("MUJOCO_GL").lower()
        if wanted == WINDOWED and not _display():
            # Its first picture would abort the whole process, robot and all.
            logger.warning("MUJOCO_GL=%s needs a display, and there is none; another backend is taken.", wanted)
            return _without_display()
        if wanted not in LIBRARIES or loads(wanted):
            return wanted
        # MuJoCo would not even import, and physics needs no pictures.
        logger.warning("MUJOCO_GL=%s cannot be loaded here; %s.", wanted, remedy())
        settings.put("MUJOCO_GL", DISABLED)
        return DISABLED
    return "" if _display() else _without_display()


def _display() -> bool:
    return platform.system() != "Linux" or settings.is_set("DISPLAY")


def _without_display() -> str:
    for backend in LIBRARIES:
        if loads(backend):
            settings.put("MUJOCO_GL", backend)
            return backend
    # Importing GLFW without a display only prints warnings, so rendering is disabled.
    settings.put("MUJOCO_GL", DISABLED)
    return DISABLED


def remedy() -> str:
    """Return what to install or to set when rendering does not work."""
    if platform.system() == "Linux":
        return f"install the Debian packages {PACKAGES}, or use picture(), which needs no OpenGL"
    return "set MUJOCO_GL to a backend of this platform, or use picture(), which needs no OpenGL"


_LATE = "mujoco" in sys.modules and undecided()

BACKEND: str = prepare()
"""The OpenGL backend in use: egl, osmesa, disable, the user's own value, or empty for MuJoCo's default."""

import mujoco  # noqa: E402 - MuJoCo reads MUJOCO_GL while it is imported

_contexts = sys.modules.get("mujoco.rendering.classic.gl_context") or sys.modules.get("mujoco.gl_context")
if _LATE and BACKEND in LIBRARIES and _contexts is not None:
    # The context class of a MuJoCo that was imported before the choice.
    vars(_contexts)["GLContext"] = importlib.import_module(f"mujoco.{BACKEND}").GLContext

if mujoco.get_mju_user_warning() is None:
    # By default MuJoCo writes warnings to a file in the current folder.
    mujoco.set_mju_user_warning(lambda message: logger.warning("MuJoCo: %s", message.strip()))

__all__ = ["BACKEND", "LIBRARIES", "PACKAGES", "loads", "mujoco", "prepare", "remedy"]
