"""A robot of another process that is led from here, command by command."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Self

from strands_robots.envelope import Envelope
from strands_robots.errors import BusyError, NoAnswerError, NoSuchRobotError, RefusalError, UnreachableError
from strands_robots.policies.base import plain_numbers
from strands_robots.policies.handover import LOST_S
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

Call = Callable[[str, Mapping[str, Any], float], Envelope]
"""Calls a verb of the robot with arguments within a time; raises :class:`RefusalError`."""

SENDERS_MAX = 16
"""Commands on their way at once: at 50 Hz a link of 150 ms each way has fifteen."""

ANSWER_S = 1.0
"""Seconds in which a command has to be answered; nothing waits for it."""

RECENT_S = 0.05
"""Seconds in which a command is still the leader's place: a new turn begins with it at once."""

END_S = 2.0
"""Seconds in which the end of the lead has to be answered."""

TRANSIENT = (NoAnswerError, UnreachableError, NoSuchRobotError, BusyError)
"""Failures of one command, after which the next one may come through."""


@dataclass(frozen=True)
class LeadState:
    """The robot's last answer.

    Attributes:
        state: ``led``, ``policy``, ``held`` or ``over``.
        why: reason of a hold or the end; empty while somebody drives.
        turn: number of the turn that the robot is in.
        joints: what its control loop read last.
        written: what its control loop wrote last.
        one_way_ms: the link's shortest way, as the robot measures it.
        dropped: commands that were too old, or came out of order.
    """

    state: str
    why: str = ""
    turn: int = 0
    joints: Mapping[str, float] = field(default_factory=dict)
    written: Mapping[str, float] = field(default_factory=dict)
    one_way_ms: float = 0.0
    dropped: int = 0


@dataclass(frozen=True)
class _Sent:
    """Last action of the leader."""

    action: Mapping[str, float]
    made: float
    picture_age_s: float | None


class FarLead:
    """The lead of a robot, as its leader has it; made by :meth:`RemoteRobot.lead`.

    The caller sends a command at each beat of its own, also while a policy has its turn: the robot holds where none
    comes. A command never waits for the answer to the one before; where the link is behind, the newest goes.

    Args:
        robot: its id, for the log.
        call: calls the robot.
        opened: the robot's answer to ``lead``.
        policy: True where a policy has the first turn.
        now: monotonic seconds.
    """

    def __init__(
        self, robot: str, call: Call, opened: Envelope, *, policy: bool, now: Callable[[], float] = time.monotonic
    ) -> None:
        self.robot = robot
        self.leader = str(opened.get("leader", ""))
        self.ranges: dict[str, tuple[float, float]] = _ranges(opened.get("ranges"))
        """Lowest and highest target by joint, in the robot's units."""
        self.unanswered = 0
        """Commands that nobody has answered."""
        self._call, self._now = call, now
        self._lead_id = str(opened["lead_id"])
        self._changed = threading.Condition()
        self._waiting: dict[str, Any] | None = None
        self._newest: _Sent | None = None
        self._idle = self._senders = 0
        self._seq = 0
        self._turn, self._leads = (0, False) if policy else (1, True)
        self._over = False
        self._refusal: RefusalError | None = None
        self._state = LeadState("held")
        self._told, self._told_at = 0.0, now()
        self._take(opened, 0)

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints that can be led."""
        return tuple(self.ranges)

    @property
    def state(self) -> LeadState:
        """The robot's last answer."""
        return self._state

    @property
    def leads(self) -> bool:
        """True where the leader drives in its present turn."""
        return self._leads

    @property
    def turn(self) -> int:
        """Number of the turn that the next command belongs to."""
        return self._turn

    def grip(self) -> None:
        """Take over, from the policy or after a hold.

        From a policy at once where a command was sent just now, else with the next one.
        """
        self._begin(leads=True)

    def give_back(self) -> None:
        """Leave the robot to its policy, as :meth:`grip` takes over; else it holds."""
        self._begin(leads=False)

    def send(self, action: Mapping[str, float], *, picture_age_s: float | None = None) -> dict[str, float]:
        """Send a command, and return the action that the robot wrote last, as it told.

        Args:
            action: targets by joint, in the robot's units.
            picture_age_s: age of the newest picture that the operator sees; None where it drives without.

        Raises:
            RefusalError: the lead is over; the message says why.
        """
        made = self._now()
        with self._changed:
            if self._refusal is None and made - self._told_at > LOST_S:
                why = f"it has answered no command for {LOST_S:g} s"
                self._refusal = NoAnswerError(why, robot=self.robot, verb="leadTo")
            if self._refusal is not None:
                raise self._refusal
            self._newest = _Sent(dict(action), made, picture_age_s)
            self._post(self._newest)
        return dict(self._state.written)

    def close(self) -> None:
        """End the lead; the robot holds, at the latest when it misses the commands."""
        with self._changed:
            if self._over:
                return
            self._over, self._waiting = True, None
            ended, self._seq = self._refusal is not None, self._seq + 1
            self._changed.notify_all()
        if ended:
            return
        try:
            self._call("leadTo", {"lead_id": self._lead_id, "seq": self._seq, "end": True}, END_S)
        except RefusalError as exc:
            logger.info("%s: the end of the lead was not confirmed: %s", self.robot, exc)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _begin(self, *, leads: bool) -> None:
        with self._changed:
            self._turn, self._leads = max(self._turn, self._state.turn) + 1, leads
            newest = self._newest
            if newest is None or self._refusal is not None or self._over or self._now() - newest.made > RECENT_S:
                return
            if self._state.state == "held":
                # What was sent before may be what it holds for.
                return
            # The turn does not wait for the caller's next beat.
            self._post(newest)

    def _post(self, sent: _Sent) -> None:
        """Hand a command to a sender; called with the lock held."""
        self._seq += 1
        command = {
            "lead_id": self._lead_id,
            "seq": self._seq,
            "turn": self._turn,
            "leads": self._leads,
            "targets": dict(sent.action),
            "made": sent.made,
            "told": self._told,
            "told_ago": max(sent.made - self._told_at, 0.0),
        }
        if sent.picture_age_s is not None:
            command["picture_age_ms"] = 1000 * sent.picture_age_s
        self._waiting = command
        if self._idle:
            self._changed.notify()
        elif self._senders < SENDERS_MAX:
            self._senders += 1
            name = f"lead {self.robot} {self._senders}"
            threading.Thread(target=self._run, name=name, daemon=True).start()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._idle += 1
                while self._waiting is None and not self._over:
                    self._changed.wait()
                self._idle -= 1
                command, self._waiting = self._waiting, None
            if command is None:
                return
            try:
                answer = self._call("leadTo", command, ANSWER_S)
            except TRANSIENT:
                self.unanswered += 1
            except RefusalError as exc:
                self._end(exc)
            except Exception as exc:
                logger.exception("%s: a command could not be sent.", self.robot)
                self._end(RefusalError(f"it could not be sent: {exc}", robot=self.robot, verb="leadTo"))
            else:
                self._take(answer, command["seq"])

    def _end(self, refusal: RefusalError) -> None:
        with self._changed:
            self._refusal = self._refusal or refusal
            self._state = LeadState("over", str(refusal), self._turn, self._state.joints, self._state.written)

    def _take(self, answer: Envelope, seq: int) -> None:
        """Note an answer, unless a later command has been answered."""
        now = self._now()
        with self._changed:
            told = plain_numbers({"now": answer.get("now")}).get("now")
            if told is None or (seq and told <= self._told) or self._refusal is not None:
                return
            self._told, self._told_at = told, now
            facts = plain_numbers(answer)
            self._state = LeadState(
                str(answer.get("state", "")),
                str(answer.get("why", "")),
                int(facts.get("turn", 0)),
                plain_numbers(answer.get("joints")),
                plain_numbers(answer.get("written")),
                facts.get("one_way_ms", 0.0),
                int(facts.get("dropped", 0)),
            )


def _ranges(stated: object) -> dict[str, tuple[float, float]]:
    """Return the ranges that a robot states, without those that are none."""
    given = stated if isinstance(stated, Mapping) else {}
    pairs = {str(joint): pair for joint, pair in given.items() if isinstance(pair, list | tuple) and len(pair) == 2}
    bounds = {joint: plain_numbers({"low": pair[0], "high": pair[1]}) for joint, pair in pairs.items()}
    return {joint: (each.get("low", -math.inf), each.get("high", math.inf)) for joint, each in bounds.items()}
