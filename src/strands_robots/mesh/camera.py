"""Camera frames as JPEG, off by default and behind a privacy switch that is read before a frame is built."""

from __future__ import annotations

import base64
import logging
import math
import time
from typing import Any

from strands_robots import settings
from strands_robots.mesh import topics
from strands_robots.mesh.context import Context
from strands_robots.mesh.topics import camera as camera_topic
from strands_robots.recording.cameras import Frames, jpeg
from strands_robots.utils import identifier, shown

logger = logging.getLogger(__name__)

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


class CameraFeed:
    """Publishes one frame of each camera of a robot; one that fails costs no other its frame, and is told once."""

    def __init__(self, context: Context, frames: Frames) -> None:
        self._context = context
        self._frames = frames
        self._troubles: dict[str, str] = {}

    def publish(self) -> None:
        """One frame of each camera; none is built while the privacy switch is on."""
        if not enabled():
            return
        try:
            seen = self._frames()
        except Exception as exc:  # noqa: BLE001 - a robot's cameras raise what they like
            self._told("its cameras", exc)
            return
        self._told("its cameras", None)
        sent = -math.inf
        for name in seen:
            # The switch may be turned while a slow camera is waited for.
            if not enabled():
                break
            try:
                message = frame_message(
                    self._context.peer_id, identifier("camera", name), self._context.clock(), seen[name]
                )
                time.sleep(max(0.0, sent + SPACING_S - time.monotonic()))
                sent = time.monotonic()
                self._context.put(camera_topic(self._context.peer_id, name), message)
            except Exception as exc:  # noqa: BLE001 - its name, its picture, its size or the link: this frame alone is lost
                self._told(f"the camera {shown(name)}", exc)
            else:
                self._told(f"the camera {shown(name)}", None)

    def _told(self, what: str, exc: Exception | None) -> None:
        # By its kind: the size in the words of a frame that is too large is another one each time.
        kind = "" if exc is None else type(exc).__name__
        if exc is not None and kind != self._troubles.get(what):
            logger.warning("%s publishes nothing of %s: %s: %s", self._context.peer_id, what, kind, exc)
        self._troubles[what] = kind
