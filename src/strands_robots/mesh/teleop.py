"""Input streams that commands open: ``teleop_receive``, ``_status``, ``_stop``."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable

from strands_robots.envelope import Envelope, error, success
from strands_robots.mesh.input_receiver import InputReceiver
from strands_robots.safety.gate import MotionRequest
from strands_robots.serving.verbs import Arguments
from strands_robots.serving.workers import UNBOUNDED

STREAMS_MAX = 8
JOIN_S = 2.0

Key = tuple[str, str]


class TeleopReceivers:
    """Opens, lists and closes receivers; at most eight at once."""

    def __init__(self, open_receiver: Callable[[str, str], InputReceiver]) -> None:
        self._open = open_receiver
        self._receivers: dict[Key, InputReceiver] = {}
        self._lock = threading.Lock()

    def receive(self, command: Arguments, request: MotionRequest | None = None) -> Envelope:
        """Follow ``source_peer_id``'s device (``leader`` by default)."""
        key = (command["source_peer_id"], command.get("device_name", "leader"))
        with self._lock:
            self._end(lambda key, each: not each.running)
            if key in self._receivers:
                return success(f"Already following {key[0]}/{key[1]}.", **self._receivers[key].stats)
            if len(self._receivers) >= STREAMS_MAX:
                return error(f"teleop_receive: {STREAMS_MAX} input streams are open already.")
            receiver = self._open(*key)
            receiver.start(request)
            if receiver.start_refusal is not None:
                return error(f"teleop_receive: {receiver.start_refusal}.")
            self._receivers[key] = receiver
        return success(f"Following {key[0]}/{key[1]}.", **receiver.stats)

    def status(self, command: Arguments, request: MotionRequest | None = None) -> Envelope:
        """The counters of every stream."""
        with self._lock:
            streams = [receiver.stats for receiver in self._receivers.values()]
        return success(f"{sum(stream['running'] for stream in streams)} input streams run.", streams=streams)

    def stop(self, command: Arguments, request: MotionRequest | None = None) -> Envelope:
        """Close the named stream or all, and wait up to 2 s for last frames."""
        source, device = command.get("source_peer_id"), command.get("device_name")
        with self._lock:
            ended = self._end(lambda key, _: source in (None, key[0]) and device in (None, key[1]))
        join(ended, JOIN_S)
        return success(f"{len(ended)} input streams closed.", streams=[each.stats for each in ended])

    def close(self) -> list[InputReceiver]:
        """Close all of them; those closed, to :func:`join`."""
        with self._lock:
            return self._end(lambda key, each: True)

    def leading(self) -> bool:
        """Return True while a leader moves a robot."""
        return any(receiver.leading for receiver in list(self._receivers.values()))

    def void(self) -> None:
        """Let no frame move anything from now on, because a robot is being stopped.

        It waits for nothing, neither for the lock nor for a frame that a slow bus still takes.
        """
        for receiver in list(self._receivers.values()):
            receiver.void()

    def reap(self) -> None:
        """Close the streams that a stop has voided, without waiting."""
        with self._lock:
            ended = self._end(lambda key, each: not each.running)
        if ended:
            UNBOUNDED.submit(lambda: _joined(ended))

    def _end(self, chosen: Callable[[Key, InputReceiver], bool]) -> list[InputReceiver]:
        ended = [self._receivers.pop(key) for key, each in list(self._receivers.items()) if chosen(key, each)]
        for receiver in ended:
            receiver.close()
        return ended


def join(closed: Iterable[InputReceiver], timeout: float) -> list[str]:
    """Wait for the last frames of closed streams; return the unfinished ones."""
    deadline = time.monotonic() + timeout
    return [each.topic for each in closed if not each.join(max(0.0, deadline - time.monotonic()))]


def _joined(closed: Iterable[InputReceiver]) -> None:
    join(closed, JOIN_S)
