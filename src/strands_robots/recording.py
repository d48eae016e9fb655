"""Recordings of robots: every event with its time, in an MCAP file that Foxglove and Rerun open.

One channel an event of a device, ``/DEVICE/EVENT``, its messages JSON as they came. A file is written in small chunks:
one that was cut off is readable to its last whole chunk. Format: mcap.dev/spec.
"""

from __future__ import annotations

import json
import queue
import struct
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from strands_robots.leaders.recorded import Frame
from strands_robots.policies.actions import numbers
from strands_robots.utils import ValidationError, missing_extra, shown

CHUNK_BYTES = 16_384
"""At most so much is lost of a file that was cut off."""

WAITING_MAX = 50_000
"""Events that wait to be written; what comes on top is counted as lost."""

STEP = "streamStep"
"""The event that carries a robot's actions."""

_SCHEMA = {"type": "object", "title": "event"}


@dataclass(frozen=True, slots=True)
class Entry:
    """One recorded event: seconds since the epoch when it arrived, whose, which, and what it carried."""

    at: float
    device: str
    event: str
    payload: Mapping[str, Any]


class Recorder:
    """Writes events on a thread of its own, while it is entered as a context.

    Args:
        path: a new ``.mcap`` file.

    Raises:
        MissingExtraError: the [record] extra is not installed.
        ValidationError: another kind of file, or one that is there already.
    """

    def __init__(self, path: Path) -> None:
        _mcap()
        if path.suffix != ".mcap":
            raise ValidationError(f"a recording must be a .mcap file, not {shown(str(path))}.")
        if path.exists():
            raise ValidationError(f"{path} is there already; a recording is never overwritten.")
        self.path = path
        self.lost = 0
        self.counts: Counter[str] = Counter()
        self._waiting: queue.Queue[Entry | None] = queue.Queue(WAITING_MAX)
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._failure: Exception | None = None

    def __enter__(self) -> Self:
        # Opened here, so that a folder that is not there is told to who asked.
        self._file = self.path.open("xb")
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._waiting.put(None)
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    def take(self, device: str, event: str, payload: Mapping[str, Any]) -> None:
        """Keep one event; returns at once."""
        try:
            self._waiting.put_nowait(Entry(time.time(), device, event, payload))
        except queue.Full:
            self.lost += 1

    def _write(self) -> None:
        writer_module = _mcap()
        try:
            with self._file as file:
                writer = writer_module.Writer(file, chunk_size=CHUNK_BYTES)
                writer.start(profile="", library="strands-robots")
                schema = writer.register_schema("event", "jsonschema", json.dumps(_SCHEMA).encode())
                channels: dict[str, int] = {}
                while (entry := self._waiting.get()) is not None:
                    topic = f"/{entry.device}/{entry.event}"
                    if topic not in channels:
                        channels[topic] = writer.register_channel(topic, "json", schema)
                    at = int(entry.at * 1e9)
                    data = json.dumps(entry.payload, default=str).encode()
                    writer.add_message(channels[topic], log_time=at, data=data, publish_time=at)
                    self.counts[topic] += 1
                writer.finish()
        except Exception as exc:  # noqa: BLE001 - told to whoever ends the recording
            self._failure = exc


def read_entries(path: Path) -> Iterator[Entry]:
    """Every event of a recording in the order in which it was written; of a cut one, all that is whole.

    Raises:
        MissingExtraError: the [record] extra is not installed.
        ValidationError: the file cannot be read or is no recording.
    """
    _mcap()
    from mcap.exceptions import EndOfFile, McapError  # noqa: PLC0415 - an extra
    from mcap.reader import NonSeekingReader  # noqa: PLC0415

    try:
        with path.open("rb") as file:
            for _, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
                device, _, event = channel.topic.strip("/").rpartition("/")
                yield Entry(message.log_time / 1e9, device, event, json.loads(message.data))
    except (EndOfFile, struct.error):
        return
    except OSError as exc:
        raise ValidationError(f"the recording {shown(str(path))} cannot be read: {exc.strerror}.") from exc
    except (McapError, ValueError) as exc:
        raise ValidationError(f"{shown(str(path))} is no recording of robots: {exc}.") from exc


def recorded_actions(path: Path, device: str | None = None) -> list[Frame]:
    """The actions of one device of a recording as frames that lead, seconds since the first.

    Raises:
        ValidationError: no actions, or those of several devices and none named.
    """
    frames: dict[str, list[Frame]] = {}
    for entry in read_entries(path):
        action = numbers(entry.payload.get("action") or {}) if entry.event == STEP else {}
        if action:
            # A robot of a simulated world leads by itself.
            who = "/".join(part for part in (entry.device, str(entry.payload.get("robot_name") or "")) if part)
            kept = frames.setdefault(who, [])
            if not kept or entry.at > kept[-1][0]:
                kept.append((entry.at, action))
    chosen = {who: kept for who, kept in frames.items() if device is None or device in (who, who.partition("/")[0])}
    if len(chosen) != 1:
        known = ", ".join(frames) or "nobody"
        raise ValidationError(f"device must be one of whose actions were recorded ({known}), not {shown(device)}.")
    (kept,) = chosen.values()
    return [(at - kept[0][0], action) for at, action in kept]


def _mcap() -> Any:
    try:
        from mcap import writer  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as exc:
        raise missing_extra("Recording", "record") from exc
    return writer
