"""Robots sampled into MCAP files, which are readable to the last whole chunk."""

from __future__ import annotations

import io
import json
import logging
import os
import queue
import struct
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Self

from strands_robots.adapted import behind_contract
from strands_robots.contract import RolloutEvent, Unsubscribe, holds_robots, observe, robots_in
from strands_robots.envelope import text_of
from strands_robots.policies.base import numbers
from strands_robots.policies.decoding import decode_json
from strands_robots.recording import schemas
from strands_robots.recording.cameras import Frames, jpeg
from strands_robots.recording.schemas import Schema
from strands_robots.teleoperators import Frame, check_length
from strands_robots.utils import ValidationError, number, optional_module, shown

logger = logging.getLogger(__name__)

CHUNK_MAX_BYTES = 64 * 2**20
RATIO_MAX = 200
"""Bounds of what is read, because a few kilobytes can unpack to gigabytes.

A chunk may unpack to the first, and a file to so many times its own size besides one such chunk.
"""

CHUNK_BYTES = 16_384
"""Largest chunk: at most this much is lost of a file that was cut off."""

CHUNK_S = 0.5
"""Longest time a chunk stays open, in seconds; an event that is not steady closes it at once."""

PENDING_MAX = 50_000
"""Most items that wait to be written; further ones are dropped and counted in ``Recorder.lost``."""

PENDING_PICTURE_BYTES = 64_000_000
"""Most bytes of pictures among them."""

STEP, TURN = "streamStep", "turnChanged"
"""Event that carries a robot's actions, and that of a change of who drives it."""

REFUSED, UNITS = "motionRefused", "jointUnits"
"""Events of a motion that was refused while the robot is locked, and of the units of its joints."""

STEADY = frozenset({STEP, "observationUpdate", "stateUpdate", "state"})
"""Events at a steady rate, which write no log line."""

JOINTS, CAMERA, LOG = "joint_states", "camera", "log"
"""Channel names, after the device, of everything that is not an event."""

JOINTS_HZ, CAMERAS_HZ, GATE_HZ = 50.0, 15.0, 20.0
"""Rates at which joints are read, pictures are taken, and the gate is checked for halts and locks."""

Pictures = Callable[[str, Any, float | None], object]
"""Takes a camera's name, its picture, and when that had arrived, in seconds since the epoch; None for now."""

PATIENCE_S = 0.5
"""A source that fails for this long is reported; a busy bus costs a sample, it is not a fault."""


def read_messages(file: BinaryIO) -> Iterator[tuple[Any, Any, Any]]:
    """Yield schema, channel and message of each message, in the order of writing.

    Raises:
        ValidationError: it unpacks to more than a recording does.
        McapError, EndOfFile, struct.error: it is no MCAP file, or was cut off.
    """
    from mcap.exceptions import McapError  # noqa: PLC0415 - an extra
    from mcap.records import Channel, Chunk, Message, Schema  # noqa: PLC0415
    from mcap.stream_reader import StreamReader  # noqa: PLC0415

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    left = CHUNK_MAX_BYTES + RATIO_MAX * os.fstat(file.fileno()).st_size
    stream = StreamReader(file, emit_chunks=True, record_size_limit=CHUNK_MAX_BYTES)
    for each in stream.records:
        if isinstance(each, Chunk):
            each.data = _unpacked(each, min(left, CHUNK_MAX_BYTES))
            each.compression = ""
            left -= len(each.data)
        for record in _records(each.data) if isinstance(each, Chunk) else [each]:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None:
                    raise McapError(f"no channel record found with id {record.channel_id}")
                yield schemas.get(channel.schema_id), channel, record


def _records(data: bytes) -> Iterator[Any]:
    """Yield the records of a chunk one at a time; it may have millions."""
    from mcap.data_stream import ReadDataStream  # noqa: PLC0415 - an extra
    from mcap.opcode import Opcode  # noqa: PLC0415 - likewise
    from mcap.records import Channel, Message, Schema  # noqa: PLC0415 - likewise

    stream = ReadDataStream(io.BytesIO(data))
    while stream.count < len(data):
        opcode, length = stream.read1(), stream.read8()
        if opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        else:
            stream.read(length)


def _unpacked(chunk: Any, limit: int) -> bytes:
    """Return the bytes of a chunk, at most ``limit``, whatever its header claims."""
    if chunk.compression == "zstd":
        import zstandard  # noqa: PLC0415 - comes with mcap

        try:
            with zstandard.ZstdDecompressor(max_window_size=CHUNK_MAX_BYTES).stream_reader(chunk.data) as reader:
                data = reader.read(limit + 1)
        except zstandard.ZstdError as exc:
            raise ValidationError(f"a chunk cannot be unpacked: {exc}") from exc
    elif chunk.compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415

        try:
            data = LZ4FrameDecompressor().decompress(chunk.data, max_length=limit + 1)
        except RuntimeError as exc:
            raise ValidationError(f"a chunk cannot be unpacked: {exc}") from exc
    elif chunk.compression:
        raise ValidationError(f"a chunk is packed with {chunk.compression!r}, not with zstd or lz4")
    else:
        data = chunk.data
    if len(data) > limit:
        raise ValidationError(f"a chunk unpacks to more than {limit} bytes")
    return bytes(data)


@dataclass(frozen=True, slots=True)
class RecordedEvent:
    """One event of a device; ``at`` is its arrival in seconds since the epoch."""

    at: float
    device: str
    event: str
    payload: Mapping[str, Any]

    @property
    def robot(self) -> str:
        """The device, or ``WORLD/ROBOT`` for a robot of a simulated world."""
        return "/".join(part for part in (self.device, str(self.payload.get("robot_name") or "")) if part)


@dataclass(frozen=True, slots=True)
class RecordedJoints:
    """Positions by joint in the robot's units; ``device`` may be ``WORLD/ROBOT``."""

    at: float
    device: str
    joints: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class RecordedPicture:
    """One picture of a camera as JPEG."""

    at: float
    device: str
    camera: str
    jpeg: bytes


RecordedItem = RecordedEvent | RecordedJoints | RecordedPicture


class Recorder:
    """Writer of one recording, on a thread of its own while entered as a context.

    Args:
        path: a new ``.mcap`` file.
        joints_of_events: also write the joints that events carry as joint states; off where they are sampled.

    Raises:
        MissingExtraError: the [record] extra is not installed.
        ValidationError: another kind of file, or one that exists already.
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
        self.arrived: dict[str, tuple[float, float]] = {}
        """Moments of the first and the newest event of each name, in seconds since the epoch."""
        self._writing: float | None = None
        self._late_s = 0.0
        self._joints_of_events = joints_of_events
        self._pending: queue.Queue[RecordedItem | None] = queue.Queue(PENDING_MAX)
        self._picture_bytes = 0
        self._thread = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._failure: Exception | None = None

    def __enter__(self) -> Self:
        # The file is opened here so that the caller gets the error of a folder that does not exist.
        try:
            self._file = self.path.open("xb")
        except OSError as exc:
            raise ValidationError(f"the recording {self.path} cannot be written: {exc.strerror}.") from exc
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._pending.put(None)
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    @property
    def lag_s(self) -> float:
        """Seconds from the arrival to the writing of the newest item."""
        writing = self._writing
        return self._late_s if writing is None else max(self._late_s, time.time() - writing)

    @property
    def failed(self) -> bool:
        """True once it cannot be written any more; the end of the context raises why."""
        return self._failure is not None

    def take(self, device: str, event: str, payload: Mapping[str, Any], at: float | None = None) -> None:
        """Record one event, of now or of ``at`` (s since the epoch); returns at once."""
        moment = time.time() if at is None else at
        self.arrived[event] = (self.arrived.get(event, (moment,))[0], moment)
        self._put(RecordedEvent(moment, device, event, payload))

    def take_joints(self, device: str, joints: Mapping[str, float]) -> None:
        """Record the joints of this moment; returns at once."""
        self._put(RecordedJoints(time.time(), device, joints))

    def take_picture(self, device: str, camera: str, jpeg: bytes, at: float | None = None) -> None:
        """Record a picture, of now or of ``at`` (s since the epoch); returns at once."""
        if self._picture_bytes > PENDING_PICTURE_BYTES:
            self.lost += 1
            return
        self._picture_bytes += len(jpeg)
        self._put(RecordedPicture(time.time() if at is None else at, device, camera, jpeg))

    def _put(self, item: RecordedItem) -> None:
        try:
            self._pending.put_nowait(item)
        except queue.Full:
            self.lost += 1

    def _write(self) -> None:
        try:
            with self._file as file:
                channels = _Channels(file, self.counts)
                while (item := self._next(channels)) is not None:
                    self._writing = item.at
                    if isinstance(item, RecordedEvent):
                        self._write_event(channels, item)
                    elif isinstance(item, RecordedJoints):
                        channels.write_joints(item.at, item.device, item.joints)
                    else:
                        self._picture_bytes -= len(item.jpeg)
                        data = schemas.compressed_image(_ns(item.at), item.camera, item.jpeg)
                        channels.write(f"/{item.device}/{CAMERA}/{item.camera}", schemas.IMAGE, item.at, data)
                    self._late_s, self._writing = max(0.0, time.time() - item.at), None
                channels.finish()
        except Exception as exc:  # noqa: BLE001 - raised to the caller that ends the recording
            self._failure = exc

    def _next(self, channels: _Channels) -> RecordedItem | None:
        while True:
            try:
                return self._pending.get(timeout=channels.due_s)
            except queue.Empty:
                channels.close_chunk()

    def _write_event(self, channels: _Channels, item: RecordedEvent) -> None:
        data = json.dumps(item.payload, default=str)
        channels.write(f"/{item.device}/{item.event}", schemas.EVENT, item.at, data.encode())
        if item.event not in STEADY:
            message = f"{item.event} {data}" if item.payload else item.event
            line = schemas.log_line(_ns(item.at), _level(item), item.device, message)
            channels.write(f"/{item.device}/{LOG}", schemas.LOG, item.at, line)
            channels.close_chunk()
        elif self._joints_of_events:
            joints = item.payload.get("joints") or item.payload.get("observation")
            if isinstance(joints, Mapping):
                positions = {
                    key: joint.get("position") if isinstance(joint, Mapping) else joint for key, joint in joints.items()
                }
                channels.write_joints(item.at, item.robot, numbers(positions))


class _Channels:
    """Channels of an open file, each registered with its first message."""

    def __init__(self, file: Any, counts: Counter[str]) -> None:
        self._open_since: float | None = None
        self._writer = _mcap().Writer(file, chunk_size=CHUNK_BYTES)
        self._writer.start(profile="", library="strands-robots")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts = counts

    def write(self, topic: str, schema: Schema, at: float, data: bytes) -> None:
        """Write one message; ``at`` in seconds since the epoch."""
        channel = self._channels.get(topic)
        if channel is None:
            if schema.name not in self._schemas:
                registered = self._writer.register_schema(schema.name, schema.encoding, schema.data)
                self._schemas[schema.name] = registered
            channel = self._writer.register_channel(topic, schema.messages, self._schemas[schema.name])
            self._channels[topic] = channel
        self._writer.add_message(channel, log_time=_ns(at), data=data, publish_time=_ns(at))
        self._counts[topic] += 1
        if self._open_since is None:
            self._open_since = time.monotonic()
        elif self.due_s == 0:
            self.close_chunk()

    def write_joints(self, at: float, device: str, joints: Mapping[str, float]) -> None:
        """Write a joint state; nothing for a robot without joints."""
        if joints:
            self.write(f"/{device}/{JOINTS}", schemas.JOINT_STATE, at, schemas.joint_state(_ns(at), joints))

    @property
    def due_s(self) -> float | None:
        """Seconds until the open chunk has to be closed; None while none is open."""
        since = self._open_since
        return None if since is None else max(0.0, since + CHUNK_S - time.monotonic())

    def close_chunk(self) -> None:
        """Put everything written so far into the file."""
        self._writer.flush()
        self._open_since = None

    def finish(self) -> None:
        """Write the index, which completes the file."""
        self._writer.finish()


def read_items(path: Path) -> Iterator[RecordedItem]:
    """Read a recording in the order of writing; of a cut file, all whole chunks.

    Raises:
        MissingExtraError: the [record] extra is not installed.
        ValidationError: the file cannot be read, is no recording, or unpacks to more than one does.
    """
    _mcap()
    from mcap.exceptions import EndOfFile, McapError  # noqa: PLC0415 - an extra

    try:
        with path.open("rb") as file:
            for schema, channel, message in read_messages(file):
                item = _item(schema.name if schema else "", channel, message)
                if item is not None:
                    yield item
    except (EndOfFile, struct.error):
        return
    except OSError as exc:
        raise ValidationError(f"the recording {shown(str(path))} cannot be read: {exc.strerror}.") from exc
    except (McapError, ValueError) as exc:
        raise ValidationError(f"{shown(str(path))} is no recording of robots: {exc}.") from exc


def read_events(path: Path) -> Iterator[RecordedEvent]:
    """Read the events of a recording; raises as :func:`read_items` does."""
    return (item for item in read_items(path) if isinstance(item, RecordedEvent))


def recorded_actions(path: Path, device: str | None = None) -> list[Frame]:
    """Read one device's actions as a leader's frames, in seconds since the first.

    The joints serve as actions where the recording has none, as when the robot was moved by hand.

    Args:
        path: an ``.mcap`` file.
        device: the device to replay; ``WORLD/ROBOT``, or the world alone, for a robot of a simulated world.

    Raises:
        ValidationError: no actions or joints at all, or those of several devices and none named.
    """
    actions: dict[str, list[Frame]] = {}
    joints: dict[str, list[Frame]] = {}
    rows = values = 0
    for item in read_items(path):
        if isinstance(item, RecordedJoints):
            frames, action = joints.setdefault(item.device, []), dict(item.joints)
        elif isinstance(item, RecordedEvent) and item.event == STEP:
            given = item.payload.get("action")
            frames, action = actions.setdefault(item.robot, []), numbers(given if isinstance(given, Mapping) else {})
        else:
            continue
        if action and (not frames or item.at > frames[-1][0]):
            frames.append((item.at, action))
        rows, values = rows + 1, values + len(action)
        check_length(rows, values)
    usable = {**joints, **{robot: frames for robot, frames in actions.items() if frames}}
    if not usable:
        raise ValidationError(f"{path.name} has neither actions nor joints: nothing in it can lead.")
    named = {
        robot: each for robot, each in usable.items() if device is None or device in (robot, robot.partition("/")[0])
    }
    chosen = {robot: frames for robot, frames in named.items() if actions.get(robot)} or named
    if len(chosen) != 1:
        known = ", ".join(usable)
        raise ValidationError(f"device must be one of those that were recorded ({known}), not {shown(device)}.")
    (frames,) = chosen.values()
    return [(at - frames[0][0], action) for at, action in frames]


def _item(schema: str, channel: Any, message: Any) -> RecordedItem | None:
    at = message.log_time / 1e9
    device, _, last = channel.topic.strip("/").rpartition("/")
    if schema == schemas.JOINT_STATE.name:
        return RecordedJoints(at, device, schemas.read_joint_state(message.data))
    if schema == schemas.IMAGE.name:
        return RecordedPicture(at, device.removesuffix(f"/{CAMERA}"), last, schemas.read_compressed_image(message.data))
    if channel.message_encoding != schemas.EVENT.messages:
        return None
    payload = decode_json(message.data)
    if not isinstance(payload, Mapping):
        raise ValidationError(f"an event has {shown(payload)}")
    return RecordedEvent(at, device, last, payload)


def _level(item: RecordedEvent) -> int:
    if item.payload.get("state") == "error" or item.payload.get("error"):
        return schemas.ERROR
    return (
        schemas.WARNING
        if item.event.lower().startswith(("emergency", "halted", "locked", "motionrefused"))
        else schemas.INFO
    )


def _ns(seconds: float) -> int:
    return int(seconds * 1e9)


def _mcap() -> Any:
    return optional_module("mcap.writer", what="Recording", extra="record")


def units_in(features: Mapping[str, Any], part: str = "") -> dict[str, str]:
    """Return the units of the joints in the answer of ``getFeatures``.

    Of a world they are those of the robot ``part``, which may be left out where there is one.
    """
    robots = features.get("robots")
    stated = features if not isinstance(robots, Mapping) else robots.get(part)
    if part == "" and isinstance(robots, Mapping) and len(robots) == 1:
        stated = next(iter(robots.values()))
    units = stated.get("joint_units") if isinstance(stated, Mapping) else None
    found = units.items() if isinstance(units, Mapping) else ()
    return {str(name): unit for name, unit in found if isinstance(unit, str) and unit}


def beats(hz: float, over: threading.Event, missed: Callable[[int], None] = lambda count: None) -> Iterator[None]:
    """Yield at each beat until ``over`` is set; tell how many were missed meanwhile."""
    started, tick = time.monotonic(), 0
    while not over.wait(max(0.0, started + tick / hz - time.monotonic())):
        yield
        due = max(tick + 1, int((time.monotonic() - started) * hz))
        if due > tick + 1:
            missed(due - tick - 1)
        tick = due


class RobotRecording:
    """Samples a robot into ``recorder`` while it is entered as a context.

    A source that cannot be read for half a second is reported once in the log and once in the recording, as the event
    ``notRecorded``, and is still read at every beat. Each camera fails on its own. A beat that is missed is left out
    and counted in the event ``samplesSkipped``.

    Args:
        robot: behind the contract, or an object that :func:`~strands_robots.adapted.adapt` makes fit.
        recorder: entered, made with ``joints_of_events=False``.
        device: name of the robot in the recording.
        frames: takes its pictures; None for none.
        joints_hz: 1 to 200.
        cameras_hz: 0.1 to 60.
        pictures: takes the pictures in place of the recording; None where they are in it.

    Raises:
        ValidationError: a rate outside its domain, or an object that is no robot.
    """

    def __init__(
        self,
        robot: Any,
        recorder: Recorder,
        device: str,
        *,
        frames: Frames | None = None,
        joints_hz: float = JOINTS_HZ,
        cameras_hz: float = CAMERAS_HZ,
        pictures: Pictures | None = None,
    ) -> None:
        self._robot = behind_contract(robot)
        self._pictures = pictures
        self._recorder = recorder
        self._device = device
        self._frames = frames
        self._stopping = threading.Event()
        self.skipped: Counter[str] = Counter()
        """Beats that came too late, by source: joints, cameras, gate."""
        self._failing: dict[str, tuple[float, bool]] = {}
        self._generation = self._robot.gate.generation
        self._lock = ""
        sources: list[tuple[str, float, Callable[[], None]]] = [
            ("joints", number("joints_hz", joints_hz, low=1, high=200), self._sample_joints),
            ("gate", GATE_HZ, self._check_gate),
        ]
        if frames is not None:
            hz = number("cameras_hz", cameras_hz, low=0.1, high=60)
            sources.append(("cameras", hz, self._sample_pictures))
        self._threads = [
            threading.Thread(target=self._paced, args=source, name=f"record-{source[0]}", daemon=True)
            for source in sources
        ]
        self._unsubscribe: Unsubscribe = lambda: None
        self._unwatch: Unsubscribe = lambda: None

    def __enter__(self) -> Self:
        self._attempt("units", self._take_units)
        self._unsubscribe = observe(self._robot, self._record)
        self._unwatch = self._robot.gate.watch_refusals(self._refused)
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stopping.set()
        for thread in self._threads:
            thread.join()
        # The gate's own thread has ended; two checks at a time would record the same halt twice.
        self._attempt("gate", self._check_gate)
        self._unwatch()
        self._unsubscribe()
        if self.skipped:
            self._take("samplesSkipped", dict(self.skipped))

    def _take(self, event: str, payload: Mapping[str, Any]) -> None:
        self._recorder.take(self._device, event, payload)

    def _take_units(self) -> None:
        features = self._robot.get_features()
        for name in robots_in(self._robot) or [""]:
            if units := units_in(features, name):
                self._take(UNITS, {"units": units, **({"robot_name": name} if name else {})})

    def _refused(self, verb: str, why: str) -> None:
        self._take(REFUSED, {"verb": verb, "reason": why})

    def _paced(self, source: str, hz: float, sample: Callable[[], None]) -> None:
        for _ in beats(hz, self._stopping, lambda count: self.skipped.update({source: count})):
            self._attempt(source, sample)

    def _attempt(self, source: str, sample: Callable[[], None]) -> None:
        try:
            sample()
        except Exception as exc:  # noqa: BLE001 - a robot's read may raise anything; the recording goes on
            self._report(source, f"{type(exc).__name__}: {exc}")
        else:
            self._failing.pop(source, None)

    def _report(self, source: str, problem: str) -> None:
        now = time.monotonic()
        since, reported = self._failing.setdefault(source, (now, False))
        if reported or now - since < PATIENCE_S:
            return
        self._failing[source] = (since, True)
        logger.warning("%s: its %s are not recorded: %s", self._device, source, problem)
        self._take("notRecorded", {"what": source, "error": problem})

    def _sample_joints(self) -> None:
        state = self._robot.get_state()
        if holds_robots(self._robot):
            for name, joints in (state.get("robots") or {}).items():
                self._recorder.take_joints(f"{self._device}/{name}", numbers(joints))
            return
        if state.get("joints_error"):
            raise ConnectionError(state["joints_error"])
        self._recorder.take_joints(self._device, numbers(state.get("joints") or {}))

    def _sample_pictures(self) -> None:
        frames = self._frames() if self._frames is not None else {}
        for camera in frames:
            self._attempt(f"pictures of {camera}", partial(self._take_picture, frames, camera))

    def _take_picture(self, frames: Mapping[str, Any], camera: str) -> None:
        if self._pictures is not None:
            self._pictures(camera, frames[camera], None)
        else:
            self._recorder.take_picture(self._device, camera, jpeg(camera, frames[camera]))

    def _check_gate(self) -> None:
        gate = self._robot.gate
        if gate.generation != self._generation:
            self._generation = gate.generation
            self._take("halted", {})
        refusal = gate.refusal("motion")
        lock = "" if refusal is None else text_of(refusal)
        if lock != self._lock:
            self._lock = lock
            self._take("locked" if lock else "unlocked", {"reason": lock} if lock else {})

    def _record(self, event: RolloutEvent) -> None:
        """Record a rollout's event with its name and fields on Device Connect."""
        world = holds_robots(self._robot)
        robot = {"robot_name": event.robot} if world else {}
        kind = "policy" if world else "task"
        if event.kind == "step":
            step = {"step": event.step, "observation": dict(event.observation), "action": dict(event.action)}
            led = {"led_by": event.led_by} if event.led_by else {}
            self._take(STEP, {**step, **led, **robot})
        elif event.kind == "turn":
            self._take(TURN, {"state": event.state, "leader": event.led_by, "why": event.error, **robot})
        elif event.kind == "started":
            self._take(f"{kind}Started", {"instruction": event.instruction, "policy_provider": event.policy, **robot})
        else:
            end = {"instruction": event.instruction, "steps": event.step, "duration": event.elapsed_s}
            loop = {"loop": dict(event.loop)} if event.loop else {}
            self._take(f"{kind}Complete", {**end, "state": event.state, "error": event.error, **loop, **robot})
