"""Who is told when a drive or a navigation begins and ends."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from typing import Literal, Protocol

from strands_robots.contract import Observer, RolloutEvent, Unsubscribe
from strands_robots.envelope import Envelope, is_error, text_of

logger = logging.getLogger(__name__)


class Motion(Protocol):
    """What is told about: a burst of velocities, or a goal of a navigation stack."""

    policy: str
    state: str
    answer: Envelope | None
    ended: threading.Event

    @property
    def instruction(self) -> str:
        """What was ordered, in a few words."""

    @property
    def sent(self) -> int:
        """How far it has come: messages sent, or samples of feedback."""

    @property
    def elapsed_s(self) -> float:
        """Seconds since it was ordered, or that it took."""

    @property
    def velocities(self) -> Mapping[str, float]:
        """``linear`` in m/s and ``angular`` in rad/s, where those were ordered."""


class Unbegun(Motion, Protocol):
    """A motion that has leave to begin, and may get no thread to do it on."""

    def never_began(self, why: str) -> Envelope:
        """It ends here; the error to answer."""


def state_of(motion: Motion) -> str:
    """What is told of a motion: ``running`` until the base is free for the next one."""
    return motion.state if motion.ended.is_set() else "running"


class Observers:
    """The observers of one base; one that raises is logged and the others are still told."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._all: tuple[Observer, ...] = ()

    def add(self, observer: Observer) -> Unsubscribe:
        """Tell ``observer`` until the returned callable is called."""
        self._all = (*self._all, observer)

        def remove() -> None:
            self._all = tuple(each for each in self._all if each is not observer)

        return remove

    def started(self, motion: Motion) -> None:
        """A motion begins."""
        self._tell("started", motion, motion.velocities)

    def finished(self, motion: Motion) -> None:
        """A motion is over; of a drive, its zero included."""
        self._tell("finished", motion, {})

    def _tell(self, kind: Literal["started", "finished"], motion: Motion, action: Mapping[str, float]) -> None:
        if not self._all:
            return
        answer = motion.answer
        event = RolloutEvent(
            kind=kind,
            robot=self._robot,
            instruction=motion.instruction,
            policy=motion.policy,
            step=motion.sent,
            elapsed_s=motion.elapsed_s,
            state=motion.state,
            error=text_of(answer) if answer is not None and motion.state == "error" and is_error(answer) else "",
            action=action,
        )
        for observer in self._all:
            try:
                observer(event)
            except Exception:
                logger.exception("An observer of %s failed.", self._robot)
