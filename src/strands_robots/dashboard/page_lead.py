"""The page's hand as the leader of a robot, in turns with a policy.

The robot is told fifty times a second where it is wanted, and holds where nothing comes. A press takes over from the
policy; once it is let go the robot stands until the next press, or until the policy has it back.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from strands_robots.dashboard.page_robots import PageRobot
from strands_robots.dashboard.pictures import TimedPicture
from strands_robots.envelope import Envelope, is_error
from strands_robots.errors import RefusalError
from strands_robots.fleet.far_lead import Call, FarLead
from strands_robots.fleet.picture_age import PictureAge
from strands_robots.fleet.reports import refusal_of
from strands_robots.utils import joint_name, plain_text

logger = logging.getLogger(__name__)

PERIOD_S = 0.02
"""Seconds between two commands."""

BEAT_S = 0.2
"""Longest time without a beat of the page after which a push ends."""

ALIVE_S = 1.0
"""Longest time without a sign of the page after which the robot is stopped, whoever drives."""

STATES = ("policy", "led", "held")
WHY_MAX = 300

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
        self._now = now
        self._waiting: deque[tuple[int, TimedPicture]] = deque(maxlen=ON_THE_WAY)
        self._known = PictureAge(now)
        self._number = 0
        self._taken = now()

    @property
    def age_s(self) -> float:
        """Seconds since the newest changed picture that the page has shown was taken."""
        return max(self._now() - self._taken, 0.0)

    def send(self, picture: TimedPicture) -> int:
        """Return the number of a picture that is sent now."""
        self._number += 1
        self._waiting.append((self._number, picture))
        return self._number

    def shown(self, number: int) -> None:
        """Note that the page shows the picture of that number."""
        while self._waiting and self._waiting[0][0] <= number:
            sent, picture = self._waiting.popleft()
            if sent == number and self._known.came(picture.jpeg):
                self._taken = max(self._taken, picture.taken)


class Teller(Protocol):
    """Hears of a lead."""

    def turned(self, state: str, why: str) -> None:
        """Note who drives, and why, each time that changes."""

    def let_go(self, why: str) -> None:
        """Note why a push has ended."""

    def over(self, why: str, *, halted: bool) -> None:
        """Note why the robot has ended the lead, and whether others stopped it."""

    def lost(self, why: str) -> None:
        """Stop the robot, and end the lead, as nobody leads it."""


class PageLead:
    """One lead of a page's hand, on the server's event loop.

    Args:
        lead: the robot's lead.
        teller: hears of it.
        pictures: those by which the page drives; None where it drives by the robot's state alone.
    """

    def __init__(self, lead: FarLead, teller: Teller, pictures: ShownPictures | None = None) -> None:
        self._lead, self._teller = lead, teller
        self.pictures = pictures
        self._targets: dict[str, float] = {}
        self._push: tuple[str, float] | None = None
        self._alive = self._beat = self._at = time.monotonic()
        self._before = ""
        self._task = asyncio.create_task(self._run())

    def push(self, name: str, direction: int, speed: float) -> str:
        """Push a joint, and take over first; return why it cannot, or "".

        Args:
            name: the joint, as the robot's state or its model has it.
            direction: 1 or -1.
            speed: share of full speed.
        """
        ranges = self._lead.ranges
        joint = next((each for each in ranges if joint_name(each) == joint_name(name)), None)
        if joint is None or not all(map(math.isfinite, ranges[joint])):
            return f"{name} has no range in which it can be led."
        if joint not in self._lead.state.joints:
            return f"the robot has not told where {name} is."
        if not self._leads:
            try:
                self._grip()
            except RefusalError as refusal:
                return refusal.why
        self._targets.setdefault(joint, self._lead.state.joints[joint])
        self._push, self._beat = (joint, direction * speed), time.monotonic()
        return ""

    @property
    def pushes(self) -> bool:
        """True while a joint is pushed."""
        return self._push is not None

    def beat(self) -> None:
        """Note that the button is still held down."""
        self._alive = self._beat = time.monotonic()

    def alive(self) -> None:
        """Note that somebody looks at the page."""
        self._alive = time.monotonic()

    def release(self, why: str) -> None:
        """End the push; the hand leads on, and the robot stands where it is now."""
        if self._push is None:
            return
        self._push = None
        if self._leads:
            # What the robot still had to go, because it is slower than the push or is blocked, is not gone.
            with contextlib.suppress(RefusalError):
                self._grip()
        self._teller.let_go(why)

    def give_back(self) -> None:
        """Leave the robot to its policy."""
        self.release("it was given back")
        self._lead.give_back()

    def cease(self) -> None:
        """Send no more commands, so that the robot holds; waits for nothing."""
        self._task.cancel()

    async def end(self) -> None:
        """End the lead; the robot holds."""
        self.cease()
        await asyncio.wait([self._task])
        await asyncio.to_thread(self._lead.close)

    @property
    def _leads(self) -> bool:
        """True while the hand leads."""
        lead = self._lead
        # Until the robot has answered to a turn, its state is of the one before.
        return lead.leads and (lead.state.turn < lead.turn or lead.state.state == "led")

    def _grip(self) -> None:
        """Begin a turn of the hand where the robot is; raises :class:`RefusalError`."""
        joints = self._lead.state.joints
        self._targets = {each: joints[each] for each in self._lead.ranges if each in joints}
        # A turn begins with the command before it, which had other targets.
        self._send()
        self._lead.grip()
        self._before = ""

    async def _run(self) -> None:
        try:
            while True:
                self._step()
                await asyncio.sleep(PERIOD_S)
        except RefusalError as refusal:
            # It is over at the robot: there is no answer to wait for.
            self._lead.close()
            self._push = None
            self._teller.over(refusal.why, halted=refusal.envelope.get("halted") is True)
        except Exception as exc:
            logger.exception("A lead of the page failed.")
            self._teller.lost(f"the page's server failed: {type(exc).__name__}")

    def _step(self) -> None:
        """Send the command of this moment, and tell what has changed.

        Raises:
            RefusalError: the lead is over.
        """
        now = time.monotonic()
        # A loop that was held up makes no leap of it.
        passed, self._at = min(now - self._at, 2 * PERIOD_S), now
        if now - self._alive > ALIVE_S:
            self._alive = now
            self._teller.lost(f"nothing was heard of the page for {ALIVE_S:g} s")
        if now - self._beat > BEAT_S:
            self.release("no beat of the page for 200 ms")
        if self._push is not None:
            joint, speed = self._push
            low, high = self._lead.ranges[joint]
            self._targets[joint] += speed * SPEED * (high - low) * passed
        self._send()
        state = self._lead.state
        if state.turn >= self._lead.turn and state.state != self._before and state.state in STATES:
            self._before, why = state.state, plain_text(state.why, WHY_MAX)
            if state.state == "held":
                # Only a new press goes on after a hold.
                self.release(why)
            self._teller.turned(state.state, why)

    def _send(self) -> None:
        """Send the targets; raises :class:`RefusalError` where the lead is over."""
        seen = self.pictures.age_s if self.pictures is not None and self._lead.leads else None
        self._lead.send(self._targets, picture_age_s=seen)
