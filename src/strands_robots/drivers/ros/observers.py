"""Who is told when a drive begins and ends."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Literal

from strands_robots.contract import Observer, RolloutEvent, Unsubscribe
from strands_robots.drivers.ros.burst import Burst
from strands_robots.envelope import is_error, text_of

logger = logging.getLogger(__name__)


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

    def started(self, burst: Burst) -> None:
        """A drive begins."""
        self._tell("started", burst, {"linear": burst.order.linear, "angular": burst.order.angular})

    def finished(self, burst: Burst) -> None:
        """A drive is over, its zero included."""
        self._tell("finished", burst, {})

    def _tell(self, kind: Literal["started", "finished"], burst: Burst, action: Mapping[str, float]) -> None:
        answer = burst.answer
        event = RolloutEvent(
            kind=kind,
            robot=self._robot,
            instruction=f"drive {burst.order.linear:g} m/s, {burst.order.angular:g} rad/s",
            policy="drive",
            step=burst.sent,
            elapsed_s=burst.elapsed_s,
            state=burst.state,
            error=text_of(answer) if answer is not None and burst.state == "error" and is_error(answer) else "",
            action=action,
        )
        for observer in self._all:
            try:
                observer(event)
            except Exception:
                logger.exception("An observer of %s failed.", self._robot)
