"""Which OpenGL MuJoCo renders with, chosen once.

MuJoCo reads ``MUJOCO_GL`` while it is being imported and never again; where somebody imported it earlier,
``engine`` makes up for it. Without a display its default (GLFW)
cannot work, so EGL is taken where its library is there, else OSMesa; a value the user has set is kept
where it can work at all.
"""

from __future__ import annotations

import ctypes
import logging
import platform
from functools import cache

from strands_robots import settings

PACKAGES = "libegl1 libgl1 libgl1-mesa-dri (EGL) or libosmesa6 (OSMesa)"
"""The Debian packages that bring software rendering."""

DISABLED = "disable"

logger = logging.getLogger(__name__)

LIBRARIES = {"egl": ("libEGL.so.1", "libGL.so.1"), "osmesa": ("libOSMesa.so.8",)}


def loads(backend: str) -> bool:
    """True when every shared library of ``backend`` (egl or osmesa) can be loaded."""
    try:
        for library in LIBRARIES[backend]:
            ctypes.CDLL(library)
    except OSError:
        return False
    return True


def undecided() -> bool:
    """True while nobody has said which backend to use."""
    return not settings.is_set("MUJOCO_GL")


@cache
def prepare() -> str:
    """Choose the backend and set ``MUJOCO_GL``: the chosen one, the user's own, or empty for MuJoCo's default."""
    if not undecided():
        asked = settings.raw("MUJOCO_GL").lower()
        if asked not in LIBRARIES or loads(asked):
            return asked
        # MuJoCo would not even import; physics needs no pictures.
        logger.warning("MUJOCO_GL=%s cannot be loaded here; %s.", asked, remedy())
        settings.put("MUJOCO_GL", DISABLED)
        return DISABLED
    if platform.system() != "Linux" or settings.is_set("DISPLAY"):
        return ""
    for backend in LIBRARIES:
        if loads(backend):
            settings.put("MUJOCO_GL", backend)
            return backend
    # Importing GLFW without a display only prints warnings: rendering is not to be had here.
    settings.put("MUJOCO_GL", DISABLED)
    return DISABLED


def remedy() -> str:
    """What to install, or to set, when rendering does not work."""
    if platform.system() == "Linux":
        return f"install the Debian packages {PACKAGES}, or use picture(), which needs no OpenGL"
    return "set MUJOCO_GL to a backend of this platform, or use picture(), which needs no OpenGL"
