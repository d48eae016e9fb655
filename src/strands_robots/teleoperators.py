"""Leaders that drive a follower: devices, keyboard, gamepad, and recordings.

A leader is any object with ``get_action() -> dict`` of targets by action key (a LeRobot teleoperator, a gamepad). It
may have ``is_connected`` and ``get_teleop_events()``, and raises :class:`LeaderFinished` at its end.

Source of the joystick format: Linux, ``Documentation/input/joydev/joystick-api.rst``: events of eight bytes, ``u32
time`` in milliseconds, ``s16 value``, ``u8 type`` (1 button, 2 axis, with 0x80 for the state at opening), ``u8
number``.

A ``.csv`` file has a first line of names: ``t`` (seconds, rising) and action keys, in the follower's units. An empty
cell leaves its joint unchanged.

A LeRobot dataset (v2.1 and v3.0) has ``data/chunk-000/*.parquet`` with the columns ``action`` (a list of numbers),
``timestamp`` (seconds in its episode) and ``episode_index``, and the action's names in ``meta/info.json``,
``features.action.names``: a list, or a mapping of one list.
"""

from __future__ import annotations

import bisect
import csv
import logging
import math
import os
import select
import struct
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol, Self, TextIO, cast

from strands_robots.errors import StrandsRobotsError
from strands_robots.leader_thread import LeaderSilentError, LeaderThread
from strands_robots.plug_ins import PlugIns
from strands_robots.policies.base import (
    LEADER_UNBOUNDED_PER_S,
    Action,
    Ranges,
    checked_action,
    limited,
    numbers,
    speeds_across,
)
from strands_robots.policies.decoding import read_json
from strands_robots.utils import ValidationError, mapping, missing_extra, number, shown

logger = logging.getLogger(__name__)

PLUG_INS = PlugIns("teleoperator", ("keyboard", "gamepad"))
"""Leaders of other packages; each is a callable that takes keyword options and returns a leader."""

GIVE_UP_S = 0.5
"""Longest time without a usable frame; after it the teleoperation ends with an error and the follower stops."""

FULL_RANGES_PER_S = 2.0
"""Speed bound of a joint with a range, in whole ranges a second."""

MAGNITUDE_MAX = 720.0
"""Largest target of a joint without a range, in its unit."""


class LeaderFinished(StrandsRobotsError):  # noqa: N818 - an end, not a fault
    """End of a leader's actions; raised by ``get_action``, it ends the teleoperation."""


class InputSink(Protocol):
    """Second receiver of a leader's frames, given by a network; it never blocks."""

    def publish(self, device: str, method: str, action: Mapping[str, float], events: Mapping[str, Any] | None) -> None:
        """Publish one frame; ``events`` is None where none could be read."""


def teleop_events(leader: Any) -> dict[str, Any] | None:
    """Return a leader's events by name, or None; raises the leader's exceptions."""
    read = getattr(leader, "get_teleop_events", None)
    events = read() if callable(read) else None
    # LeRobot names events by a plain enumeration.
    return None if events is None else {str(getattr(key, "value", key)): value for key, value in dict(events).items()}


class LeaderPolicy:
    """A leader as a policy: checked, renamed, clamped and bounded in speed.

    A frame that cannot be read or used is counted and not applied; after :data:`GIVE_UP_S` without a usable one the
    rollout ends with an error. A follower that starts apart from its leader moves there at the speed bound.

    Args:
        leader: has ``get_action()``.
        device: the leader's name on the network.
        method: kind of leader: arm, gamepad, keyboard or phone.
        keys: follower's key for each leader's key; unnamed keys keep their name.
        max_speed: whole joint ranges a second.
        period: control period, seconds.
        sink: receives every usable frame, as the leader gave it.
        thread: on which the leader is read; on that of the caller by default, which waits for a read that hangs.
    """

    uses_cameras = False

    def __init__(
        self,
        leader: Any,
        *,
        device: str = "leader",
        method: str = "arm",
        keys: Mapping[str, str] | None = None,
        max_speed: float = FULL_RANGES_PER_S,
        period: float = 0.02,
        sink: InputSink | None = None,
        thread: LeaderThread | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.frames = 0
        self.errors = 0
        self.event_errors = 0
        """Frames that went to the sink without events because reading those failed."""
        self.last_error = ""
        self._leader = leader
        self._device, self._method = device, method
        self._keys = dict(keys or {})
        self._max_speed = max_speed
        self._period = period
        self._sink = sink
        self._sink_failed = False
        self._thread = thread
        self._now = now
        self._ranges: Ranges = {}
        self._speeds: dict[str, float] | None = None
        self._last: dict[str, float] = {}
        self._usable_at = 0.0

    def reset(self, instruction: str, ranges: Ranges) -> None:
        if getattr(self._leader, "is_connected", True) is False:
            raise ValidationError(f"teleoperator {self._device} is not connected; connect it first.")
        self._ranges = {
            key: (max(low, -MAGNITUDE_MAX) if low == -math.inf else low, MAGNITUDE_MAX if high == math.inf else high)
            for key, (low, high) in ranges.items()
        }
        self._speeds = speeds_across(ranges, self._max_speed, LEADER_UNBOUNDED_PER_S)
        self._last = {}
        self._usable_at = self._now()

    def act(self, observation: Mapping[str, Any]) -> Action | list[Action] | None:
        now = self._now()
        try:
            frame = mapping("leader action", self._read(self._leader.get_action))
            target = checked_action({self._keys.get(key, key): value for key, value in frame.items()}, self._ranges)
        except LeaderFinished:
            return None
        except LeaderSilentError as exc:
            self.last_error = str(exc)
            raise
        except Exception as exc:
            self.errors += 1
            self.last_error = f"{type(exc).__name__}: {exc}"
            if now - self._usable_at >= GIVE_UP_S:
                raise
            return []
        self.frames += 1
        # A pause must not add up to a jump.
        dt = min(max(now - self._usable_at, self._period), 2 * self._period)
        self._usable_at = now
        if not self._last:
            self._last = {key: value for key, value in numbers(observation).items() if key in self._ranges}
        speeds = self._speeds or speeds_across(self._ranges, self._max_speed, LEADER_UNBOUNDED_PER_S)
        self._last = {**self._last, **limited(target, self._last, speeds, dt)}
        self._publish(frame)
        return {key: self._last[key] for key in target}

    def interrupt(self) -> None:
        """Wait no more for a read on the leader's own thread; no other is interrupted."""
        if self._thread is not None:
            self._thread.interrupt()

    def close(self) -> None:
        """End the leader's thread; the leader stays connected for its owner."""
        if self._thread is not None:
            self._thread.close()

    def _read(self, read: Callable[[], Any]) -> Any:
        return read() if self._thread is None else self._thread.read(read)

    def _publish(self, frame: Mapping[str, Any]) -> None:
        if self._sink is None:
            return
        try:
            self._sink.publish(self._device, self._method, numbers(frame), self._readable_events())
        except Exception:
            if not self._sink_failed:
                logger.exception("The frames of %s do not reach the network; the follower goes on.", self._device)
            self._sink_failed = True

    def events(self) -> dict[str, Any] | None:
        """Return the leader's events, or None; raises the leader's exceptions."""
        return cast("dict[str, Any] | None", self._read(partial(teleop_events, self._leader)))

    def _readable_events(self) -> dict[str, Any] | None:
        try:
            return self.events()
        except Exception as exc:
            self.event_errors += 1
            self.last_error = f"get_teleop_events: {type(exc).__name__}: {exc}"
            if self.event_errors == 1:
                logger.warning("The events of %s cannot be read; frames go on without.", self._device, exc_info=True)
            return None


class BoundedLeader:
    """A leader whose every frame is inside the follower's bounds.

    Args:
        policy: the leader as a policy, which checks, clamps and bounds its frames.
        start: the follower's position by action key; the first frames approach the leader's from there.
        ranges: of the follower's action keys.

    Raises:
        ValidationError: the leader is not connected.
    """

    is_connected = True

    def __init__(self, policy: LeaderPolicy, start: Mapping[str, float], ranges: Ranges) -> None:
        self.done = threading.Event()
        """Set when the leader has finished, or has failed for :data:`GIVE_UP_S`."""
        self.error = ""
        self._policy = policy
        self._start = dict(start)
        self._last: Action = {}
        policy.reset("lead a follower elsewhere", ranges)

    def get_action(self) -> Action:
        """Return the next frame, or the last one after the end.

        Raises:
            ValidationError: the leader gave no usable frame this time, or ended before its first.
        """
        action: object = None
        if not self.done.is_set():
            try:
                action = self._policy.act(self._start)
            except Exception as exc:  # noqa: BLE001 - a leader may raise anything; it ends, and the reason is stored
                self.error = f"{type(exc).__name__}: {exc}"
        if action is None:
            self.done.set()
            if not self._last:
                raise ValidationError("leader ended before its first frame.")
        elif isinstance(action, Mapping) and action:
            self._last = dict(action)
        else:
            raise ValidationError(f"leader gave nothing usable: {self._policy.last_error}.")
        return dict(self._last)

    def get_teleop_events(self) -> dict[str, Any] | None:
        """Return the leader's own events; raises the leader's exceptions."""
        return self._policy.events()


SHARE_PER_S = 0.25
"""Part of a joint's whole range that a key held down, or a stick pushed to its end, crosses in a second."""

JOG_UNBOUNDED_PER_S = 45.0
"""The same for a joint without a range, in its unit a second."""

UP, DOWN = "qwertyuiop", "asdfghjkl;"
"""Keys that raise and lower each joint, in the joints' order."""

STEP_S = 0.1
"""One press moves a joint as far as a key held down for this long."""

_END = "\x1b\x03\x04"

PORT = "/dev/input/js0"
DEAD_ZONE = 0.1
"""Part of a stick's travel that counts as rest."""

_EVENT = struct.Struct("<IhBB")
_BUTTON, _AXIS, _OPENING = 1, 2, 0x80
_END_BUTTON = 1
_FULL = 32767
_GAP_MAX_S = 0.1


class Jog:
    """Targets of some joints, each moved on its own and kept inside its range.

    Args:
        start: their positions by action key, in the follower's units.
        ranges: lowest and highest target by action key; a missing key is unbounded.
    """

    def __init__(self, start: Mapping[str, float], ranges: Ranges) -> None:
        if not start:
            raise ValidationError("start must hold at least one joint to lead.")
        self.keys = tuple(start)
        self._targets = dict(start)
        self._ranges = {key: ranges.get(key, (-math.inf, math.inf)) for key in start}

    @property
    def targets(self) -> Action:
        """The present targets of all joints."""
        return dict(self._targets)

    def move(self, key: str, push: float, seconds: float) -> None:
        """Push a joint for some seconds; ``push`` is -1 to 1."""
        low, high = self._ranges[key]
        speed = (high - low) * SHARE_PER_S if math.isfinite(high - low) else JOG_UNBOUNDED_PER_S
        self._targets[key] = min(max(self._targets[key] + push * speed * seconds, low), high)


class KeyboardLeader:
    """A leader of a terminal's keys, while entered; Escape or Ctrl-D ends it.

    Args:
        start: the follower's position by action key; at most ten joints.
        ranges: of the follower's action keys.
        fd: the terminal; standard input by default.
        other: gets each key that neither moves a joint nor ends it.

    Raises:
        ValidationError: too many joints, or ``fd`` is no terminal.
    """

    def __init__(
        self,
        start: Mapping[str, float],
        ranges: Ranges,
        fd: int | None = None,
        other: Callable[[str], None] = lambda key: None,
    ) -> None:
        if len(start) > len(UP):
            raise ValidationError(f"start must hold at most {len(UP)} joints, not {len(start)}.")
        self._fd = sys.stdin.fileno() if fd is None else fd
        if not os.isatty(self._fd):
            raise ValidationError("keyboard needs a terminal; standard input is none.")
        self._jog = Jog(start, ranges)
        self._pushes = {up: (key, 1.0) for up, key in zip(UP, self._jog.keys, strict=False)}
        self._pushes |= {down: (key, -1.0) for down, key in zip(DOWN, self._jog.keys, strict=False)}
        self._before: list[int | list[bytes | int]] | None = None
        self._other = other

    @property
    def is_connected(self) -> bool:
        """The terminal gives single keys."""
        return self._before is not None

    @property
    def help(self) -> list[tuple[str, str, str]]:
        """Name, raising key and lowering key of each joint."""
        return [(key, UP[index], DOWN[index]) for index, key in enumerate(self._jog.keys)]

    def __enter__(self) -> Self:
        self._before = termios.tcgetattr(self._fd)
        tty.setcbreak(self._fd)
        return self

    def __exit__(self, *exc: object) -> None:
        before, self._before = self._before, None
        if before is not None:
            termios.tcsetattr(self._fd, termios.TCSADRAIN, before)

    def get_action(self) -> Action:
        """Return all targets after the keys pressed since the last call.

        Raises:
            LeaderFinished: Escape or Ctrl-D was pressed.
        """
        while select.select([self._fd], [], [], 0)[0]:
            pressed = os.read(self._fd, 64).decode("ascii", "ignore")
            if not pressed:
                break
            for char in pressed:
                if char in _END:
                    raise LeaderFinished("the keyboard ended it")
                if char.lower() in self._pushes:
                    key, push = self._pushes[char.lower()]
                    self._jog.move(key, push, STEP_S)
                else:
                    self._other(char)
        return self._jog.targets


class GamepadLeader:
    """A leader of stick axes, one for each joint in order; button 1 ends it.

    Args:
        start: the follower's position by action key.
        ranges: of the follower's action keys.
        port: the joystick device.
        now: monotonic seconds.

    Raises:
        ValidationError: the device cannot be opened.
    """

    def __init__(
        self,
        start: Mapping[str, float],
        ranges: Ranges,
        port: str = PORT,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._jog = Jog(start, ranges)
        self._now = now
        self._at: float | None = None
        self._pushes: dict[int, float] = {}
        self._buttons: dict[int, bool] = {}
        try:
            self._fd: int | None = os.open(port, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as exc:
            raise ValidationError(f"gamepad {port!r} cannot be opened: {exc.strerror}.") from exc

    @property
    def is_connected(self) -> bool:
        """The device is open."""
        return self._fd is not None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)

    def get_action(self) -> Action:
        """Return all targets, pushed for the time since the last call, at most 0.1 s.

        Raises:
            LeaderFinished: button 1 was pressed.
            OSError: the gamepad was unplugged.
        """
        self._read()
        if self._buttons.get(_END_BUTTON):
            raise LeaderFinished("the gamepad ended it")
        now = self._now()
        seconds = 0.0 if self._at is None else min(now - self._at, _GAP_MAX_S)
        self._at = now
        for axis, push in self._pushes.items():
            if axis < len(self._jog.keys) and abs(push) > DEAD_ZONE:
                self._jog.move(self._jog.keys[axis], push, seconds)
        return self._jog.targets

    def get_teleop_events(self) -> dict[str, Any]:
        """Return the buttons' states by number."""
        return {f"button_{number}": pressed for number, pressed in self._buttons.items()}

    def _read(self) -> None:
        if self._fd is None:
            raise ConnectionError("the gamepad is closed")
        while True:
            try:
                data = os.read(self._fd, _EVENT.size * 64)
            except BlockingIOError:
                return
            for _, value, kind, place in _EVENT.iter_unpack(data[: len(data) // _EVENT.size * _EVENT.size]):
                if kind & ~_OPENING == _AXIS:
                    self._pushes[place] = max(value / _FULL, -1.0)
                elif kind & ~_OPENING == _BUTTON:
                    self._buttons[place] = bool(value)
            if len(data) < _EVENT.size * 64:
                return


Frame = tuple[float, Action]
"""Seconds since the start, and targets by action key."""

_TIME = "t"
_COLUMNS = ("action", "timestamp", "episode_index")
ROWS_MAX = 1_000_000
"""Frames of a file: five hours and a half at 50 Hz."""

VALUES_MAX = 64_000_000
BYTES_MAX = 2**30
BATCH_ROWS = 1024
LINE_MAX = 64 * 1024
"""Longest line of a .csv file, in characters."""


class RecordedLeader:
    """Leader that plays frames from its first ``get_action``, interpolated.

    Args:
        frames: at least one, in the order of their times.
        speed: factor of the recorded speed, above 0 and at most 10.
        now: monotonic seconds.

    Raises:
        ValidationError: no frame, times that do not rise, or ``speed`` outside its domain.
    """

    def __init__(self, frames: Sequence[Frame], speed: float = 1.0, now: Callable[[], float] = time.monotonic) -> None:
        if not frames:
            raise ValidationError("frames must hold at least one frame.")
        self._times = [seconds - frames[0][0] for seconds, _ in frames]
        if any(after <= before for before, after in zip(self._times, self._times[1:], strict=False)):
            raise ValidationError("frames must be in the order of their times, each later than the one before.")
        filled: Action = {}
        self._actions = [filled := {**filled, **action} for _, action in frames]
        self.keys = tuple(filled)
        self._speed = number("speed", speed, above=0, high=10)
        self._now = now
        self._started_at: float | None = None
        self.is_connected = True

    def rewind(self) -> None:
        """Play from the beginning at the next ``get_action``."""
        self._started_at = None

    def get_action(self) -> Action:
        """Return the present targets.

        Raises:
            LeaderFinished: the recording is over.
        """
        if self._started_at is None:
            self._started_at = self._now()
        seconds = (self._now() - self._started_at) * self._speed
        if seconds > self._times[-1]:
            raise LeaderFinished("the recording is over")
        at = bisect.bisect_right(self._times, seconds) - 1
        before = self._actions[at]
        if at + 1 == len(self._times):
            return dict(before)
        share = (seconds - self._times[at]) / (self._times[at + 1] - self._times[at])
        after = self._actions[at + 1]
        return {key: value + share * (after[key] - value) for key, value in before.items()}


def read_frames(path: Path) -> list[Frame]:
    """Read the frames of a ``.csv`` file.

    Raises:
        ValidationError: no such file, another kind of file, or a malformed line, which the message names.
    """
    if path.suffix != ".csv":
        raise ValidationError(f"a recording must be a .csv, .parquet or .mcap file, not {shown(str(path))}.")
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.reader(_lines(file, path.name))
            names = next(rows, [])
            if _TIME not in names or len(set(names)) != len(names) or len(names) < 2:
                raise ValidationError(f"the first line of {path.name} must name t and action keys, each once.")
            frames: list[Frame] = []
            for line, row in enumerate(rows, start=2):
                if row:
                    frames.append(_frame(names, row, f"line {line} of {path.name}"))
                check_length(len(frames), len(frames) * len(names))
            return frames
    except OSError as exc:
        raise ValidationError(f"the recording {shown(str(path))} cannot be read: {exc.strerror}.") from exc


def _lines(file: TextIO, name: str) -> Iterator[str]:
    while line := file.readline(LINE_MAX):
        if len(line) == LINE_MAX:
            raise ValidationError(f"a line of {name} has {LINE_MAX:,} characters or more.")
        yield line


def check_length(rows: int, values: int) -> None:
    """Refuse a recording of more frames or values than a robot's has.

    Raises:
        ValidationError: naming the bound.
    """
    _within("rows", rows, ROWS_MAX)
    _within("values", values, VALUES_MAX)


def _frame(names: list[str], row: list[str], place: str) -> Frame:
    if len(row) != len(names):
        raise ValidationError(f"{place} must have {len(names)} cells, not {len(row)}.")
    cells = dict(zip(names, row, strict=True))
    seconds = _cell(f"t in {place}", cells.pop(_TIME))
    return seconds, {name: _cell(f"{name} in {place}", cell) for name, cell in cells.items() if cell.strip()}


def _cell(name: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        raise ValidationError(f"{name} must be a number, not {shown(cell)}.") from None
    return number(name, value)


def read_episode(path: Path, episode: str | None = None) -> list[Frame]:
    """Read the frames of one episode of a LeRobot dataset.

    Args:
        path: a data file inside its dataset.
        episode: its number; needed where the file holds several.

    Raises:
        MissingExtraError: the [dataset] extra is not installed.
        ValidationError: no such file, no action in it, no names for them, or no episode of that number.
    """
    try:
        from pyarrow import ArrowException  # noqa: PLC0415 - an extra
        from pyarrow.parquet import ParquetFile  # noqa: PLC0415 - an extra
    except ModuleNotFoundError as exc:
        raise missing_extra("A recording in Parquet", "dataset") from exc
    try:
        with ParquetFile(path) as file:
            missing = [name for name in _COLUMNS if name not in file.schema_arrow.names]
            columns = {} if missing else _columns(file)
    except OSError as exc:
        raise ValidationError(f"the recording {shown(str(path))} cannot be read: {exc.strerror or exc}.") from exc
    except ArrowException as exc:
        raise ValidationError(f"{path.name} is no data file of a LeRobot dataset: {exc}.") from exc
    if missing:
        raise ValidationError(f"{path.name} is no data file of a LeRobot dataset: it has no column {missing[0]}.")
    wanted = _episode(path, columns["episode_index"], episode)
    names = _names(path)
    frames: list[Frame] = []
    rows = zip(columns["episode_index"], columns["timestamp"], columns["action"], strict=True)
    for row, (_, seconds, action) in enumerate(each for each in rows if each[0] == wanted):
        place = f"row {row} of episode {wanted} in {path.name}"
        if not isinstance(action, Sequence) or len(action) != len(names):
            raise ValidationError(f"action of {place} must have {len(names)} numbers ({', '.join(names)}).")
        values = {name: number(f"{name} in {place}", value) for name, value in zip(names, action, strict=True)}
        frames.append((number(f"timestamp of {place}", seconds), values))
    return frames


def _columns(file: Any) -> dict[str, list[Any]]:
    """Read the columns of a data file, a part at a time.

    A few kilobytes may state a billion rows of one value, so what the file states of itself is bounded first, and then
    what it really holds.

    Raises:
        ValidationError: it has more rows or values than a recording.
    """
    about = file.metadata
    groups = [about.row_group(number) for number in range(min(about.num_row_groups, ROWS_MAX))]
    parts = [group.column(number) for group in groups for number in range(group.num_columns)]
    parts = [part for part in parts if part.path_in_schema.partition(".")[0] in _COLUMNS]
    _within("rows", about.num_rows, ROWS_MAX)
    _within("values", sum(part.num_values for part in parts), VALUES_MAX)
    _within("bytes", sum(part.total_uncompressed_size for part in parts), BYTES_MAX)
    columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
    values = 0
    for batch in file.iter_batches(batch_size=BATCH_ROWS, columns=list(_COLUMNS)):
        values += batch.nbytes // 8
        _within("values", values, VALUES_MAX)
        for name, column in batch.to_pydict().items():
            columns[name] += column
        _within("rows", len(columns[_COLUMNS[0]]), ROWS_MAX)
    return columns


def _within(what: str, count: int, most: int) -> None:
    if not 0 <= count <= most:
        raise ValidationError(f"the recording has {count:,} {what}, and may have {most:,} at most.")


def _episode(path: Path, column: list[Any], requested: str | None) -> int:
    known = sorted(set(column))
    if requested is None and len(known) == 1:
        return int(known[0])
    if requested is not None and requested.isdecimal() and int(requested) in known:
        return int(requested)
    choices = f"{known[0]} to {known[-1]}" if known else "none"
    raise ValidationError(f"device must be an episode of {path.name} ({choices}), not {shown(requested)}.")


def _names(path: Path) -> list[str]:
    info = next((each / "meta" / "info.json" for each in path.resolve().parents if (each / "meta").is_dir()), None)
    try:
        content = read_json(info) if info is not None else {}
        names = content["features"]["action"]["names"]
    except (OSError, ValueError, KeyError, TypeError) as exc:
        raise ValidationError(f"{path.name} needs meta/info.json of its dataset, which names the actions.") from exc
    if isinstance(names, Mapping) and len(names) == 1:
        names = next(iter(names.values()))
    if not isinstance(names, list) or not names or len(set(names)) != len(names):
        raise ValidationError(f"features.action.names of {info} must be a list of names, not {shown(names)}.")
    return [str(name) for name in names]
