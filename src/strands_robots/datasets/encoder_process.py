"""Process that encodes a recorder's cameras.

Orders come as lines of JSON over the socket whose descriptor is its argument, pictures in memory that both processes
share. For each moment of the attempt's grid it encodes the newest picture that had arrived. It ends when the recorder
does.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import select
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from strands_robots.datasets.encoded import ROW, ROWS, VIDEO, write_statistics
from strands_robots.datasets.video import GROUP, VideoWriter, decoded
from strands_robots.errors import StrandsRobotsError

NICENESS = 5
"""Of a thread that hurries, and of the process where threads have none of their own."""

HURRY_S, CAUGHT_UP_S = 2.0, 0.2
"""So far behind the clock it begins to hurry, and ends to."""

MARGIN_S = 0.005
"""Time after a moment for which a picture of that moment may still be copied."""

BEHIND_S = 30.0
"""It gives the attempt up where it is so far behind the clock."""

BEFORE = 2 / 3
"""Share of a period by which the first picture comes before the first moment.

Cameras are read at the same rate: far from a moment, a picture that is a little early or late is still that of its own.
"""

SOON_S = 1e-5

SLOTS = 8
"""Pictures of a camera that may wait here."""

FREE, USED = b"\0", 1
"""Byte of a slot, behind all slots: the recorder sets it before its order, and this process once it has the picture."""


def memory_bytes(size: int) -> int:
    """Return the memory of a camera whose pictures have up to ``size`` bytes."""
    return SLOTS * (size + 1)


class _Camera:
    """One camera of the running attempt.

    Args:
        video: written.
        fps: pictures a second.
        memory: of its pictures, ``size`` bytes each.
        sides: width and height of pixels; None of pictures that come as JPEG.
    """

    def __init__(self, video: Path, fps: int, memory: mmap.mmap, size: int, sides: list[int] | None) -> None:
        self.waiting = deque[tuple[float, int, int]]()
        """Arrival, slot and length of each picture that came."""

        self.replaced = 0
        """Pictures that a newer one replaced before a moment came."""

        self.failed = ""
        self._video, self._fps, self._memory, self._size = video, fps, memory, size
        self._sides = sides
        self._writer: VideoWriter | None = None
        self._rows: Any = None
        self._shown = (0.0, b"")

    def begin(self) -> None:
        """Make the file of its rows, which tells that there is such a camera.

        Raises:
            OSError: it cannot be written.
        """
        self._rows = self._video.with_suffix(ROWS).open("wb", buffering=0)

    def frame(self, number: int, moment: float) -> None:
        """Encode the newest picture of a moment.

        Raises:
            StrandsRobotsError, OSError, ValueError: it cannot be decoded or written.
        """
        if self._writer is None and (number + 1) % GROUP:
            # Every camera begins its groups at the same moments: from the second one on, which has the first picture.
            return
        newest = None
        while self.waiting and self.waiting[0][0] <= moment + SOON_S:
            if newest is not None:
                self.replaced += 1
                self._free(newest[1])
            newest = self.waiting.popleft()
        at, data = self._shown
        if newest is not None:
            at, slot, length = newest
            data = self._memory[slot * self._size : slot * self._size + length]
            self._free(slot)
        elif self._writer is None:
            return
        same = data == self._shown[1]
        picture = None if same else self._pixels(data)
        if self._writer is None:
            assert picture is not None
            high, wide = picture.shape[:2]
            self._writer = VideoWriter(self._video, self._fps, wide, high, live=True)
        self._rows.write(np.array([(moment, at, same)], ROW).tobytes())
        if picture is None:
            self._writer.repeat()
        else:
            self._writer.write(picture)
        self._shown = at, data

    def end(self) -> None:
        """Finish the files.

        Raises:
            StrandsRobotsError, OSError: they cannot be written.
        """
        self._memory.close()
        self._rows.close()
        if self._writer is not None:
            write_statistics(self._video, self._writer.finish().statistics)

    def _free(self, slot: int) -> None:
        self._memory[SLOTS * self._size + slot] = FREE[0]

    def _pixels(self, data: bytes) -> Any:
        if self._sides is None:
            return decoded(data)
        width, height = self._sides
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)


class _Encoder:
    """The orders of one recorder, and the attempt that runs."""

    def __init__(self, orders: socket.socket) -> None:
        self._orders, self._received, self._descriptors = orders, b"", deque[int]()
        self._cameras: dict[str, _Camera] = {}
        self._folder, self._began, self._fps = Path(), 0.0, 1
        self._number, self._until = 0, -1.0
        self.over = False
        """True once the recorder is gone; the files are whole whenever."""

    def run(self, *, hurry: bool) -> None:
        """Serve until it is over, or until it is to go on otherwise."""
        _give_way(hurry=hurry)
        while not self.over and self._hurries(since_before=hurry) is hurry:
            running = self._until >= 0
            due = min(self._moment + MARGIN_S, self._until) if running else math.inf
            wait = None if due == math.inf else max(0.0, due - time.time())
            if select.select([self._orders], [], [], wait)[0] and not self._receive():
                self.over = True
            elif self._until >= 0:
                self._step(time.time())

    def _hurries(self, *, since_before: bool) -> bool:
        """Return True where an attempt waits for its end, or it is far behind."""
        if self._until < 0:
            return False
        behind = time.time() - self._moment
        return self._until < float("inf") or behind > (CAUGHT_UP_S if since_before else HURRY_S)

    @property
    def _moment(self) -> float:
        return self._began + self._number / self._fps

    def _step(self, now: float) -> None:
        """Encode a moment that is over, or end the attempt after its last one."""
        moment = self._moment
        if moment > self._until + SOON_S:
            self._end()
        elif now >= min(moment + MARGIN_S, self._until):
            if now - moment > BEHIND_S and self._until == float("inf"):
                self._say(failed=f"the encoder of the cameras is {now - moment:.0f} s behind")
                self._until = moment
            for name, camera in self._cameras.items():
                self._or_failed(name, partial(camera.frame, self._number, moment))
            self._number += 1

    def _or_failed(self, name: str, do: Callable[[], None]) -> None:
        camera = self._cameras[name]
        if not camera.failed:
            try:
                do()
            except (StrandsRobotsError, OSError, ValueError) as exc:
                camera.failed = f"camera {name}: {exc}"
                self._say(failed=camera.failed)

    def _end(self) -> None:
        for name, camera in self._cameras.items():
            self._or_failed(name, camera.end)
        self._say(ended={name: camera.replaced for name, camera in self._cameras.items()})
        self._cameras, self._until = {}, -1.0

    def _receive(self) -> bool:
        """Carry out the orders that came; False where none will come any more."""
        try:
            data, descriptors, _, _ = socket.recv_fds(self._orders, 65_536, 16)
        except OSError:
            return False
        self._descriptors.extend(descriptors)
        *lines, self._received = (self._received + data).split(b"\n")
        for line in lines:
            self._order(json.loads(line))
        return bool(data)

    def _order(self, order: dict[str, Any]) -> None:
        if "picture" in order:
            if (camera := self._cameras.get(order["picture"])) is not None:
                if self._began == math.inf:
                    self._began = order["at"] + BEFORE / self._fps
                camera.waiting.append((order["at"], order["slot"], order["length"]))
        elif "camera" in order:
            name, descriptor = order["camera"], self._descriptors.popleft()
            memory = mmap.mmap(descriptor, memory_bytes(order["size"]))
            os.close(descriptor)
            video = self._folder / f"{name}{VIDEO}"
            self._cameras[name] = _Camera(video, self._fps, memory, order["size"], order["sides"])
            self._or_failed(name, self._cameras[name].begin)
        elif "begin" in order:
            self._folder, self._fps, self._began = Path(order["begin"]), order["fps"], math.inf
            self._cameras, self._number, self._until = {}, 0, float("inf")
            self._say(begun=True)
        elif self._until >= 0:
            self._until = min(self._until, order["end"])

    def _say(self, **said: Any) -> None:
        try:
            self._orders.sendall(json.dumps(said).encode() + b"\n")
        except OSError:
            return  # the recorder is gone, which the next look at the orders tells


def _give_way(*, hurry: bool) -> None:
    """Have this thread run in the time that others leave."""
    if sys.platform == "linux":
        if not hurry:
            with suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
                return
        os.nice(NICENESS)


def main(descriptor: int) -> None:
    """Encode for the recorder at the other end of a socket."""
    if sys.platform != "linux":
        os.nice(NICENESS)
    with socket.socket(fileno=descriptor) as orders:
        encoder, hurry = _Encoder(orders), False
        while not encoder.over:
            # A thread of the idle class cannot leave it.
            thread = threading.Thread(target=encoder.run, kwargs={"hurry": hurry})
            thread.start()
            thread.join()
            hurry = not hurry


if __name__ == "__main__":
    main(int(sys.argv[1]))
