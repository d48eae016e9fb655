"""A sender of emergency stops that answers as a test says."""

from __future__ import annotations

import threading
from collections.abc import Collection
from dataclasses import replace
from typing import Any

from strands_robots.safety.answers import Answer, Progress, StopReport
from strands_robots.safety.roster import Sending
from strands_robots.safety.scope import EVERY_ROBOT, Scope


class ScriptedSender:
    """Records each stop and answers when the test allows it."""

    controller_id = "safety-1"
    link_up = True
    network = None
    sending = Sending()

    def __init__(self) -> None:
        self.ids: list[str] = []
        self.check_ins: list[float] = []
        self.presses: list[str] = []
        self.expected: list[Collection[str]] = []
        self.scopes: list[Scope] = []
        self.answer = threading.Event()
        self.answer.set()
        self.links: list[bool] = []
        self.refused: dict[str, Answer] = {}
        self.silent: list[tuple[str, ...]] = []
        self.stopped: dict[str, Answer] = {}
        self.late: dict[str, Answer] = {}

    def press(self, estop_id: str) -> None:
        self.presses.append(estop_id)

    def check_in_every(self, interval_s: float) -> None:
        self.check_ins.append(interval_s)

    def stop(
        self, expected: Collection[str], reason: str, *, estop_id: str, on_progress: Any, scope: Scope = EVERY_ROBOT
    ) -> StopReport:
        self.ids.append(estop_id)
        self.expected.append(expected)
        self.scopes.append(scope)
        assert self.answer.wait(60.0)
        link = self.links.pop(0) if self.links else True
        on_progress(Progress(estop_id, self.stopped, (), link, 1.0))
        silent = self.silent.pop(0) if self.silent else ()
        return StopReport(estop_id, self.stopped, {}, self.refused, silent, link, 1.0, scope=scope)

    def review(self, report: StopReport) -> StopReport:
        return replace(report, stopped={}, not_stopped=self.late) if self.late else report
