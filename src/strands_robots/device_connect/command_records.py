"""Safety records of a device's stops and of the motions and changes it refused."""

from __future__ import annotations

import time
from typing import Any

from strands_robots.audit import queue_safety_event
from strands_robots.envelope import Envelope, RefusalReason, Refused, is_error, text_of
from strands_robots.rate_limits import EventBudget
from strands_robots.safety.authorization import ANONYMOUS, caller_name
from strands_robots.serving.pipeline import Command

EACH_PER_S, IN_ALL_PER_S = 5, 50
"""Records a second of one kind and caller, and of all; the next one states how many were left out.

Stops and refused motions count apart.
"""

REASON_MAX = 200
FAILED = "the verb failed inside the robot"


class CommandRecords:
    """Records of one device; each returns at once and never raises."""

    def __init__(self) -> None:
        # A flood of motions must not keep a stop out of the records.
        self._refusals = EventBudget(EACH_PER_S, IN_ALL_PER_S, pooled=True)
        self._stops = EventBudget(EACH_PER_S, IN_ALL_PER_S, pooled=True)

    def refused(self, peer_id: str, command: Command, refusal: Refused | None, answer: Envelope) -> None:
        """Record a motion or a change that was answered with an error."""
        if refusal is None:
            reason = text_of(answer)
        else:
            # What a robot raised may be a text of any length, and is in the log.
            reason = FAILED if refusal.why is RefusalReason.FAILED else refusal.reason
        facts = {"action": command.verb.name, "reason": reason[:REASON_MAX]}
        self._record(self._refusals, "command_refused", peer_id, command.caller, facts)

    def stopped(self, peer_id: str, caller: object, answer: Envelope) -> None:
        """Record a plain stop that was answered."""
        event = "command_refused" if is_error(answer) else "command_executed"
        why = {"reason": text_of(answer)[:REASON_MAX]} if is_error(answer) else {}
        self._record(self._stops, event, peer_id, caller, {"action": "stop", **why})

    def _record(self, budget: EventBudget, event: str, peer_id: str, caller: object, facts: dict[str, Any]) -> None:
        now, about = time.monotonic(), caller_name(caller) or ANONYMOUS
        admitted = budget.allows(f"{event} {about}", now)
        left_out = budget.count(f"{event} {about}", now)
        if admitted:
            more = {"left_out_before": left_out} if left_out else {}
            queue_safety_event(event, peer_id, {"about": about, **facts, **more})
