"""The page's hand as the leader of a robot: it takes over from a policy, pushes joints, and gives back."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable

from strands_robots.errors import RefusalError
from strands_robots.fleet.far_lead import FarLead, LeadState

PERIOD_S = 0.02
"""Seconds between two commands."""

BEAT_S = 0.2
"""Longest time without a beat of the page after which a push ends."""

SPEED = 0.5
"""Whole joint ranges a second at full jog speed."""


class PageLead:
    """One lead of a page's hand; the robot stands still while nothing is pushed.

    Args:
        lead: the robot's lead. Its calls must not need the thread of the page's event loop while :meth:`end` waits.
        told: hears who drives and why, each time it changes.
        ended: hears why the lead ended by itself.
        now: monotonic seconds.
    """

    def __init__(
        self,
        lead: FarLead,
        *,
        told: Callable[[str, str], None],
        ended: Callable[[str], None],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._lead, self._told, self._ended, self._now = lead, told, ended, now
        self._targets: dict[str, float] = {}
        self._push: tuple[str, float] | None = None
        self._beat = self._at = now()
        self._picture: tuple[float, float] | None = None
        self._before: tuple[str, str] | None = None
        self._task = asyncio.create_task(self._run())

    @property
    def state(self) -> LeadState:
        """The robot's last answer."""
        return self._lead.state

    def push(self, joint: str, direction: int, speed: float) -> str:
        """Push a joint, and take over where the hand does not lead; return why it cannot, or ""."""
        if joint not in self._lead.ranges:
            return f"{joint} cannot be led."
        if self._lead.state.state != "led" or not self._lead.leads:
            joints = self._lead.state.joints
            self._targets = {each: joints[each] for each in self._lead.joints if each in joints}
            self._lead.grip()
        if joint not in self._targets:
            return f"The robot has not told where {joint} is."
        self._push, self._beat = (joint, direction * speed), self._now()
        return ""

    def beat(self, picture_age_s: float | None = None) -> None:
        """Note that the page is there, and how old its newest changed picture is; None where it shows none."""
        self._beat = self._now()
        self._picture = None if picture_age_s is None else (picture_age_s, self._beat)

    def release(self) -> None:
        """End the push; the hand leads on, and the robot is still."""
        self._push = None

    def give_back(self) -> None:
        """Leave the robot to its policy."""
        self._push = None
        self._lead.give_back()

    async def end(self) -> None:
        """End the lead; the robot holds."""
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task
        await asyncio.to_thread(self._lead.close)

    async def _run(self) -> None:
        while True:
            try:
                self._step()
            except RefusalError as refusal:
                self._ended(str(refusal))
                return
            now = self._lead.state
            if (now.state, now.why) != self._before:
                self._before = (now.state, now.why)
                if now.state == "held":
                    # Only a new press goes on after a hold.
                    self._push = None
                self._told(*self._before)
            await asyncio.sleep(PERIOD_S)

    def _step(self) -> None:
        now = self._now()
        passed, self._at = min(now - self._at, 2 * PERIOD_S), now
        if now - self._beat > BEAT_S:
            self._push = None
        if self._push is not None:
            joint, speed = self._push
            low, high = self._lead.ranges[joint]
            moved = self._targets[joint] + speed * SPEED * (high - low) * passed
            self._targets[joint] = min(max(moved, low), high)
        picture = None
        if self._picture is not None and self._lead.leads:
            age, heard = self._picture
            picture = age + now - heard
        self._lead.send(self._targets or self._lead.state.joints, picture_age_s=picture)
