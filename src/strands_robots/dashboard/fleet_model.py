"""Fleet as the page shows it: one row a robot, its joints, and a timeline.

Feeds write from their own threads and pages read from the server's loop, so every access takes the lock. What a network
says is cut to a bounded length here, and is shown as text only.
"""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from itertools import chain
from typing import Any

from strands_robots.dashboard.history import HISTORY_HZ, OVERLAP_S, WINDOW_S, History, RobotRow, plain_values
from strands_robots.envelope import jsonable
from strands_robots.fleet.adapter import LockoutReport
from strands_robots.policies.base import plain_numbers
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.utils import plain_text

ROBOTS_MAX = 2000
"""Rows; further names are not taken, so that invented ones use no memory."""

TEXT_MAX, NAME_MAX = 300, 128
TIMELINE_MAX = 1000
LOCKOUTS_MAX = 8
LOCKS_WITHIN_S = 3.0
"""Seconds from a robot's answer to a stop until a status without that lockout means that it was resumed."""

JOINTS_MAX = 64
CONTROL_EVENTS = frozenset({"controlTaken", "controlExpired", "control taken here"})
CONTROL_ANNOUNCED_S = 3.0
"""Seconds after such an event in which a status with another holder tells nothing new."""

UNSETTLED = frozenset({"not_stopped", "alarm", "refused", "unknown", "claimed"})
UNANSWERED_S = 1.0
"""Seconds after a stop in which a robot on a second network may still answer it."""


class FleetModel:
    """Rows by key, the timeline, and numbers that rise with every change.

    Args:
        clock: monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self.history = History()
        self._lock = threading.Lock()
        self._rows: dict[str, RobotRow] = {}
        self._keys_of: dict[str, tuple[str, ...]] = {}
        self._timeline: deque[tuple[int, str]] = deque(maxlen=TIMELINE_MAX)
        self._number = 0
        self._gone: deque[tuple[int, str]] = deque(maxlen=TIMELINE_MAX)
        self._expected: dict[str, tuple[tuple[str, str | None], ...]] = {}

    # Written by the feeds.

    def update(self, network: str, name: str, **facts: Any) -> None:
        """Set fields of a robot's row, made if it is new; only a change counts."""
        with self._lock:
            row = self._row(network, name)
            if row is None:
                return
            changed, cell = False, row.cell
            for field_name, value in facts.items():
                if getattr(row, field_name) != value:
                    setattr(row, field_name, value)
                    changed = True
            if changed:
                row.changed = self._next()
                self.history.changed(row, self.clock())
            if "expected" in facts or row.cell != cell:
                self._note_expected(network)

    def sign_of_life(self, network: str, name: str, link_ms: float | None = None) -> None:
        """Note that a known robot was heard now, after a round trip of ``link_ms``."""
        with self._lock:
            row = self._rows.get(key_of(network, name))
            if row is not None:
                before, row.heard = row.heard, self.clock()
                row.messages += 1
                row.gap_s = max(row.gap_s, 0.0 if before is None else row.heard - before)
                self.history.heard(row, before, row.heard)
                row.link_ms = row.link_ms if link_ms is None else link_ms
                row.ticked = self._next()

    def task(self, network: str, name: str, **task: Any) -> None:
        """Set what a robot does; its number of steps changes twice a second only.

        A message that says less of the same task than another one takes nothing of it away.
        """
        with self._lock:
            row = self._rows.get(key_of(network, name))
            if row is None:
                return
            new = {field_name: _cut(value) for field_name, value in task.items()}
            if all(row.task.get(each) == new.get(each) for each in ("state", "instruction")):
                new = {**row.task, **new}
            steps = {"step"}
            same = all(row.task.get(each) == new.get(each) for each in (row.task.keys() | new.keys()) - steps)
            row.task = new
            number = self._next()
            if same:
                row.ticked = number
            else:
                row.changed = number
                self.history.changed(row, self.clock())

    def load(self, network: str, name: str, load: float) -> None:
        """Set the load of a robot's host, 1 for all of its cores."""
        with self._lock:
            row = self._rows.get(key_of(network, name))
            if row is not None:
                row.load = load

    def observe(self, network: str, name: str, joints: Mapping[str, Any], part: str = "") -> None:
        """Take the joints of a robot, or of one robot of a world."""
        found = dict(list(plain_numbers(joints).items())[:JOINTS_MAX])
        if not found:
            return
        with self._lock:
            row = self._rows.get(key_of(network, name))
            if row is None or (part not in row.joints and len(row.joints) >= JOINTS_MAX):
                return
            now = self.clock()
            row.joints = {**row.joints, _cut(part): found}
            row.joints_at = now
            if not row.history or now - row.history[-1][0] >= 0.9 / HISTORY_HZ:
                row.history.append((now, row.joints))

    def report(self, network: str, answer: LockoutReport) -> None:
        """Take a robot's answer about its lockouts; one that does not count is a doubt."""
        facts = answer.facts
        if answer.problem:
            # A robot that is only silent keeps what it said; its age shows.
            if facts or "ALARM" in answer.problem:
                self.update(
                    network, answer.name, locked=None, doubt=_cut(answer.problem), alarm="ALARM" in answer.problem
                )
            return
        rows = [
            {**each.fields(), **({} if each.scope.everything else {"scope": str(each.scope)})}
            for each in answer.lockouts[:LOCKOUTS_MAX]
        ]
        self._note_freed(network, answer.name, {each.epoch for each in answer.lockouts}, answer.at)
        control = _control(facts.get("control"))
        self._note_control(network, answer.name, control)
        self.update(
            network,
            answer.name,
            locked=bool(answer.lockouts),
            lockouts=[{name: _cut(value) for name, value in row.items()} for row in rows],
            doubt="",
            alarm=False,
            cell=_cut(facts["cell"]) if isinstance(facts.get("cell"), str) else None,
            control=control,
            check_in=_check_in(facts.get("check_in")),
        )

    def _note_control(self, network: str, name: str, control: Mapping[str, Any]) -> None:
        """Add a change of the holder that the robot has not just told by an event."""
        with self._lock:
            row = self._rows.get(key_of(network, name))
            announced = row is not None and self.clock() - row.control_announced_at < CONTROL_ANNOUNCED_S
            before = row.control if row is not None else {}
        holder, had = control.get("holder"), before.get("holder")
        # What held it before the page came is no change.
        if not before or not control or announced or holder == had:
            return
        if not control["held"]:
            self.note(network, name, "control released", {"by": had})
        elif not before["held"]:
            self.note(network, name, "control acquired", {"by": holder, "kind": control.get("kind")})
        else:
            self.note(network, name, "control changed", {"from": had, "by": holder, "kind": control.get("kind")})

    def _note_freed(self, network: str, name: str, epochs: set[str], at: float) -> None:
        """Mark the answer to a stop that locks the robot no more: it is past."""
        with self._lock:
            row = self._rows.get(key_of(network, name))
            stop = row.stop if row is not None else None
            if row is None or stop is None or stop.get("freed"):
                return
            if stop["id"] in epochs:
                row.locked_by = stop["id"]
            elif row.locked_by == stop["id"] or at - row.stop_at > LOCKS_WITHIN_S:
                row.stop = {**stop, "freed": True}
                row.changed = self._next()

    def verdict(self, network: str, name: str, stop: Mapping[str, Any]) -> None:
        """Set a robot's answer to the latest emergency stop."""
        with self._lock:
            row = self._row(network, name)
            if row is None:
                return
            known = row.stop
            if known is None or known["id"] != stop["id"]:
                row.stop_at = self.clock()
            elif known.get("freed"):
                stop = {**stop, "freed": True}
            if known != stop:
                row.stop, row.changed = dict(stop), self._next()

    def note(self, network: str, name: str, event: str, facts: Mapping[str, Any], *, audit: bool = False) -> None:
        """Add an entry to the timeline."""
        shown = {
            _cut(each): _cut(value)
            for each, value in list(facts.items())[:12]
            if not str(each).startswith("_") and each not in ("event_id", "ts", "sig", "key", "nonce")
        }
        entry: dict[str, Any] = {
            "key": key_of(network, name) if name else "",
            "robot": _cut(name),
            "event": _cut(event),
            "facts": shown,
            "at": time.time(),
            "audit": audit,
        }
        with self._lock:
            row = self._rows.get(entry["key"])
            if row is not None and event in CONTROL_EVENTS:
                row.control_announced_at = self.clock()
            if row is not None and row.hidden:
                # The row that is shown tells the same.
                return
            number = self._next()
            self._timeline.append((number, json.dumps({**entry, "n": number}, allow_nan=False, default=str)))

    def note_stop(self, event: str, facts: Mapping[str, Any], network: str = "", name: str = "") -> None:
        """Add a page's STOP or halt to the timeline and to the history.

        The timeline has what robots say, too; no robot writes into the history's stops.
        """
        self.note(network, name, event, facts)
        with self._lock:
            self.history.stops.append((event, round(time.time(), 3), key_of(network, name) if name else ""))

    def forget(self, key: str, longer_than_s: float) -> bool:
        """Remove a robot that was silent for so long; False where it was not."""
        with self._lock:
            row = self._rows.get(key)
            if row is None or (row.heard is not None and self.clock() - row.heard < longer_than_s):
                return False
            del self._rows[key]
            self._keys_of[row.id] = tuple(each for each in self._keys_of[row.id] if each != key)
            self.history.forget(key)
            self._gone.append((self._next(), key))
            self._note_expected(row.network)
            return True

    def arrange(self, hidden: Collection[str], namesakes: Collection[str]) -> None:
        """Set which rows are hidden, and which have the id of another robot's."""
        with self._lock:
            for key, row in self._rows.items():
                now = (key in hidden, key in namesakes)
                if now != (row.hidden, row.namesake):
                    row.hidden, row.namesake = now
                    row.changed = self._next()
                    if row.hidden:
                        self._gone.append((row.changed, key))

    # Read by the pages.

    def on_several_networks(self) -> dict[str, tuple[RobotRow, ...]]:
        """Return the rows of each id that is on several networks."""
        with self._lock:
            return {
                name: tuple(self._rows[key] for key in keys) for name, keys in self._keys_of.items() if len(keys) > 1
            }

    def silent(self, row: RobotRow) -> bool:
        """Return whether a robot was not heard for longer than it may be."""
        return row.heard is None or self.clock() - row.heard > self.history.silent_s

    def unsettled(self, row: RobotRow) -> bool:
        """Return whether a row says what must be seen: a bad answer to a stop, a doubt."""
        stop = row.stop or {}
        late = stop.get("state") == "silent" and self.clock() - row.stop_at > UNANSWERED_S
        return bool(row.alarm or row.doubt or late or stop.get("state") in UNSETTLED or "alarm" in stop)

    def expected(self, network: str, scope: Scope = EVERY_ROBOT) -> tuple[str, ...]:
        """Return the robots that must answer a stop of all or of a cell; takes no lock.

        A robot that states no cell reads no scope, and stops whatever it is.
        """
        rows = self._expected.get(network, ())
        return tuple(name for name, cell in rows if cell is None or scope.covers(name, {cell} - {""}))

    def networks(self) -> Collection[str]:
        """Return the networks that have a row."""
        with self._lock:
            return {row.network for row in self._rows.values()}

    def row(self, key: str) -> RobotRow | None:
        """Return the row of a robot, or None."""
        with self._lock:
            return self._rows.get(key)

    def rows(self) -> list[RobotRow]:
        """Return all rows."""
        with self._lock:
            return list(self._rows.values())

    def changes(self, since: int, ticks_since: int | None = None) -> tuple[int, str]:
        """Return the number of the present, and a page's message with what changed.

        Args:
            since: the number that the page got last; 0 for everything.
            ticks_since: the same for what is shown twice a second; None leaves it out.
        """
        with self._lock:
            rows = [
                row.text()
                for row in self._rows.values()
                if not row.hidden and (row.changed > since or (ticks_since is not None and row.ticked > ticks_since))
            ]
            entries = [text for number, text in self._timeline if number > since]
            # A row that was hidden, or forgotten, may be shown again.
            gone = [
                key
                for number, key in self._gone
                if number > since and (key not in self._rows or self._rows[key].hidden)
            ]
            now = self.clock()
            if not rows and not entries and not gone:
                return self._number, ""
            return self._number, (
                f'{{"type":"fleet","now":{now:.4f},"rows":[{",".join(rows)}],'
                f'"events":[{",".join(entries)}],"gone":{json.dumps(gone)}}}'
            )

    def details(self, key: str) -> dict[str, Any] | None:
        """Return what the view of one robot shows besides its card, or None."""
        with self._lock:
            row = self._rows.get(key)
            if row is None:
                return None
            return {
                "type": "robot",
                "key": key,
                "forms": list(row.forms),
                "holdable": row.holdable,
                "led": row.led,
                "limits": row.limits,
                "units": row.units,
                "cameras": row.cameras,
                "now": self.clock(),
                "history": [[round(at, 3), joints] for at, joints in row.history],
            }

    def joints(self, key: str, since: float) -> dict[str, Any] | None:
        """Return a robot's joints if they are newer than ``since``."""
        with self._lock:
            row = self._rows.get(key)
            if row is None or row.joints_at <= since:
                return None
            return {"type": "joints", "key": key, "at": row.joints_at, "now": self.clock(), "joints": row.joints}

    def begin_sample(self) -> list[str]:
        """Begin a sample of the history, and return the robots whose values it takes."""
        with self._lock:
            self.history.begin_sample(self.clock())
            return list(self._rows)

    def sample(self, keys: Iterable[str]) -> None:
        """Take the values of some robots."""
        with self._lock:
            now = self.clock()
            for row in filter(None, map(self._rows.get, keys)):
                self.history.sample(row, now)

    def states(self, keys: Iterable[str], number: int, at: float) -> Iterator[str]:
        """Yield each robot's changes of state since a question, encoded.

        Args:
            keys: of the robots.
            number: the history's number at that question; 0 for everything.
            at: the time of it.
        """
        for key in keys:
            with self._lock:
                found = self.history.states(key, number, at - OVERLAP_S)
            if found is not None:
                starts = [round(each, 2) for each in found[0]]
                yield json.dumps({"key": key, "at": starts, "as": found[1]}, allow_nan=False)

    def stops(self) -> list[tuple[str, float, str]]:
        """Return the presses of STOP and the halts of the history's window.

        Each has its event, wall time and the robot's key, empty for all.
        """
        since = time.time() - WINDOW_S
        with self._lock:
            return [each for each in self.history.stops if each[1] > since]

    def series(self, key: str, after: float) -> Iterator[str] | None:
        """Return the samples of a robot after a time, a line a series, or None."""
        with self._lock:
            row, found = self._rows.get(key), self.history.series(key, after)
        if row is None or found is None:
            return None
        times, values = found
        head = json.dumps({"key": key, "times": times, "units": row.units}, default=str)
        lines = (json.dumps({"name": name, "values": plain_values(each)}) for name, each in values.items())
        return chain((head,), lines)

    def _row(self, network: str, name: str) -> RobotRow | None:
        key = key_of(network, name)
        row = self._rows.get(key)
        if row is None and len(self._rows) < ROBOTS_MAX and name:
            row = self._rows[key] = RobotRow(key, network, name[:NAME_MAX])
            row.changed = self._next()
            self._keys_of[row.id] = (*self._keys_of.get(row.id, ()), key)
        return row

    def _note_expected(self, network: str) -> None:
        names = tuple((row.id, row.cell) for row in self._rows.values() if row.network == network and row.expected)
        self._expected = {**self._expected, network: names}

    def _next(self) -> int:
        self._number += 1
        return self._number


def key_of(network: str, name: str) -> str:
    """Return the key of a robot: its network and its id there."""
    return f"{network}:{name}"


def _cut(value: object) -> Any:
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, float):
        return round(value, 6) if abs(value) < 1e15 else repr(value)
    return plain_text(value if isinstance(value, str) else json.dumps(jsonable(value)), TEXT_MAX)


def _control(facts: object) -> dict[str, Any]:
    """Return who holds a robot; of a world the first that is held."""
    if not isinstance(facts, Mapping):
        return {}
    rows: Iterable[Any] = [facts] if "held" in facts else facts.values()
    holders = [row for row in rows if isinstance(row, Mapping) and row.get("held") is True]
    if not holders:
        return {"held": False}
    return {"held": True, "holder": _cut(holders[0].get("holder")), "kind": _cut(holders[0].get("kind"))}


LEFT_MAX_S = 1e9


def _check_in(facts: object) -> dict[str, Any] | None:
    if not isinstance(facts, Mapping) or facts.get("required") is not True:
        return None
    left = facts.get("time_left_s")
    # A number that JSON has no word for would end the messages of every page.
    return {"left_s": round(float(left), 1) if isinstance(left, int | float) and abs(left) < LEFT_MAX_S else 0.0}
