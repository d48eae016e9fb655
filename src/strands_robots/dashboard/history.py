"""Rows of robots, and their history: states of an hour, samples of 15 minutes.

A sample has joints, lag and load. The history lives in the page's server, so a page that is loaded again shows what
happened before. What a message costs is constant: states are noted when they change, everything else is read from the
rows once in ``SAMPLE_S``. Every length is bounded, per robot and in all.
"""

from __future__ import annotations

import json
import math
from array import array
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

MOVING, STILL, LOCKED, LOCKED_MOVING, SILENT = "m", "s", "l", "x", "q"
"""Moving, still, locked, moving although locked, silent; as they are sent."""

IN_MOTION = frozenset({"running", "stopping", "starting", "connecting"})
SILENT_S = 3.0
"""Seconds without a sign of life after which a robot is silent.

The silence begins at the last sign of life.
"""

WINDOW_S = 3600.0
CHANGES_MAX = 1000
"""Changes of state that are kept for one robot: 17 a minute for an hour."""

SAMPLE_S, SAMPLES = 2.0, 450
"""Seconds between two samples, and samples: 15 minutes."""

ROBOT_JOINTS_MAX, JOINTS_MAX = 16, 8192
"""Joints that are kept of one robot, and of all; 512 robots have their 16."""

JOINTS_OLD_S = 15.0
"""Age from which joints are not sampled; at rest they come once in 10 s."""

STOPS_MAX = 1000
"""Presses of STOP and halts that are kept."""

OVERLAP_S = 30.0
"""Seconds that an update goes back: a silence is found after it began."""

HISTORY_S, HISTORY_HZ = 30.0, 10.0
"""Joints that a row has: for so long, so many times a second."""

NAN = float("nan")
_BLANK = array("f", [NAN]) * SAMPLES

Joints = dict[str, float]


@dataclass(slots=True)
class RobotRow:
    """One robot of one network.

    Attributes:
        cell: the cell that it is in, empty for none; None where it did not say, and stops with every cell.
        locked: None where it did not say, or where its answer does not count; ``doubt`` has the reason.
        heard: monotonic seconds of the last sign of life; None before the first.
        stop: its answer to the latest emergency stop, first given at ``stop_at``; ``freed`` once it is not locked by
            that stop any more.
        locked_by: the latest emergency stop, once the robot has said that it locks it.
        load: of its host, as it says it: 1-minute load average over the number of cores.
        messages: signs of life since the last sample of the history, and ``gap_s`` the longest time between two.
        units: unit of each joint's position, as its features name it; ``limits`` are in the same.
        forms: its verbs, as :func:`~strands_robots.dashboard.feeds.verb_forms` describes them.
        holdable: its control lease can be acquired.
        led: it follows a leader elsewhere.
        lacking: what a device that is none of ours does not have: a lockout, a lease, a stop.
        hidden: another row shows the same robot.
        namesake: another robot of this id has a row, too.
        changed: number of the model's last change of something that the page shows at once.
        ticked: the same for what it shows twice a second.
    """

    key: str
    network: str
    id: str
    kind: str = ""
    model: str = ""
    cell: str | None = None
    task: dict[str, Any] = field(default_factory=dict)
    locked: bool | None = None
    lockouts: list[dict[str, Any]] = field(default_factory=list)
    doubt: str = ""
    alarm: bool = False
    stop: dict[str, Any] | None = None
    stop_at: float = 0.0
    locked_by: str = ""
    control: dict[str, Any] = field(default_factory=dict)
    control_announced_at: float = float("-inf")
    check_in: dict[str, Any] | None = None
    forms: tuple[Mapping[str, Any], ...] = ()
    holdable: bool = False
    led: bool = False
    lacking: str = ""
    hidden: bool = False
    namesake: bool = False
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    cameras: tuple[str, ...] = ()
    heard: float | None = None
    link_ms: float | None = None
    load: float | None = None
    messages: int = 0
    gap_s: float = 0.0
    expected: bool = False
    changed: int = 0
    ticked: int = 0
    joints: dict[str, Joints] = field(default_factory=dict)
    joints_at: float = 0.0
    history: deque[tuple[float, dict[str, Joints]]] = field(
        default_factory=lambda: deque(maxlen=int(HISTORY_S * HISTORY_HZ))
    )
    encoded: tuple[int, int, str] = (-1, -1, "")

    def facts(self) -> dict[str, Any]:
        """Return the row as a card shows it."""
        verbs = [str(each["name"]) for each in self.forms]
        return {
            "key": self.key,
            "network": self.network,
            "id": self.id,
            "kind": self.kind,
            "model": self.model,
            "cell": self.cell,
            "task": self.task,
            "locked": self.locked,
            "lockouts": self.lockouts,
            "doubt": self.doubt,
            "alarm": self.alarm,
            "stop": self.stop,
            "control": self.control,
            "check_in": self.check_in,
            "heard": None if self.heard is None else round(self.heard, 3),
            "link_ms": None if self.link_ms is None else round(self.link_ms, 1),
            "pictures": "getPicture" in verbs,
            "expected": self.expected,
            "lacking": self.lacking,
            "namesake": self.namesake,
        }

    def text(self) -> str:
        """Return :meth:`facts` as JSON, encoded once for each change."""
        if self.encoded[:2] != (self.changed, self.ticked):
            self.encoded = (self.changed, self.ticked, json.dumps(self.facts(), allow_nan=False, default=str))
        return self.encoded[2]


def state_of(row: RobotRow) -> str:
    """Return the state of a robot that is heard; an unknown lockout is none."""
    moving = row.task.get("state") in IN_MOTION
    if row.locked:
        return LOCKED_MOVING if moving else LOCKED
    return MOVING if moving else STILL


class States:
    """Changes of state of one robot, oldest first.

    Attributes:
        number: of the latest change in the history of all.
    """

    __slots__ = ("letters", "number", "starts")

    def __init__(self) -> None:
        self.starts, self.letters, self.number = array("d"), bytearray(), 0

    def enter(self, state: str, at: float) -> bool:
        """Note a state since ``at``; False where it is the present one."""
        letter = ord(state)
        if self.letters and self.letters[-1] == letter:
            return False
        if self.starts and at <= self.starts[-1]:
            # The present state would have no duration: it is replaced.
            self.letters[-1] = letter
            if len(self.letters) > 1 and self.letters[-2] == letter:
                del self.starts[-1], self.letters[-1]
        else:
            self.starts.append(at)
            self.letters.append(letter)
        drop = len(self.starts) - CHANGES_MAX
        # The state in force at the start of the window is kept.
        drop = max(drop, bisect_right(self.starts, self.starts[-1] - WINDOW_S) - 1)
        if drop > 0:
            del self.starts[:drop], self.letters[:drop]
        return True

    def since(self, at: float) -> tuple[list[float], str]:
        """Return the changes since a time, with the state in force then as the first."""
        first = max(0, bisect_right(self.starts, at) - 1)
        return list(self.starts[first:]), self.letters[first:].decode("ascii")


class Series:
    """Samples of one robot, each at the slot of its time in the history of all.

    Attributes:
        lag: longest time without a message (ms), and ``answer`` the round trip of a question (ms).
        rate: messages a second; ``load``: of its host, as the robot says it, 1 is all cores busy.
    """

    __slots__ = ("answer", "joints", "lag", "load", "rate", "seen")

    def __init__(self) -> None:
        self.lag, self.answer, self.rate, self.load = (_BLANK[:] for _ in range(4))
        self.joints: dict[tuple[str, str], array[float]] = {}
        self.seen = 0

    def arrays(self) -> tuple[array[float], ...]:
        """Return all of its samples."""
        return (self.lag, self.answer, self.rate, self.load, *self.joints.values())


class History:
    """States and samples of every robot of a fleet; its owner serializes the access.

    Attributes:
        silent_s: seconds without a sign of life after which a robot is silent.
        number: of the latest change of a state.
        stops: presses of STOP and halts by the pages: event, wall time and the robot's key, empty for all.
    """

    def __init__(self) -> None:
        self.stops: deque[tuple[str, float, str]] = deque(maxlen=STOPS_MAX)
        self.silent_s = SILENT_S
        self._states: dict[str, States] = {}
        self._series: dict[str, Series] = {}
        self._times = array("d", [NAN]) * SAMPLES
        self._count = 0
        self._joints = 0
        self.number = 0

    # Written by the model, in constant time.

    def changed(self, row: RobotRow, now: float) -> None:
        """Note a robot's state after a change of its row, unless it is silent."""
        states = self._states.get(row.key)
        if row.heard is not None and (states is None or states.letters[-1] != ord(SILENT)):
            self._enter(row.key, state_of(row), now)

    def heard(self, row: RobotRow, before: float | None, now: float) -> None:
        """Note that a robot was heard now, and a silence since ``before``."""
        if before is not None and now - before > self.silent_s:
            self._enter(row.key, SILENT, before)
        states = self._states.get(row.key)
        if states is None or states.letters[-1] == ord(SILENT):
            self._enter(row.key, state_of(row), now)

    def forget(self, key: str) -> None:
        """Remove a robot."""
        self._states.pop(key, None)
        series = self._series.pop(key, None)
        self._joints -= len(series.joints) if series is not None else 0

    # Once in SAMPLE_S.

    def begin_sample(self, now: float) -> None:
        """Begin the samples of a new time."""
        # As it is sent: a page asks for what came after the last time that it got.
        self._times[self._count % SAMPLES] = round(now, 3)
        self._count += 1

    def sample(self, row: RobotRow, now: float) -> None:
        """Take a robot's sample of this time, once; and notice that it is silent."""
        if row.heard is None:
            self._enter(row.key, SILENT, now)
        elif now - row.heard > self.silent_s:
            self._enter(row.key, SILENT, row.heard)
        series = self._series.setdefault(row.key, Series())
        if self._count in (0, series.seen):
            return
        slot, before = (self._count - 1) % SAMPLES, self._times[(self._count - 2) % SAMPLES]
        passed = now - before if self._count > 1 else NAN
        for each in series.arrays():
            each[slot] = NAN
        series.seen = self._count
        age = NAN if row.heard is None else now - row.heard
        series.lag[slot] = NAN if row.heard is None else max(age, row.gap_s) * 1000
        series.rate[slot] = row.messages / passed if passed > 0 else NAN
        series.answer[slot] = NAN if row.link_ms is None else row.link_ms
        series.load[slot] = NAN if row.load is None else row.load
        row.messages, row.gap_s = 0, 0.0
        if age > self.silent_s:
            # What it said last is not what it does now.
            series.answer[slot] = series.load[slot] = NAN
            return
        if now - row.joints_at > JOINTS_OLD_S:
            return
        for part, joints in row.joints.items():
            for name, value in joints.items():
                self._joint(series, part, name, slot, value)

    def _joint(self, series: Series, part: str, name: str, slot: int, value: float) -> None:
        found = series.joints.get((part, name))
        if found is None:
            if len(series.joints) >= ROBOT_JOINTS_MAX or self._joints >= JOINTS_MAX:
                return
            found = series.joints[part, name] = _BLANK[:]
            self._joints += 1
        # A number beyond a float of 32 bits is none that a joint has.
        found[slot] = value if abs(value) < 1e30 else NAN

    # Read by the pages.

    def states(self, key: str, number: int, at: float) -> tuple[list[float], str] | None:
        """Return a robot's changes since ``at``, None without any after ``number``."""
        states = self._states.get(key)
        if states is None or states.number <= number:
            return None
        return states.since(at)

    def series(self, key: str, after: float) -> tuple[list[float], dict[str, list[float]]] | None:
        """Return the times after ``after``, and a robot's values then by name.

        No value is NaN. The names are lag, answer, rate, load and ``joint:PART/NAME``.
        """
        series = self._series.get(key)
        if series is None:
            return None
        slots = [count % SAMPLES for count in range(max(0, self._count - SAMPLES), self._count)]
        if series.seen < self._count and slots:
            del slots[-1]  # its sample of this time comes yet
        slots = [slot for slot in slots if self._times[slot] > after]
        names = {"lag": series.lag, "answer": series.answer, "rate": series.rate, "load": series.load}
        joints = {f"joint:{part}/{name}": values for (part, name), values in series.joints.items()}
        found = {name: [values[slot] for slot in slots] for name, values in (names | joints).items()}
        return [self._times[slot] for slot in slots], found

    @property
    def size_bytes(self) -> int:
        """Bytes of all numbers that are kept."""
        states = sum(len(each.starts) * 8 + len(each.letters) for each in self._states.values())
        return states + sum(len(each) * 4 for series in self._series.values() for each in series.arrays())

    def _enter(self, key: str, state: str, at: float) -> None:
        states = self._states.get(key)
        if states is None:
            states = self._states[key] = States()
        if states.enter(state, at):
            self.number += 1
            states.number = self.number


def plain_values(values: list[float]) -> list[float | None]:
    """Return values as JSON has them: None where there is none."""
    return [None if math.isnan(value) else round(value, 4) for value in values]
