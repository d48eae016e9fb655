"""Verbs that a robot can carry out now: a robot advertises only what it can do."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Any

from strands_robots.contract import body_of, holds_robots
from strands_robots.serving.arm_motion_verbs import ARM_MOTION_VERBS
from strands_robots.serving.verbs import POLICY_PROVIDER, Verb

logger = logging.getLogger(__name__)

LOOK_EVERY_S = 2.0
"""Seconds between two looks at what a robot can be called for."""


def offered(robot: Any, verbs: Mapping[str, Verb]) -> dict[str, Verb]:
    """Return the verbs of a table that a robot can carry out now, by name.

    Nothing is loaded, read from a bus or waited for. A world offers what one of its robots can do. A verb that is left
    out can be called all the same, and is refused by its reason.

    Args:
        robot: a robot behind its contract.
        verbs: all verbs of its device or peer.
    """
    arm = _arm_verbs(robot)
    return {name: verb for name, verb in verbs.items() if _offers(robot, verb, arm)}


def tasks_refused(robot: Any, verb: Verb, name: str) -> str | None:
    """Return why a robot without tasks refuses a verb that starts one, else None.

    A world has its robots' tasks, and says itself which robot lacks them.
    """
    if POLICY_PROVIDER.name not in verb.by_name or holds_robots(robot) or _offers(robot, verb, None):
        return None
    return f"{name} runs no tasks; it has verbs of its own."


def unoffered(robot: Any, verb: Verb, name: str) -> str | None:
    """Return the refusal of a verb that a robot does not offer now, or None."""
    if offered(robot, {verb.name: verb}):
        return None
    generic = (
        f"{verb.name} is refused: {name} lacks what it needs, such as an arm, a model of it, a gripper or a camera."
    )
    return tasks_refused(robot, verb, name) or generic


class Offers:
    """Verbs that a robot could carry out when it was looked at last.

    Args:
        robot: behind its contract.
        verbs: all verbs of its device.
        every_s: seconds between two looks.
    """

    def __init__(self, robot: Any, verbs: Mapping[str, Verb], every_s: float = LOOK_EVERY_S) -> None:
        self._robot, self._verbs, self._every_s = robot, verbs, every_s
        self._names: frozenset[str] | None = None
        self._looked_at = 0.0

    @property
    def names(self) -> frozenset[str]:
        """Their names, without a look at the robot but for the first time."""
        if self._names is None:
            self.look()
        return self._names or frozenset()

    def look(self) -> bool:
        """Look at the robot, which may block; return True where its verbs changed."""
        before, now = self._names, time.monotonic()
        if before is None or now - self._looked_at >= self._every_s:
            self._looked_at = now
            self._names = frozenset(offered(self._robot, self._verbs))
        return before != self._names


def _arm_verbs(robot: Any) -> frozenset[str] | None:
    """Return the verbs of an arm that a robot states; None where it states none."""
    own = getattr(body_of(robot), "arm_verbs", None)
    if not callable(own):
        return None
    if not holds_robots(robot):
        return frozenset(own())
    found: frozenset[str] = frozenset()
    for name in robot.list_robots():
        found |= own(name)
        if len(found) == len(ARM_MOTION_VERBS):
            break
    return found


def _offers(robot: Any, verb: Verb, arm: frozenset[str] | None) -> bool:
    if arm is not None and verb.name in ARM_MOTION_VERBS:
        return verb.name in arm
    if verb.suits is not None:
        try:
            return verb.suits(robot)
        except Exception as exc:  # noqa: BLE001 - a foreign robot may raise anything; a call tells the reason
            logger.debug("Whether %s suits %r is not known: %s", verb.name, robot, exc)
            return True
    return not verb.method or any(callable(getattr(each, verb.method, None)) for each in (robot, body_of(robot)))
