"""Verbs that a robot can carry out now: a robot advertises only what it can do."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from strands_robots.contract import body_of
from strands_robots.serving.arm_motion_verbs import ARM_MOTION_VERBS
from strands_robots.serving.verbs import Verb

logger = logging.getLogger(__name__)


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


def _arm_verbs(robot: Any) -> frozenset[str] | None:
    """Return the verbs of an arm that a robot states; None where it states none."""
    own = getattr(body_of(robot), "arm_verbs", None)
    if not callable(own):
        return None
    robots = getattr(robot, "list_robots", None)
    if not callable(robots):
        return frozenset(own())
    found: frozenset[str] = frozenset()
    for name in robots():
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
