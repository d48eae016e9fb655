"""Camera frames as JPEG, off by default and behind a privacy switch that is read before a frame is built."""

from __future__ import annotations

import base64
import math
import time
from typing import Any

from strands_robots import settings
from strands_robots.cameras import Frames, jpeg
from strands_robots.mesh import topics
from strands_robots.mesh.context import Context
from strands_robots.mesh.topics import camera as camera_topic
from strands_robots.utils import identifier

SPACING_S = 1.5 / (topics.BY_NAME["camera"].ceiling_hz or math.inf)
"""Between the frames of two cameras: the transport drops what comes closer on any of them."""


def enabled() -> bool:
    """False while the privacy switch is on; a word that is no boolean keeps the cameras off."""
    return not settings.boolean("STRANDS_MESH_CAMERA_DISABLED", safe=True)


def frame_message(peer_id: str, name: str, now: float, pixels: Any) -> dict[str, Any]:
    """One frame as the wire has it.

    Raises:
        ValidationError: ``pixels`` is no height x width x 3 array of uint8.
        MissingExtraError: Pillow is not installed.
    """
    encoded = jpeg(name, pixels)
    return {
        "peer_id": peer_id,
        "cam": name,
        "t": now,
        "shape": list(pixels.shape),
        "dtype": "uint8",
        "encoding": "jpeg",
        "data": base64.b64encode(encoded).decode(),
    }


def publish_frames(context: Context, frames: Frames) -> int:
    """Publish one frame of each camera; how many. None is built while the privacy switch is on."""
    if not enabled():
        return 0
    count, sent = 0, 0.0
    for name, pixels in frames().items():
        message = frame_message(context.peer_id, identifier("camera", name), context.clock(), pixels)
        time.sleep(max(0.0, sent + SPACING_S - time.monotonic()))
        sent = time.monotonic()
        context.put(camera_topic(context.peer_id, name), message)
        count += 1
    return count
