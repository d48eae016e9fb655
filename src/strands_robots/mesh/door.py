"""How one mesh peer reaches the safety plane of its process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from strands_robots.envelope import is_error
from strands_robots.safety.decision import Decision
from strands_robots.safety.gate import MotionGate
from strands_robots.safety.orders import StopOrder
from strands_robots.safety.plane import Registered, SafetyPlane, Stoppable, plane
from strands_robots.safety.resume import REJECTED
from strands_robots.safety.stopping import StopVerdict

Verdict = Callable[[], StopVerdict | None]

REPORT_S = 2.0
"""Seconds besides the halt deadline in which the plane reports, its lockout file included."""


class SafetyDoor(Protocol):
    """What the mesh needs of the safety plane, for the robot of one peer."""

    def open(self) -> None:
        """Put this peer's robot on the plane; twice is once.

        Raises:
            ValidationError: another robot of this process has this name.
        """

    def epochs(self) -> tuple[str, ...]:
        """The epochs held, oldest first; empty while the robot may move."""

    def counts(self, source: str) -> str | None:
        """Why an e-stop of ``source`` does not count, or None."""

    def begin(self, order: StopOrder) -> Verdict | None:
        """Lock under the order's epoch, set the halt going and return at once; None when the epoch was seen before.

        What is returned waits for the robot's verdict, within the halt deadline; None when there is none.
        """

    def resume(self, assertion: object) -> str | None:
        """Clear one epoch, when the assertion is an operator's and for this robot; else the one rejection."""

    def close(self) -> None:
        """Take this peer's robot off the plane; twice is once."""


class Nothing:
    """The robot of a peer that has none, such as an operator's console: it stands still."""

    tool_name_str = "none"

    def __init__(self) -> None:
        self.gate = MotionGate()

    def halt(self, reason: str = "") -> StopVerdict:
        return StopVerdict()


class PlaneDoor:
    """The door to :mod:`strands_robots.safety.plane`.

    Args:
        robot: None for a peer without one.
        key: under which its lockout survives a restart; None for one that is not kept.
        own: another plane than the process's; for tests with several peers in one process.
    """

    def __init__(
        self, peer_id: str, robot: Stoppable | None, key: str | None = None, own: SafetyPlane | None = None
    ) -> None:
        self._plane = own or plane()
        self._peer_id = peer_id
        self._robot = robot or Nothing()
        self._key = key
        self._entry: Registered | None = None
        self._decision = Decision()
        self.open()

    def open(self) -> None:
        if self._entry is None:
            self._entry = self._plane.register(self._peer_id, self._robot, key=self._key)

    def epochs(self) -> tuple[str, ...]:
        return self._entry.epochs if self._entry is not None else ()

    def counts(self, source: str) -> str | None:
        return self._decision.source_refusal(source)

    def begin(self, order: StopOrder) -> Verdict | None:
        run, entry = self._plane.begin(order), self._entry
        if run is None:
            return None

        def verdict() -> StopVerdict | None:
            run.wait(run.deadline_s + REPORT_S)
            report = entry.reports.get(order.epoch) if entry is not None else None
            return report.verdict if report is not None else None

        return verdict

    def resume(self, assertion: object) -> str | None:
        entry = self._entry
        return REJECTED if entry is None or is_error(entry.resume(assertion, "mesh")) else None

    def close(self) -> None:
        entry, self._entry = self._entry, None
        if entry is not None:
            entry.close()
