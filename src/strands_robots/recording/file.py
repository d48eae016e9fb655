"""The file of a recording: MCAP (mcap.dev/spec), written in small chunks, readable to its last whole chunk."""

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

from strands_robots.policies.base import numbers
from strands_robots.recording import schemas
from strands_robots.recording._compat import close_chunk
from strands_robots.recording.schemas import Schema
from strands_robots.utils import ValidationError, missing_extra, shown

CHUNK_BYTES = 16_384
"""At most so much is lost of a file that was cut off."""

CHUNK_S = 1.0
"""And at most what came in so many seconds; an event at no steady rate is in the file at once."""

WAITING_MAX = 50_000
"""What may wait to be written; what comes on top is counted as lost."""

PICTURES_WAITING_BYTES = 64_000_000
"""How much of it pictures may be."""

STEP = "streamStep"
"""The event that carries a robot's actions."""

STEADY = frozenset({STEP, "observationUpdate", "stateUpdate", "state"})
"""Events at a steady rate, which write no log line."""

JOINTS, CAMERA, LOG = "joint_states", "camera", "log"
"""What channels other than those of events are called, behind the device."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One recorded event: seconds since the epoch when it came, whose, which, and what it carried."""

    at: float
    device: str
    event: str
    payload: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Joints:
    """Positions by joint, in the robot's own units; ``device`` may be ``WORLD/ROBOT``."""

    at: float
    device: str
    joints: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture of a camera as JPEG."""

    at: float
    device: str
    camera: str
    jpeg: bytes


Item = Entry | Joints | Picture


class Recorder:
    """Writes what it is given on a thread of its own, while it is entered as a context.

    Args:
        path: a new ``.mcap`` file.
        joints_of_events: also write the joints that events carry as joint states; off where they are sampled.

    Raises:
        MissingExtraError: the [record] extra is not installed.
        ValidationError: another kind of file, or one that is there already.
    """

    def __init__(self, path: Path, *, joints_of_events: bool = True) -> None:
        _mcap()
        if path.suffix != ".mcap":
            raise ValidationError(f"a recording must be a .mcap file, not {shown(str(path))}.")
        if path.exists():
            raise ValidationError(f"{path} is there already; a recording is never overwritten.")
        self.path = path
        self.lost = 0
        self.counts: Counter[str] = Counter()
        self._joints_of_events = joints_of_events
        self._waiting: queue.Queue[Item | None] = queue.Queue(WAITING_MAX)
        self._pictures = 0
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._failure: Exception | None = None

    def __enter__(self) -> Self:
        # Opened here, so that a folder that is not there is told to who asked.
        try:
            self._file = self.path.open("xb")
        except OSError as exc:
            raise ValidationError(f"the recording {self.path} cannot be written: {exc.strerror}.") from exc
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._waiting.put(None)
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    def take(self, device: str, event: str, payload: Mapping[str, Any]) -> None:
        """Keep one event; returns at once."""
        self._put(Entry(time.time(), device, event, payload))

    def take_joints(self, device: str, joints: Mapping[str, float]) -> None:
        """Keep the joints of this moment; returns at once."""
        self._put(Joints(time.time(), device, joints))

    def take_picture(self, device: str, camera: str, jpeg: bytes) -> None:
        """Keep a picture; returns at once."""
        if self._pictures > PICTURES_WAITING_BYTES:
            self.lost += 1
            return
        self._pictures += len(jpeg)
        self._put(Picture(time.time(), device, camera, jpeg))

    def _put(self, item: Item) -> None:
        try:
            self._waiting.put_nowait(item)
        except queue.Full:
            self.lost += 1

    def _write(self) -> None:
        try:
            with self._file as file:
                channels = _Channels(file, self.counts)
                while (item := self._next(channels)) is not None:
                    if isinstance(item, Entry):
                        self._event(channels, item)
                    elif isinstance(item, Joints):
                        _joints(channels, item.at, item.device, item.joints)
                    else:
                        self._pictures -= len(item.jpeg)
                        at = _ns(item.at)
                        data = schemas.compressed_image(at, item.camera, item.jpeg)
                        channels.write(f"/{item.device}/{CAMERA}/{item.camera}", schemas.IMAGE, at, data)
                channels.finish()
        except Exception as exc:  # noqa: BLE001 - told to whoever ends the recording
            self._failure = exc

    def _next(self, channels: _Channels) -> Item | None:
        while True:
            try:
                return self._waiting.get(timeout=channels.due_s)
            except queue.Empty:
                channels.close_chunk()

    def _event(self, channels: _Channels, entry: Entry) -> None:
        at = _ns(entry.at)
        data = json.dumps(entry.payload, default=str)
        channels.write(f"/{entry.device}/{entry.event}", schemas.EVENT, at, data.encode())
        if entry.event not in STEADY:
            words = f"{entry.event} {data}" if entry.payload else entry.event
            line = schemas.log_line(at, _level(entry), entry.device, words)
            channels.write(f"/{entry.device}/{LOG}", schemas.LOG, at, line)
            channels.close_chunk()
        elif self._joints_of_events:
            joints = entry.payload.get("joints") or entry.payload.get("observation")
            if isinstance(joints, Mapping):
                _joints(channels, entry.at, whose(entry), numbers({key: _position(at) for key, at in joints.items()}))


class _Channels:
    """The channels of a file that is being written, each made with its first message."""

    def __init__(self, file: Any, counts: Counter[str]) -> None:
        self._file = file
        self._open_since: float | None = None
        self._writer = _mcap().Writer(file, chunk_size=CHUNK_BYTES)
        self._writer.start(profile="", library="strands-robots")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts = counts

    def write(self, topic: str, schema: Schema, at: int, data: bytes) -> None:
        """Write one message; ``at`` in nanoseconds since the epoch."""
        channel = self._channels.get(topic)
        if channel is None:
            if schema.name not in self._schemas:
                registered = self._writer.register_schema(schema.name, schema.encoding, schema.data)
                self._schemas[schema.name] = registered
            channel = self._writer.register_channel(topic, schema.messages, self._schemas[schema.name])
            self._channels[topic] = channel
        self._writer.add_message(channel, log_time=at, data=data, publish_time=at)
        self._counts[topic] += 1
        if self._open_since is None:
            self._open_since = time.monotonic()
        elif self.due_s == 0:
            self.close_chunk()

    @property
    def due_s(self) -> float | None:
        """Seconds until the chunk that is being filled is closed; None where none is."""
        since = self._open_since
        return None if since is None else max(0.0, since + CHUNK_S - time.monotonic())

    def close_chunk(self) -> None:
        """Put what was written so far into the file."""
        close_chunk(self._writer)
        self._file.flush()
        self._open_since = None

    def finish(self) -> None:
        """Write the index; the file is whole then."""
        self._writer.finish()


def read_items(path: Path) -> Iterator[Item]:
    """All of a recording in the order in which it was written; of a cut one, all that is whole.

    Raises:
        MissingExtraError: the [record] extra is not installed.
        ValidationError: the file cannot be read or is no recording.
    """
    _mcap()
    from mcap.exceptions import EndOfFile, McapError  # noqa: PLC0415 - an extra
    from mcap.reader import NonSeekingReader  # noqa: PLC0415

    try:
        with path.open("rb") as file:
            for schema, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
                found = _item(schema.name if schema else "", channel, message)
                if found is not None:
                    yield found
    except (EndOfFile, struct.error):
        return
    except OSError as exc:
        raise ValidationError(f"the recording {shown(str(path))} cannot be read: {exc.strerror}.") from exc
    except (McapError, ValueError) as exc:
        raise ValidationError(f"{shown(str(path))} is no recording of robots: {exc}.") from exc


def read_entries(path: Path) -> Iterator[Entry]:
    """The events of a recording; raises what :func:`read_items` raises."""
    return (item for item in read_items(path) if isinstance(item, Entry))


def whose(entry: Entry) -> str:
    """The device of an event, and the robot where it is one of a simulated world."""
    return "/".join(part for part in (entry.device, str(entry.payload.get("robot_name") or "")) if part)


def _item(schema: str, channel: Any, message: Any) -> Item | None:
    at = message.log_time / 1e9
    device, _, last = channel.topic.strip("/").rpartition("/")
    if schema == schemas.JOINT_STATE.name:
        return Joints(at, device, schemas.read_joint_state(message.data))
    if schema == schemas.IMAGE.name:
        return Picture(at, device.removesuffix(f"/{CAMERA}"), last, schemas.read_compressed_image(message.data))
    if channel.message_encoding != schemas.EVENT.messages:
        return None
    return Entry(at, device, last, json.loads(message.data))


def _joints(channels: _Channels, at: float, device: str, joints: Mapping[str, float]) -> None:
    if joints:
        channels.write(f"/{device}/{JOINTS}", schemas.JOINT_STATE, _ns(at), schemas.joint_state(_ns(at), joints))


def _position(joint: Any) -> Any:
    """A joint that is told with its velocity counts by its position."""
    return joint.get("position") if isinstance(joint, Mapping) else joint


def _level(entry: Entry) -> int:
    if entry.payload.get("state") == "error" or entry.payload.get("error"):
        return schemas.ERROR
    return schemas.WARNING if entry.event.lower().startswith(("emergency", "halted", "locked")) else schemas.INFO


def _ns(seconds: float) -> int:
    return int(seconds * 1e9)


def _mcap() -> Any:
    try:
        from mcap import writer  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as exc:
        raise missing_extra("Recording", "record") from exc
    return writer
