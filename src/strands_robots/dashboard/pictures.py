"""Pictures of cameras and poses: one stream for all who look at the same."""

from __future__ import annotations

import asyncio
import base64
import json
import subprocess
import sys
import threading
import time
from collections.abc import AsyncGenerator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from strands_robots.dashboard.feeds import FleetFeed
from strands_robots.envelope import Envelope, error, is_error, success, text_of

LARGE, SMALL = (640, 480), (320, 240)
LARGE_HZ, POSE_HZ, SMALL_HZ = 12.0, 5.0, 1.0
ANSWER_S = 5.0
DRAW_S = 60.0
"""Seconds for one picture; the first loads MuJoCo."""

IDLE_S = 20.0
"""Seconds without a picture after which the process that draws ends."""

AGAIN_S = 2.0
"""Seconds until a camera that gave no picture is asked again."""

BOUNDARY = b"frame"
STREAMS_MAX = 64

CLOSED = "The page's server ends."

PROGRAM = (sys.executable, "-m", "strands_robots.dashboard.pose_process")


class Poses:
    """Pictures of arms, drawn by one process while they are asked for."""

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="dashboard-poses")
        self._process: subprocess.Popen[str] | None = None
        self._closed, self._starting = threading.Event(), threading.Lock()
        self._idle: asyncio.TimerHandle | None = None

    async def picture(self, feed: FleetFeed, robot: str) -> Envelope:
        """Return ``jpeg`` of a robot as its joints are, or an error with the reason."""
        pose = await feed.call(robot, "getPose", {}, ANSWER_S)
        if is_error(pose):
            return error(text_of(pose)[:300])
        if self._closed.is_set():
            return error(CLOSED)
        loop = asyncio.get_running_loop()
        order = {name: pose.get(name) for name in ("model", "joints", "gripper")}
        size = {"width": LARGE[0], "height": LARGE[1]}
        drawn = await loop.run_in_executor(self._thread, self._drawn, json.dumps({**order, **size}, default=str))
        if self._idle is not None:
            self._idle.cancel()
        if self._closed.is_set():
            return error(CLOSED)
        self._idle = loop.call_later(IDLE_S, self._thread.submit, self._end)
        if "jpeg" not in drawn:
            return error(str(drawn.get("error"))[:300])
        return success("The pose.", jpeg=drawn["jpeg"])

    def close(self) -> None:
        """End the process, even one that is stuck, and draw no more."""
        with self._starting:
            if self._closed.is_set():
                return
            self._closed.set()
            process = self._process
        if process is not None:
            process.kill()  # the thread may be waiting for its answer
        if self._idle is not None:
            self._idle.cancel()
        self._thread.submit(self._end)
        self._thread.shutdown(wait=False, cancel_futures=False)

    # On the thread.

    def _drawn(self, order: str) -> dict[str, Any]:
        try:
            process = self._started()
        except OSError as exc:
            return {"error": f"The process that draws the pose cannot start: {exc}"}
        if process is None:
            return {"error": CLOSED}
        assert process.stdin is not None and process.stdout is not None
        late = threading.Timer(DRAW_S, process.kill)
        late.start()
        try:
            process.stdin.write(order + "\n")
            process.stdin.flush()
            drawn: dict[str, Any] = json.loads(process.stdout.readline())
        except (OSError, ValueError):
            self._end()
            return {"error": "The process that draws the pose ended."}
        finally:
            late.cancel()
        return drawn

    def _started(self) -> subprocess.Popen[str] | None:
        """Return the process, or None once this is closed."""
        with self._starting:
            if self._process is None and not self._closed.is_set():
                self._process = subprocess.Popen(
                    PROGRAM, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
                )
            return self._process

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.communicate()  # closes its pipes, too


class TimedPicture(NamedTuple):
    """A JPEG picture, and when it was taken, in monotonic seconds of this process.

    The robot's clock is not compared: that is halfway between the question and the answer.
    """

    jpeg: bytes
    taken: float


@dataclass(slots=True)
class _Stream:
    viewers: int = 0
    frame: bytes = b""
    taken: float = 0.0
    number: int = 0
    changed: asyncio.Condition = field(default_factory=asyncio.Condition)
    ended: bool = False
    task: asyncio.Task[None] | None = None


class Pictures:
    """Streams of JPEG pictures by robot, camera and size; on the server's loop."""

    def __init__(self) -> None:
        self.poses = Poses()
        self._closed = False
        self._streams: dict[tuple[str, str, tuple[int, int]], _Stream] = {}

    def camera(
        self, feed: FleetFeed, robot: str, camera: str, size: tuple[int, int] = LARGE, hz: float = LARGE_HZ
    ) -> AsyncGenerator[TimedPicture, None]:
        """Yield the pictures of a camera as they come; a slow reader misses some."""
        params = {"camera": camera, "width": size[0], "height": size[1]}
        key = (f"{feed.network}:{robot}", camera, size)
        return self._frames(key, lambda: feed.call(robot, "getPicture", params, ANSWER_S), hz)

    def pose(self, feed: FleetFeed, robot: str) -> AsyncGenerator[TimedPicture, None]:
        """Yield pictures of a robot's pose, drawn here; a slow reader misses some."""
        # No camera has this size.
        key = (f"{feed.network}:{robot}", "", (0, 0))
        return self._frames(key, lambda: self.poses.picture(feed, robot), POSE_HZ)

    async def _frames(
        self, key: tuple[str, str, tuple[int, int]], ask: Callable[[], Awaitable[Envelope]], hz: float
    ) -> AsyncGenerator[TimedPicture, None]:
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
                    seen, picture = stream.number, TimedPicture(stream.frame, stream.taken)
                yield picture
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


async def mjpeg(pictures: AsyncGenerator[TimedPicture, None]) -> AsyncGenerator[bytes, None]:
    """Yield the parts of a ``multipart/x-mixed-replace`` answer."""
    async for frame, _ in pictures:
        head = b"--%s\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % (BOUNDARY, len(frame))
        # The first part is shown only once the second begins, so every part is followed by a boundary.
        yield head + frame + b"\r\n"


async def _take(stream: _Stream, ask: Callable[[], Awaitable[Envelope]], hz: float) -> None:
    """Ask for pictures until cancelled, then tell the viewers."""
    try:
        while True:
            began = time.monotonic()
            answer = await ask()
            taken = (began + time.monotonic()) / 2
            encoded = answer.get("jpeg")
            frame = b"" if is_error(answer) or not isinstance(encoded, str) else _decoded(encoded)
            if not frame:
                await asyncio.sleep(AGAIN_S)
                continue
            async with stream.changed:
                stream.frame, stream.taken, stream.number = frame, taken, stream.number + 1
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
