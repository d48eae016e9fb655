"""3-D poses of arms, drawn from their joints while a page looks."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from strands_robots.dashboard.feed import FleetFeed
from strands_robots.envelope import Envelope, error, is_error, success, text_of

HZ = 5.0
SIZE = (640, 480)
ANSWER_S = 5.0
DRAW_S = 60.0
"""Seconds for one picture; the first loads MuJoCo."""

IDLE_S = 20.0
"""Seconds without a picture after which the process that draws ends."""

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
        size = {"width": SIZE[0], "height": SIZE[1]}
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
