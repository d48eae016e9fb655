"""Robot of one peer of the mesh on the safety plane."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any

from strands_robots.envelope import is_error
from strands_robots.safety.checkin import CheckInRules
from strands_robots.safety.gate import MotionGate
from strands_robots.safety.identity import SigningIdentity, robot_identity
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.orders import StopOrder, StopRules
from strands_robots.safety.plane import Registered, SafetyPlane, plane
from strands_robots.safety.resume import REJECTED
from strands_robots.safety.scope import Scope
from strands_robots.safety.sightings import DuplicateDeviceError, sightings
from strands_robots.safety.statements import LockoutAnnouncer, with_lockout_statement, with_resume_statement
from strands_robots.safety.stop_targets import Stoppable
from strands_robots.safety.stopping import StopVerdict
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError

logger = stop_logger(__name__)

REPORT_S = 2.0
"""Seconds besides the halt deadline in which the plane reports, its lockout file included."""

VerdictWaiter = Callable[[], StopVerdict | None]


_idle: dict[tuple[SafetyPlane, str], set[SafetyAdapter]] = {}
"""Adapters on a plane whose peer is not on the mesh, by its id."""

_idle_lock = threading.Lock()


class NoRobot:
    """Stand-in for a peer without a robot, such as a console: it never moves."""

    tool_name_str = "none"

    def __init__(self) -> None:
        self.gate = MotionGate()

    def halt(self, reason: str = "") -> StopVerdict:
        return StopVerdict()


class SafetyAdapter:
    """The robot of one peer on the safety plane.

    Args:
        robot: None for a peer without one.
        key: under which its lockout survives a restart; None for one that is not stored.
        own: another plane than the process's; for tests with several peers in one process.
        cell: the cell that the robot is in; empty for none.
    """

    def __init__(
        self,
        peer_id: str,
        robot: Stoppable | None,
        key: str | None = None,
        own: SafetyPlane | None = None,
        cell: str = "",
    ) -> None:
        self._plane = own or plane()
        self._peer_id = peer_id
        self._robot = robot or NoRobot()
        self.identity = None if robot is None else robot_identity(peer_id)
        self._announcer = LockoutAnnouncer(self.identity)
        self._key, self._cell = key, cell
        self._entry: Registered | None = None
        self._network: NetworkKey | None = None
        self.was_here_s: float | None = None
        """Seconds since this robot was last served from this machine; None where over ten minutes, or never."""
        self._rules = StopRules()
        self._check_ins = CheckInRules(self._rules if self._rules.required else StopRules(keys=()))
        if robot is not None:
            self._rules.require_keys()
        self.open()

    @property
    def plane(self) -> SafetyPlane:
        """The plane that the robot is on."""
        return self._plane

    @property
    def rules(self) -> StopRules:
        """The rules by which an e-stop counts."""
        return self._rules

    @property
    def has_robot(self) -> bool:
        """True for a peer with a robot."""
        return not isinstance(self._robot, NoRobot)

    def own_identity(self) -> SigningIdentity | None:
        """Return what signs for this peer."""
        return self.identity

    def open(self, *, joins: bool = False) -> None:
        """Register this peer's robot; twice is once.

        Args:
            joins: it keeps its name from now on, until :meth:`leave`.

        Raises:
            ValidationError: another robot of this process has this name.
        """
        at = self._plane, self._peer_id
        with _idle_lock:
            if self._entry is None:
                try:
                    self._entry = self._registered()
                except ValidationError:
                    others = _idle.get(at, set())
                    if not others or any(each.epochs() for each in others):
                        raise
                    for each in [*others]:
                        each._close()
                        logger.warning(
                            "%s is another robot from now on: no emergency stop halts the one of this id that never "
                            "joined, until it joins by an id of its own.",
                            self._peer_id,
                        )
                    self._entry = self._registered()
            if joins:
                self._no_longer_idle()

    def idle(self) -> None:
        """Let another robot have the name, unless this one is locked, until it joins."""
        with _idle_lock:
            if self._entry is not None:
                _idle.setdefault((self._plane, self._peer_id), set()).add(self)

    def _registered(self) -> Registered:
        return self._plane.register(self._peer_id, self._robot, key=self._key, cell=self._cell)

    def _no_longer_idle(self) -> None:
        others = _idle.get((self._plane, self._peer_id), set())
        others.discard(self)
        if not others:
            _idle.pop((self._plane, self._peer_id), None)

    def epochs(self) -> tuple[str, ...]:
        """The epochs that lock this robot, oldest first; empty while it may move."""
        return self._entry.epochs if self._entry is not None else ()

    def facts(self) -> dict[str, Any]:
        """Return ``locked`` and ``epochs``; nothing without a robot."""
        if not self.has_robot:
            return {}
        epochs = self.epochs()
        return {"locked": bool(epochs), "epochs": list(epochs)}

    def announced(self, peer_id: str = "") -> dict[str, Any]:
        """Return :meth:`facts`, signed, and the cell; of a robot of its world by its id."""
        facts = self.facts()
        if not facts:
            return {}
        wants = {"signed_stops": True} if self._rules.required else {}
        return {**self._announcer.of(peer_id or self._peer_id, facts), "cell": self._cell, **wants}

    def leave_if_served_elsewhere(self, network: NetworkKey) -> None:
        """Leave the plane where another process of this machine serves the robot.

        That one keeps the lockout and takes the operator's orders.

        Raises:
            DuplicateDeviceError: it does.
        """
        if self.has_robot:
            with self._left_where_taken():
                self.was_here_s = sightings().was_here(network, self._peer_id)

    @contextmanager
    def _left_where_taken(self) -> Iterator[None]:
        try:
            yield
        except DuplicateDeviceError:
            self.close()
            raise

    def serve(self, network: NetworkKey) -> None:
        """Have this machine remember that the robot is served, until :meth:`leave`.

        Raises:
            DuplicateDeviceError: another process of this machine began to serve it just before.
        """
        if self.has_robot:
            self._network, public = network, None if self.identity is None else self.identity.public
            wants = self._rules.required
            with self._left_where_taken():
                sightings().serve(network, self._peer_id, cell=self._cell, signed_only=wants, public=public)

    def leave(self) -> None:
        """Have this machine remember that the robot left in good order."""
        network, self._network = self._network, None
        if network is not None:
            sightings().leave(network, self._peer_id)
        self.idle()

    def lockouts(self) -> list[dict[str, Any]]:
        """Return each lockout with its source, reason and time."""
        return [each.fields() for each in self._entry.latch.state.all] if self._entry is not None else []

    def report(self, peer_id: str = "", nonce: str = "") -> dict[str, Any]:
        """Return lockouts and check-in; of a robot of its world by its id."""
        check_in = self._plane.checkin.fields(time.monotonic())
        stated = {**self.facts(), "cell": self._cell}
        facts = with_lockout_statement(self.identity, peer_id or self._peer_id, stated, nonce)
        return {**facts, "lockout": self.lockouts(), "check_in": check_in}

    def within(self, scope: Scope) -> bool:
        """Return True when a stop of this scope is for this robot."""
        return scope.covers(self._peer_id, {self._cell} if self._cell else ())

    @property
    def open_to_all(self) -> bool:
        """True when an e-stop of any name counts."""
        return self._rules.open and not self._rules.required

    @property
    def needs_check_in(self) -> bool:
        """True when this process's robots need a live controller."""
        return self._plane.checkin.on

    def check_in(self, source: str, body: Mapping[str, Any]) -> str | None:
        """Record a controller's check-in, or return the reason why it does not count."""
        why = self._check_ins.refusal(source, body)
        if why is None:
            self._plane.checkin.record(source, time.monotonic())
        return why

    def halt(self, reason: str) -> None:
        """Void every motion of this robot and halt it; return at once."""
        self._robot.gate.revoke()

        def halted(verdict: Future[StopVerdict]) -> None:
            if verdict.result().stopped is not True:
                logger.critical("%s DID NOT STOP: %s", self._peer_id, verdict.result().envelope().get("reason"))

        self._plane.executor.submit(self._robot, self._peer_id, reason).add_done_callback(halted)

    def begin(self, order: StopOrder) -> VerdictWaiter | None:
        """Lock under the order's epoch and start the halt; None for a known epoch.

        The callable that is returned waits for the robot's verdict, at most the halt deadline and the time that the
        plane takes to report; it returns None when there is none by then.
        """
        run, entry = self._plane.begin(order), self._entry
        if run is None:
            return None

        def verdict() -> StopVerdict | None:
            run.wait(run.deadline_s + REPORT_S)
            report = entry.reports.get(order.epoch) if entry is not None else None
            return report.verdict if report is not None else None

        return verdict

    def resume(self, assertion: object) -> str | None:
        """Clear the epoch of an operator's assertion, or return the rejection."""
        entry = self._entry
        return REJECTED if entry is None or is_error(entry.resume(assertion, "mesh")) else None

    def answer_to_resume(self, assertion: object, peer_id: str = "") -> dict[str, Any]:
        """Check an assertion and return the signed answer.

        Args:
            peer_id: the robot of its world that was asked, if one was.
        """
        rejected = self.resume(assertion)
        result = {"status": "ok"} if rejected is None else {"status": "error", "error": rejected}
        facts = {"device_id": peer_id or self._peer_id, **self.facts()}
        return with_resume_statement(self.identity, peer_id or self._peer_id, assertion, result, facts)

    def close(self) -> None:
        """Take this peer's robot off the plane; twice is once."""
        with _idle_lock:
            self._close()

    def _close(self) -> None:
        self._no_longer_idle()
        entry, self._entry = self._entry, None
        if entry is not None:
            entry.close()
