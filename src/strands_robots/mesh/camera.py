"""Camera frames as JPEG, off by default and behind a privacy switch that is read before a frame is built."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots import settings
from strands_robots.contract import WorldRobot
from strands_robots.mesh.context import Context
from strands_robots.mesh.topics import camera as camera_topic
from strands_robots.utils import ValidationError, identifier, missing_extra

QUALITY = 80

Frames = Callable[[], Mapping[str, Any]]
"""Gives height x width x 3 arrays of uint8 by camera name."""


def enabled() -> bool:
    """False while the privacy switch is on; a word that is no boolean keeps the cameras off."""
    return not settings.boolean("STRANDS_MESH_CAMERA_DISABLED", safe=True)


def frames_of(robot: Any) -> Frames | None:
    """How to take a picture with each of a robot's cameras; None for one without.

    A robot's own ``camera_frames()`` comes first, then a simulation's ``render``, then the pictures in a device's
    ``get_observation()``. A camera ``arm/wrist`` is called ``arm.wrist`` on the wire, which allows no slash.
    """
    body = getattr(robot, "wrapped", robot)
    own, render, observe = (getattr(body, verb, None) for verb in ("camera_frames", "render", "get_observation"))
    if callable(own):
        return lambda: dict(own())
    if isinstance(robot, WorldRobot) and callable(render):
        return lambda: {str(name).replace("/", "."): render(name) for name in robot.get_features().get("cameras", ())}
    if callable(observe):
        return lambda: {str(name): value for name, value in observe().items() if getattr(value, "ndim", 0) == 3}
    return None


def frame_message(peer_id: str, name: str, now: float, pixels: Any) -> dict[str, Any]:
    """One frame as the wire has it.

    Raises:
        ValidationError: ``pixels`` is no height x width x 3 array of uint8.
        MissingExtraError: Pillow is not installed.
    """
    shape = tuple(getattr(pixels, "shape", ()))
    if len(shape) != 3 or shape[2] != 3 or str(getattr(pixels, "dtype", "")) != "uint8":
        raise ValidationError(f"a frame of {name} must be height x width x 3 of uint8, not {shape}.")
    try:
        from PIL import Image  # noqa: PLC0415 - optional, loaded when a frame is published
    except ImportError:
        raise missing_extra("Publishing camera frames", "sim") from None
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="JPEG", quality=QUALITY)
    return {
        "peer_id": peer_id,
        "cam": name,
        "t": now,
        "shape": list(shape),
        "dtype": "uint8",
        "encoding": "jpeg",
        "data": base64.b64encode(buffer.getvalue()).decode(),
    }


def publish_frames(context: Context, frames: Frames) -> int:
    """Publish one frame of each camera; how many. None is built while the privacy switch is on."""
    if not enabled():
        return 0
    count = 0
    for name, pixels in frames().items():
        message = frame_message(context.peer_id, identifier("camera", name), context.clock(), pixels)
        context.put(camera_topic(context.peer_id, name), message)
        count += 1
    return count
