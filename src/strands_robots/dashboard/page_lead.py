"""The page's hand as the leader of a robot, in turns with a policy.

The robot is told fifty times a second where it is wanted, and holds where nothing comes. A press takes over from the
policy; once it is let go the robot stands until the next press, or until the policy has it back.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from strands_robots.dashboard.page_robots import PageRobot
from strands_robots.envelope import Envelope, is_error
from strands_robots.errors import RefusalError
from strands_robots.fleet.far_lead import Call, FarLead
from strands_robots.fleet.picture_age import PictureAge
from strands_robots.fleet.reports import refusal_of
from strands_robots.utils import joint_name

PERIOD_S = 0.02
"""Seconds between two commands."""

BEAT_S = 0.2
"""Longest time without a beat of the page after which a push ends."""

SPEED = 0.5
"""Joint ranges a second of a push at full jog speed."""

ON_THE_WAY = 16
"""Pictures that were sent to the page and not yet shown there, of which older ones are forgotten."""


def caller(robot: PageRobot) -> Call:
    """Return how the threads of a lead call a robot."""

    def call(verb: str, arguments: Mapping[str, Any], timeout: float) -> Envelope:
        answer = robot.feed.there.call(robot.id, verb, arguments, timeout)
        if is_error(answer):
            raise refusal_of(robot.id, verb, answer)
        return answer

    return call


class ShownPictures:
    """Pictures that were sent to a page, and the age of the newest one shown.

    Args:
        now: monotonic seconds.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._waiting: deque[tuple[int, bytes, float]] = deque(maxlen=ON_THE_WAY)
        self._age = PictureAge(now)
        self._number = 0

    @property
    def age_s(self) -> float:
        """Seconds since the newest changed picture that the page has shown."""
        return self._age.age_s

    def send(self, picture: bytes, asked: float) -> int:
        """Return the number of a picture that is sent now.

        Args:
            picture: its bytes.
            asked: when it was asked for, in monotonic seconds.
        """
        self._number += 1
        self._waiting.append((self._number, picture, asked))
        return self._number

    def shown(self, number: int) -> None:
        """Note that the page shows the picture of that number."""
        while self._waiting and self._waiting[0][0] <= number:
            sent, picture, asked = self._waiting.popleft()
            if sent == number:
                self._age.came(picture, asked)


class PageLead:
    """One lead of a page's hand, on the server's event loop.

    Args:
        lead: the robot's lead.
        told: hears who drives and why, each time that changes.
        let_go: hears why a push has ended.
        ended: hears why the lead has ended by itself, and whether others stopped the robot.
        pictures: those by which the page drives; None where it drives by the robot's state alone.
    """

    def __init__(
        self,
        lead: FarLead,
        *,
        told: Callable[[str, str], None],
        let_go: Callable[[str], None],
        ended: Callable[[str, bool], None],
        pictures: ShownPictures | None = None,
    ) -> None:
        self._lead, self._told, self._let_go, self._ended = lead, told, let_go, ended
        self.pictures = pictures
        self._targets: dict[str, float] = {}
        self._push: tuple[str, float] | None = None
        self._beat = self._at = time.monotonic()
        self._before = ""
        self._task = asyncio.create_task(self._run())

    def push(self, name: str, direction: int, speed: float) -> str:
        """Push a joint, and take over first; return why it cannot, or "".

        Args:
            name: the joint, as the robot's state or its model has it.
            direction: 1 or -1.
            speed: share of full speed.
        """
        lead = self._lead
        joint = next((each for each in lead.ranges if joint_name(each) == joint_name(name)), None)
        if joint is None or not all(map(math.isfinite, lead.ranges[joint])):
            return f"{name} has no range in which it can be led."
        # Until the robot has answered to a turn, its state is that of the turn before.
        ours = lead.leads and (lead.state.turn < lead.turn or lead.state.state == "led")
        if not ours:
            self._targets = {each: at for each, at in lead.state.joints.items() if each in lead.ranges}
        if joint not in self._targets:
            return f"the robot has not told where {name} is."
        if not ours:
            lead.grip()
        self._push, self._beat = (joint, direction * speed), time.monotonic()
        return ""

    @property
    def pushes(self) -> bool:
        """True while a joint is pushed."""
        return self._push is not None

    def beat(self) -> None:
        """Note that the button is still held down."""
        self._beat = time.monotonic()

    def release(self, why: str) -> None:
        """End the push; the hand leads on, and the robot stands."""
        if self._push is not None:
            self._push = None
            self._let_go(why)

    def give_back(self) -> None:
        """Leave the robot to its policy."""
        self.release("it was given back")
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
                self.release("the lead is over")
                self._ended(refusal.why, refusal.envelope.get("halted") is True)
                # It is over at the robot: there is no answer to wait for.
                self._lead.close()
                return
            state = self._lead.state
            if state.turn >= self._lead.turn and state.state != self._before:
                self._before = state.state
                if state.state == "held":
                    # Only a new press goes on after a hold.
                    self.release(state.why)
                self._told(state.state, state.why)
            await asyncio.sleep(PERIOD_S)

    def _step(self) -> None:
        """Send the command of this moment.

        Raises:
            RefusalError: the lead is over.
        """
        now = time.monotonic()
        # A loop that was held up makes no leap of it.
        passed, self._at = min(now - self._at, 2 * PERIOD_S), now
        if now - self._beat > BEAT_S:
            self.release("no beat of the page for 200 ms")
        if self._push is not None:
            joint, speed = self._push
            low, high = self._lead.ranges[joint]
            self._targets[joint] += speed * SPEED * (high - low) * passed
        seen = self.pictures.age_s if self.pictures is not None and self._lead.leads else None
        self._lead.send(self._targets, picture_age_s=seen)
