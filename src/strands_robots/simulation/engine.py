"""MuJoCo, imported in one place after the OpenGL backend is chosen."""

from __future__ import annotations

import importlib
import logging
import sys

from strands_robots.simulation import gl

logger = logging.getLogger(__name__)

_LATE = "mujoco" in sys.modules and gl.undecided()

BACKEND: str = gl.prepare()
"""The OpenGL backend in use: egl, osmesa, disable, the user's own value, or empty for MuJoCo's default."""

import mujoco  # noqa: E402 - MuJoCo reads MUJOCO_GL while it is imported


def _set_context_class() -> None:
    """Correct the context class of a MuJoCo that was imported before the choice."""
    contexts = sys.modules.get("mujoco.rendering.classic.gl_context") or sys.modules.get("mujoco.gl_context")
    if contexts is not None:
        vars(contexts)["GLContext"] = importlib.import_module(f"mujoco.{BACKEND}").GLContext


if _LATE and BACKEND in gl.LIBRARIES:
    _set_context_class()

if mujoco.get_mju_user_warning() is None:
    # By default MuJoCo writes warnings to a file in the current folder.
    mujoco.set_mju_user_warning(lambda message: logger.warning("MuJoCo: %s", message.strip()))

__all__ = ["BACKEND", "mujoco"]
