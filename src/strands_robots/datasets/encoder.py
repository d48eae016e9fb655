"""Cameras of a recorder, encoded by a process while the attempt runs."""

from __future__ import annotations

import json
import mmap
import os
import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from strands_robots.datasets.encoded import cameras_folder
from strands_robots.datasets.encoder_process import FREE, SLOTS, USED, memory_bytes
from strands_robots.datasets.layout import FPS_MAX, DatasetError, checked_feature_name
from strands_robots.utils import ValidationError, optional_module, whole

PROGRAM = (sys.executable, "-m", "strands_robots.datasets.encoder_process")

PICTURE_BYTES = 2**26
"""Largest picture as pixels."""

JPEG_BYTES = 2**22
"""Largest picture as JPEG."""

BEGIN_S, END_S = 30.0, 30.0
"""Longest waits for the process to begin an attempt, and to encode what is left of one."""


class CameraEncoder:
    """Encoder of a recorder's cameras, in a process of its own.

    The process is started once, and again where it died.

    Pictures go through memory that both share. Where the process has no time for one it is dropped and counted:
    :meth:`offer` never waits for it. Any thread may offer.

    Args:
        fps: pictures a second of each video.

    Raises:
        MissingExtraError: the [dataset] extra is not installed.
        ValidationError: ``fps`` outside its domain.
    """

    def __init__(self, fps: int) -> None:
        optional_module("av", what="A video", extra="dataset")
        self._fps = whole("fps", fps, low=1, high=FPS_MAX)
        self.dropped: Counter[str] = Counter()
        """Pictures of the newest attempt that are not in its video, by camera."""

        self._failed, self._running = "", False
        self._begun = self._ended = False
        self._cameras: dict[str, _Camera] = {}
        self._lock = threading.Lock()
        self._delivered = threading.Condition(self._lock)
        self._process: subprocess.Popen[bytes] | None = None
        self._socket, self._received = socket.socket(), b""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def pid(self) -> int | None:
        """Number of the process; None while there is none."""
        return None if self._process is None else self._process.pid

    @property
    def failed(self) -> str:
        """Reason why the newest attempt lacks pictures; empty while it does not."""
        with self._lock:
            if self._running:
                self._hear()
            return self._failed

    @contextmanager
    def attempt(self, recording: Path) -> Iterator[Self]:
        """Encode what is offered in the block, beside a recording.

        At the end it waits until all is encoded. Where the process died or does not answer, :attr:`failed` says so, and
        the videos have what was encoded until then.

        Args:
            recording: ``.mcap``.

        Raises:
            DatasetError: the process does not start, or the videos cannot be written.
        """
        folder = cameras_folder(recording)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as exc:
            raise DatasetError(f"{folder} cannot be written: {exc.strerror}") from exc
        self._begin(folder)
        try:
            yield self
        finally:
            self._end()

    def offer(self, camera: str, picture: NDArray[np.uint8] | bytes, at: float | None = None) -> bool:
        """Hand a picture over; returns at once.

        Args:
            camera: its name.
            picture: RGB of ``(height, width, 3)``, or a JPEG, which is decoded by the process.
            at: when it had arrived, in seconds since the epoch; now by default.

        Returns:
            False where it was dropped, or no attempt runs.

        Raises:
            ValidationError: no picture, one of another size than before, or no name.
        """
        moment, sides = time.time() if at is None else at, _sides(camera, picture)
        pixels = np.frombuffer(picture, np.uint8) if isinstance(picture, bytes) else picture
        with self._lock:
            if not self._running:
                return False
            known = self._cameras.get(camera) or self._made(camera, sides)
            if sides != known.sides:
                raise ValidationError(f"pictures of {camera} must be {known.sides} as its first one, not {sides}.")
            slot = -1 if self._failed else known.put(pixels)
            if slot < 0:
                self.dropped[camera] += 1
                return False
            self._send({"picture": camera, "slot": slot, "length": pixels.size, "at": moment})
            return not self._failed

    def wait_for_pictures(self, cameras: Collection[str], longest_s: float) -> list[str]:
        """Wait until cameras have delivered; return those that have not.

        Where none is named any camera will do, and "any camera" is returned where none has.
        """

        def silent() -> list[str]:
            return [each for each in cameras if each not in self._cameras] or ["any camera"] * (not self._cameras)

        with self._delivered:
            self._delivered.wait_for(lambda: not silent(), longest_s)
            return silent()

    def close(self) -> None:
        """End the process. Twice is once."""
        with self._lock:
            self._forget()
            if self._process is not None:
                self._socket.close()
                self._process.kill()
                self._process.wait()
                self._process = None

    def _begin(self, folder: Path) -> None:
        if self._process is None or self._process.poll() is not None:
            self.close()
            self._start()
        with self._lock:
            self._forget()
            self.dropped.clear()
            self._failed, self._begun, self._ended, self._running = "", False, False, True
            self._send({"begin": str(folder.absolute()), "fps": self._fps})
        if not self._wait(lambda: self._begun, BEGIN_S):
            self.close()
            raise DatasetError(f"the cameras cannot be encoded: {self._failed or 'the process does not start'}")

    def _end(self) -> None:
        with self._lock:
            self._send({"end": time.time()})
        if not self._wait(lambda: self._ended, END_S):
            self._failed = self._failed or "the process that encodes the cameras does not answer"
            self.close()
        with self._lock:
            self._forget()

    def _start(self) -> None:
        self._socket, its = socket.socketpair()
        self._received = b""
        with its:
            # Ctrl-C at the terminal is for the recorder alone.
            self._process = subprocess.Popen(
                [*PROGRAM, str(its.fileno())],
                pass_fds=[its.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
            )

    def _made(self, camera: str, sides: tuple[int, int] | None) -> _Camera:
        made = self._cameras[checked_feature_name(camera)] = _Camera(sides)
        try:
            order = {"camera": camera, "size": made.size, "sides": sides}
            self._send(order, made.descriptor)
        finally:
            os.close(made.descriptor)
        self._delivered.notify_all()
        return made

    def _forget(self) -> None:
        self._running = False
        self._cameras.clear()

    def _send(self, order: dict[str, Any], *descriptors: int) -> None:
        """Send an order without waiting; so few are sent that there is room."""
        data = json.dumps(order).encode() + b"\n"
        sent = 0
        with suppress(OSError):
            if descriptors:
                sent = socket.send_fds(self._socket, [data], descriptors, socket.MSG_DONTWAIT)
            else:
                sent = self._socket.send(data, socket.MSG_DONTWAIT)
        if sent != len(data):
            self._gone()

    def _gone(self) -> None:
        self._failed = self._failed or "the process that encodes the cameras has ended"

    def _hear(self) -> None:
        """Take what the process says, without waiting."""
        while True:
            try:
                data = self._socket.recv(4096, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._gone()
                return
            *lines, self._received = (self._received + data).split(b"\n")
            for line in lines:
                self._take(json.loads(line))

    def _take(self, said: dict[str, Any]) -> None:
        if "failed" in said:
            self._failed = self._failed or said["failed"]
        elif "ended" in said:
            # Those that were replaced were taken here, and not counted.
            self.dropped.update({name: count for name, count in said["ended"].items() if count})
            self._ended = True
        else:
            self._begun = True

    def _wait(self, done: Any, longest_s: float) -> bool:
        """Wait until something was said; False where it will not be."""
        until = time.monotonic() + longest_s
        while True:
            with self._lock:
                self._hear()
                ended = self._process is None or self._process.poll() is not None
                if done() or ended:
                    return bool(done())
            left = until - time.monotonic()
            if left <= 0:
                return False
            select.select([self._socket], [], [], min(left, 1.0))


class _Camera:
    """Memory of one camera's pictures, which the other process reads."""

    def __init__(self, sides: tuple[int, int] | None) -> None:
        self.sides, self.size = sides, JPEG_BYTES if sides is None else sides[0] * sides[1] * 3
        self.descriptor = _shared(memory_bytes(self.size))
        self._memory = mmap.mmap(self.descriptor, memory_bytes(self.size))
        self._bytes = np.frombuffer(self._memory, np.uint8)

    def put(self, pixels: NDArray[np.uint8]) -> int:
        """Copy a picture in, and return its slot; -1 where none is free."""
        used = SLOTS * self.size
        place = self._memory.find(FREE, used)
        if place < 0:
            return -1
        start = (place - used) * self.size
        np.copyto(self._bytes[start : start + pixels.size].reshape(pixels.shape), pixels)
        self._memory[place] = USED
        return place - used


def _sides(camera: str, picture: object) -> tuple[int, int] | None:
    """Return width and height of a picture, None of a JPEG.

    Raises:
        ValidationError: it is no picture that can be encoded.
    """
    if isinstance(picture, bytes):
        if not picture.startswith(b"\xff\xd8") or len(picture) > JPEG_BYTES:
            raise ValidationError(f"a picture of {camera} must be a JPEG of up to {JPEG_BYTES:,} bytes.")
        return None
    if isinstance(picture, np.ndarray) and picture.dtype == np.uint8:
        shape = picture.shape
        if len(shape) == 3 and shape[2] == 3 and 0 < picture.size <= PICTURE_BYTES:
            return shape[1], shape[0]
    found = f"{picture.dtype} of {picture.shape}" if isinstance(picture, np.ndarray) else type(picture).__name__
    raise ValidationError(
        f"a picture of {camera} must be height x width x 3 of uint8 of up to {PICTURE_BYTES:,} bytes, not {found}."
    )


def _shared(size: int) -> int:
    """Return the descriptor of memory, which takes as much as is written."""
    if sys.platform == "linux":
        descriptor = os.memfd_create("pictures", os.MFD_CLOEXEC)
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor
