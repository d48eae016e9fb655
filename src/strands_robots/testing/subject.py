"""Robot under test, its long motion, and the recorder of its bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import wraps
from typing import Any

from strands_robots.utils import ValidationError, number, shown, text

Values = Mapping[str, float]
"""Positions by joint, in the unit in which the robot states its limits."""


@dataclass(frozen=True, slots=True)
class BusWrite:
    """One write to a robot's bus: its moment in monotonic s, and what was written.

    ``values`` are the joints' positions that it commands; empty where the recorder was not given any.
    """

    at: float
    what: str
    values: Values = field(default_factory=dict)


class BusRecorder:
    """Writes to an emulated bus, and faults of it.

    The proof of a stop is that no write follows the verdict, so record what moves the hardware at the place that
    writes it::

        recorder = BusRecorder()
        recorder.watch(robot.bus, "write", "sync_write")     # these methods of it

    or call :meth:`wrote` from the emulated bus itself, before each write. With the positions that each write commands
    the limits and speeds of the robot are proven as well::

        recorder.wrote("goal", {"pan": 12.5})
        recorder.watch(device, "send_action", values=lambda action: action)
    """

    def __init__(self) -> None:
        self._writes: list[BusWrite] = []
        self._fault: Callable[[], None] | None = None
        self._met = True

    def wrote(self, what: object = "", values: Values | None = None, *, can_fail: bool = True) -> None:
        """Record a write that is made now; raise what a check has the bus raise.

        Args:
            what: in a few words.
            values: the positions that it commands, by joint, in the unit of the robot's limits.
            can_fail: False for a write that no fault keeps from its place.
        """
        if can_fail:
            self.fail()
        self._writes.append(BusWrite(time.monotonic(), str(what)[:200], dict(values or {})))

    def fail(self) -> None:
        """Raise, or hang in, what a check has the bus do now; usually do nothing."""
        fault = self._fault
        if fault is not None:
            self._met = True
            fault()

    def watch(
        self, bus: Any, *methods: str, values: Callable[..., Values] | None = None, can_fail: bool = True
    ) -> None:
        """Record each call of these methods of ``bus``.

        Args:
            bus: the object that writes.
            methods: names of its methods.
            values: called with a call's arguments; returns the positions that it commands, by joint.
            can_fail: as of :meth:`wrote`.

        Raises:
            ValidationError: it has no such method.
        """
        for name in methods:
            method = getattr(bus, name, None)
            if not callable(method):
                raise ValidationError(f"methods must be methods of {shown(bus)}, not {shown(name)}.")
            setattr(bus, name, self._recorded(name, method, values, can_fail=can_fail))

    def _recorded(
        self, name: str, method: Callable[..., Any], values_of: Callable[..., Values] | None, *, can_fail: bool
    ) -> Callable[..., Any]:
        @wraps(method)
        def call(*values: Any, **named: Any) -> Any:
            commanded = None if values_of is None else values_of(*values, **named)
            self.wrote(name, commanded, can_fail=can_fail)
            return method(*values, **named)

        return call

    @property
    def count(self) -> int:
        """Writes so far."""
        return len(self._writes)

    def since(self, count: int) -> list[BusWrite]:
        """Return the writes after the first ``count``."""
        return self._writes[count:]

    @property
    def fault_met(self) -> bool:
        """False until something on the bus has met the last fault.

        True where a fault does not go through :meth:`fail`: a bus that is really cut is met by whatever asks it.
        """
        return self._met

    @contextmanager
    def raising(self, problem: Exception) -> Iterator[None]:
        """Have each write raise, as when a cable is pulled."""

        def fault() -> None:
            raise problem

        with self._faulty(fault):
            yield

    @contextmanager
    def hanging(self) -> Iterator[None]:
        """Have each write hang until the block ends, as on a dead port."""
        over = threading.Event()

        def fault() -> None:
            over.wait()

        with self._faulty(fault):
            try:
                yield
            finally:
                over.set()

    @contextmanager
    def _faulty(self, fault: Callable[[], None]) -> Iterator[None]:
        self._met = False
        self._fault = fault
        try:
            yield
        finally:
            self._fault = None


@dataclass(frozen=True, slots=True)
class LongMotion:
    """A motion that goes on for some 30 s unless it is stopped.

    ``verb`` is its name on the wire.
    """

    verb: str
    arguments: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Subject:
    """A robot whose promises are checked.

    Args:
        make: makes the robot on its emulated bus, connected and standing still. It may be called again, once the
            last robot was let go of by its ``cleanup()``.
        recorder: of that bus; without one it is not proven that a stop is followed by no write.
        moving: returns True while the emulated motor moves. A motor that is told a speed or a torque goes on without a
            write, so for those it is needed: it must be False after every verdict that says stopped.
        motion: for the checks that stop it; by default a task of the policy ``mock``, or the first motion that the
            robot declares.
        exempt: reasons by check, for promises that this robot does not make.

    Raises:
        ValidationError: an argument outside its domain.
    """

    make: Callable[[], Any]
    recorder: BusRecorder | None = None
    motion: LongMotion | None = None
    exempt: Mapping[str, str] = field(default_factory=dict)
    name: str = ""
    """Of the report; that of the robot's class by default."""

    moving: Callable[[], bool] | None = None
    deadline_s: float = 2.0
    """Seconds in which a halt has to answer; a real robot's is ``STRANDS_HALT_DEADLINE_S``."""

    answer_s: float = 10.0
    """Seconds in which a read, a refusal or the start of a motion has to be answered."""

    watch_s: float = 0.25
    """Seconds after a verdict in which no write may follow; several periods of its control loop."""

    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Lowest and highest position by joint, for what its features do not state."""

    speeds: Mapping[str, float] = field(default_factory=dict)
    """Greatest speed by joint, in its unit a second."""

    def __post_init__(self) -> None:
        if not callable(self.make):
            raise ValidationError(f"make must be a callable that makes the robot, not {shown(self.make)}.")
        text("name", self.name, longest=100, empty=True)
        if self.moving is not None and not callable(self.moving):
            raise ValidationError(f"moving must be a callable, not {shown(self.moving)}.")
        number("deadline_s", self.deadline_s, low=0.1, high=60)
        number("answer_s", self.answer_s, low=0.1, high=60)
        number("watch_s", self.watch_s, low=0.01, high=60)
        for joint, limits in self.limits.items():
            named = f"limits[{joint!r}]"
            if not isinstance(limits, tuple | list) or len(limits) != 2:
                raise ValidationError(f"{named} must be the lowest and the highest position, not {shown(limits)}.")
            number(named, limits[1], above=number(named, limits[0]))
        for joint, speed in self.speeds.items():
            number(f"speeds[{joint!r}]", speed, above=0)
        for check, reason in self.exempt.items():
            text(f"exempt[{check!r}]", reason, longest=500)
