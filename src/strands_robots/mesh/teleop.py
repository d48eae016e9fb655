"""Input streams of one peer that were opened by command: ``teleop_receive``, ``teleop_status``, ``teleop_stop``."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from strands_robots.envelope import Envelope, error, success
from strands_robots.mesh.input_receiver import InputReceiver

STREAMS_MAX = 8


class TeleopDesk:
    """Opens, tells and closes receivers; at most eight at once."""

    def __init__(self, open_receiver: Callable[[str, str], InputReceiver]) -> None:
        self._open = open_receiver
        self._receivers: dict[tuple[str, str], InputReceiver] = {}
        self._lock = threading.Lock()

    def receive(self, command: dict[str, Any]) -> Envelope:
        """Follow ``source_peer_id``'s device (``leader`` by default)."""
        key = (command["source_peer_id"], command.get("device_name", "leader"))
        with self._lock:
            for old in [name for name, each in self._receivers.items() if not each.running]:
                self._receivers.pop(old).stop()
            if key in self._receivers:
                return success(f"Already following {key[0]}/{key[1]}.", **self._receivers[key].stats)
            if len(self._receivers) >= STREAMS_MAX:
                return error(f"teleop_receive: {STREAMS_MAX} input streams are open already.")
            receiver = self._open(*key)
            receiver.start()
            if receiver.start_refusal is not None:
                return error(f"teleop_receive: {receiver.start_refusal}.")
            self._receivers[key] = receiver
        return success(f"Following {key[0]}/{key[1]}.", **receiver.stats)

    def status(self, command: dict[str, Any]) -> Envelope:
        """The counters of every stream."""
        with self._lock:
            streams = [receiver.stats for receiver in self._receivers.values()]
        return success(f"{sum(stream['running'] for stream in streams)} input streams run.", streams=streams)

    def stop(self, command: dict[str, Any]) -> Envelope:
        """Close the named stream, or all of them."""
        source, device = command.get("source_peer_id"), command.get("device_name")
        with self._lock:
            chosen = [
                key
                for key in self._receivers
                if (source is None or key[0] == source) and (device is None or key[1] == device)
            ]
            streams = [self._receivers.pop(key).stop() for key in chosen]
        return success(f"{len(streams)} input streams closed.", streams=streams)

    def close(self) -> None:
        """Close all of them."""
        self.stop({})
