"""MuJoCo itself, imported in one place so that the OpenGL choice always comes first."""

from __future__ import annotations

from strands_robots.simulation import gl

BACKEND: str = gl.prepare()
"""The OpenGL backend in use: egl, osmesa, disable, the user's own word, or empty for MuJoCo's default."""

import mujoco  # noqa: E402 - MuJoCo reads MUJOCO_GL while it is imported

__all__ = ["BACKEND", "mujoco"]
