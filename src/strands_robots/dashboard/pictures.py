"""Pictures of cameras and poses: one stream for all who look at the same."""

from __future__ import annotations

import asyncio
import base64
import time
from collections.abc import AsyncGenerator, Awaitable, Callable
from dataclasses import dataclass, field

from strands_robots.dashboard import poses
from strands_robots.dashboard.feed import FleetFeed
from strands_robots.envelope import Envelope, is_error

LARGE, SMALL = (640, 480), (320, 240)
LARGE_HZ, SMALL_HZ = 12.0, 1.0
ANSWER_S = 5.0
AGAIN_S = 2.0
"""Seconds until a camera that gave no picture is asked again."""

BOUNDARY = b"frame"
STREAMS_MAX = 64


@dataclass(slots=True)
class _Stream:
    viewers: int = 0
    frame: bytes = b""
    number: int = 0
    changed: asyncio.Condition = field(default_factory=asyncio.Condition)
    ended: bool = False
    task: asyncio.Task[None] | None = None


class Pictures:
    """Streams of JPEG pictures by robot, camera and size; on the server's loop."""

    def __init__(self) -> None:
        self.poses = poses.Poses()
        self._closed = False
        self._streams: dict[tuple[str, str, tuple[int, int]], _Stream] = {}

    def camera(
        self, feed: FleetFeed, robot: str, camera: str, size: tuple[int, int] = LARGE, hz: float = LARGE_HZ
    ) -> AsyncGenerator[bytes, None]:
        """Yield the pictures of a camera as they come; a slow reader misses some."""
        params = {"camera": camera, "width": size[0], "height": size[1]}
        key = (f"{feed.network}:{robot}", camera, size)
        return self._frames(key, lambda: feed.call(robot, "getPicture", params, ANSWER_S), hz)

    def pose(self, feed: FleetFeed, robot: str) -> AsyncGenerator[bytes, None]:
        """Yield pictures of a robot's pose, drawn here; a slow reader misses some."""
        # No camera has this size.
        key = (f"{feed.network}:{robot}", "", (0, 0))
        return self._frames(key, lambda: self.poses.picture(feed, robot), poses.HZ)

    async def _frames(
        self, key: tuple[str, str, tuple[int, int]], ask: Callable[[], Awaitable[Envelope]], hz: float
    ) -> AsyncGenerator[bytes, None]:
        stream = self._streams.get(key)
        if stream is None:
            if self._closed or len(self._streams) >= STREAMS_MAX:
                return
            stream = self._streams[key] = _Stream()
            stream.task = asyncio.create_task(_take(stream, ask, hz))
        stream.viewers += 1
        seen = 0
        try:
            while True:
                async with stream.changed:
                    while stream.number == seen and not stream.ended:
                        await stream.changed.wait()
                    if stream.ended:
                        return
                    seen, frame = stream.number, stream.frame
                yield frame
        finally:
            stream.viewers -= 1
            if stream.viewers == 0:
                if self._streams.get(key) is stream:
                    del self._streams[key]
                if stream.task is not None:
                    stream.task.cancel()

    def close(self) -> None:
        """End every stream; its viewers see its end."""
        self._closed = True
        for stream in self._streams.values():
            if stream.task is not None:
                stream.task.cancel()
        self._streams.clear()
        self.poses.close()


async def mjpeg(frames: AsyncGenerator[bytes, None]) -> AsyncGenerator[bytes, None]:
    """Yield the parts of a ``multipart/x-mixed-replace`` answer."""
    async for frame in frames:
        head = b"--%s\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % (BOUNDARY, len(frame))
        # The first part is shown only once the second begins, so every part is followed by a boundary.
        yield head + frame + b"\r\n"


async def _take(stream: _Stream, ask: Callable[[], Awaitable[Envelope]], hz: float) -> None:
    """Ask for pictures until cancelled, then tell the viewers."""
    try:
        while True:
            began = time.monotonic()
            answer = await ask()
            encoded = answer.get("jpeg")
            frame = b"" if is_error(answer) or not isinstance(encoded, str) else _decoded(encoded)
            if not frame:
                await asyncio.sleep(AGAIN_S)
                continue
            async with stream.changed:
                stream.frame, stream.number = frame, stream.number + 1
                stream.changed.notify_all()
            await asyncio.sleep(max(0.0, began + 1.0 / hz - time.monotonic()))
    finally:
        async with stream.changed:
            stream.ended = True
            stream.changed.notify_all()


def _decoded(encoded: str) -> bytes:
    """Return the bytes of a JPEG, empty for anything else."""
    try:
        data = base64.b64decode(encoded, validate=True)
    except ValueError:
        return b""
    return data if data.startswith(b"\xff\xd8\xff") else b""
