"""How one mesh peer reaches the safety plane of its process."""

from __future__ import annotations

import logging
from typing import Protocol

from strands_robots.envelope import is_error
from strands_robots.safety.decision import Decision
from strands_robots.safety.gate import MotionGate
from strands_robots.safety.orders import StopOrder
from strands_robots.safety.plane import Registered, SafetyPlane, Stoppable, plane
from strands_robots.safety.resume import REJECTED
from strands_robots.safety.stopping import StopVerdict
from strands_robots.utils import ValidationError

logger = logging.getLogger(__name__)


class SafetyDoor(Protocol):
    """What the mesh needs of the safety plane, for the robot of one peer."""

    def epochs(self) -> tuple[str, ...]:
        """The epochs held, oldest first; empty while the robot may move."""

    def counts(self, source: str) -> str | None:
        """Why an e-stop of ``source`` does not count, or None."""

    def stop(self, order: StopOrder) -> StopVerdict | None:
        """Lock under the order's epoch and halt; waits for the verdict. None when the epoch was seen before."""

    def resume(self, assertion: object) -> str | None:
        """Clear one epoch, when the assertion is an operator's and for this robot; else the one rejection."""

    def close(self) -> None:
        """Take this peer's robot off the plane."""


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
        body = robot or Nothing()
        try:
            self._entry: Registered = self._plane.register(peer_id, body, key=key)
        except ValidationError:
            # Its other network wrapped the same foreign robot anew; both wrappers are locked by every stop.
            logger.warning("%s is in the safety plane already; the mesh's road to it is %s.mesh.", peer_id, peer_id)
            self._entry = self._plane.register(f"{peer_id}.mesh", body)
        self._decision = Decision()

    def epochs(self) -> tuple[str, ...]:
        return self._entry.epochs

    def counts(self, source: str) -> str | None:
        return self._decision.source_refusal(source)

    def stop(self, order: StopOrder) -> StopVerdict | None:
        run = self._plane.begin(order)
        if run is None:
            return None
        run.wait(run.deadline_s + 2.0)
        report = self._entry.reports.get(order.epoch)
        return report.verdict if report is not None else None

    def resume(self, assertion: object) -> str | None:
        return REJECTED if is_error(self._entry.resume(assertion, "mesh")) else None

    def close(self) -> None:
        self._entry.close()
