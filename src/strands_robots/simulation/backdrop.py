"""The room: floor, sky, lights and the cameras that every world has."""

from __future__ import annotations

from typing import Any

from strands_robots.simulation.engine import mujoco

MAX_WIDTH, MAX_HEIGHT = 1920, 1440
"""Largest picture, in pixels: the size of the off-screen buffer."""


def dress(spec: Any, *, floor: bool, lights: bool) -> None:
    """Add the room to ``spec``; ``floor`` and ``lights`` are false where a robot's model brings its own."""
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = MAX_WIDTH, MAX_HEIGHT
    visual.headlight.active = 1
    visual.headlight.ambient = [0.34, 0.34, 0.36]
    visual.headlight.diffuse = [0.18, 0.18, 0.18]
    visual.headlight.specular = [0.10, 0.10, 0.10]
    visual.rgba.haze = [0.86, 0.89, 0.93, 1]
    # The shadow map covers this much around the middle: a larger one speckles the floor.
    spec.stat.extent = 1.0
    spec.stat.center = [0.1, 0.0, 0.1]
    visual.map.znear, visual.map.zfar = 0.005, 30
    visual.map.shadowclip = 2.2
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.72, 0.83],
        rgb2=[0.93, 0.95, 0.97],
        width=256,
        height=256,
    )
    if floor:
        _floor(spec)
    if lights:
        _lights(spec)
    world = spec.worldbody
    world.add_camera(name="front", pos=[0.95, 0, 0.28], xyaxes=[0, 1, 0, -0.16, 0, 0.987], fovy=45)
    world.add_camera(name="side", pos=[0.15, -0.85, 0.25], xyaxes=[1, 0, 0, 0, 0.12, 0.993], fovy=45)
    world.add_camera(name="top", pos=[0.12, 0, 1.1], xyaxes=[0, -1, 0, 1, 0, 0], fovy=45)


def _lights(spec: Any) -> None:
    world = spec.worldbody
    directional = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    world.add_light(
        name="key", type=directional, pos=[0.8, -0.9, 1.8], dir=[-0.42, 0.42, -0.8], diffuse=[0.55, 0.53, 0.50]
    )
    world.add_light(
        name="fill",
        type=directional,
        pos=[-0.8, 1.0, 1.4],
        dir=[0.5, -0.5, -0.7],
        diffuse=[0.20, 0.22, 0.25],
        castshadow=False,
    )


def _floor(spec: Any) -> None:
    spec.add_texture(
        name="tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=[0.72, 0.74, 0.77],
        rgb2=[0.68, 0.705, 0.74],
        markrgb=[0.60, 0.63, 0.67],
        width=512,
        height=512,
    )
    material = spec.add_material(name="floor", reflectance=0.0, specular=0.1, shininess=0.1)
    material.texrepeat = [5, 5]
    material.texuniform = True
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[4, 4, 0.05], material="floor", friction=[1, 0.005, 0.0001]
    )
