"""Verbs that a robot can carry out now, and those that it declares itself.

A robot advertises only what it can do.
"""

from __future__ import annotations

import copy
import json
import logging
import time
from collections.abc import Mapping
from typing import Any

from strands_robots.adapted import lacks, no_tasks, stops_motions
from strands_robots.contract import body_of, holds_robots
from strands_robots.envelope import Envelope, error, fields_of, is_error, jsonable, success, text_of, uncarried
from strands_robots.safety.gate import MotionRequest
from strands_robots.serving.advertised import VERBS, RobotDescription
from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS
from strands_robots.serving.verbs import LEASE_NAMES, POLICY_PROVIDER, Arguments, Kind, Verb, described
from strands_robots.utils import ValidationError
from strands_robots.verb_declaration import DeclaredVerb, declared_verbs

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
    return no_tasks(lacks(robot), name)


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
    if verb.method in lacks(robot):
        return False
    if verb.suits is not None:
        try:
            return verb.suits(robot)
        except Exception as exc:  # noqa: BLE001 - a foreign robot may raise anything; a call tells the reason
            logger.debug("Whether %s suits %r is not known: %s", verb.name, robot, exc)
            return True
    return not verb.method or any(callable(getattr(each, verb.method, None)) for each in (robot, body_of(robot)))


VERBS_MAX = 100
"""Own verbs of one robot."""

DESCRIPTION_MAX_BYTES = 32 * 1024
"""Size of the description of a robot's own verbs, in JSON: with the others of any robot it is within what is read."""

UNPROVEN = (
    "A stop waits until it has returned. That none of its own writes follows is its author's word: it is not proven."
)
"""Note on each motion, whose writes do not pass a body of ours."""

STOPS = frozenset({"stop", "halt", "estop", "emergencyStop", "stopMotion", "stopTask", "stopPolicy", "stopTeleoperate"})
"""Names that a caller would take for a stop, which no verb of a robot's own may be."""

MEMBERS = frozenset(
    {
        *("call", "verbs", "status", "state", "features", "events", "picture", "control", "lead", "id", "type"),
        *(
            "model",
            "network",
            "address",
            "robots",
            "rediscovered",
            "describe",
            "hasStop",
            "hasLockout",
            "hasLease",
            "leftOut",
        ),
        *("close", "tags", "where", "invoke"),
        *("functions", "identity", "labels", "capabilities", "connect", "disconnect", "requestRegistration"),
    }
)
"""Names of what every robot has on the calling side or as a device."""


TRAVELLING = LEASE_NAMES | {
    *("robot_name", "action", "timeout"),
    *("source_device", "function_name", "traceparent", "tracestate", "baggage"),
}
"""Names of what goes with a call besides its arguments, which no parameter of an own verb may have."""


_OURS = frozenset(each.lower() for each in VERBS | MEMBERS)
"""Names of the verbs that robots of ours have, and of members, in lower case."""


def own_verbs(robot: object) -> dict[str, Verb]:
    """Return the verbs that a robot declares, by name.

    Raises:
        ValidationError: naming the verb that cannot be served, and why.
    """
    body = body_of(robot)
    declared = declared_verbs(body)
    if len(declared) > VERBS_MAX:
        raise ValidationError(f"{type(body).__name__} declares {len(declared)} verbs; a robot may have {VERBS_MAX}.")
    verbs = {name: _served(body, each) for name, each in declared.items()}
    functions = [described(each) for each in verbs.values()]
    left_out = RobotDescription.of(functions).left_out
    if left_out:
        raise ValidationError(f"Callers of {type(body).__name__} would not see {'; '.join(left_out)}.")
    size = len(json.dumps(functions))
    if size > DESCRIPTION_MAX_BYTES:
        raise ValidationError(
            f"The descriptions of the verbs of {type(body).__name__} have {size} bytes of JSON; they may have "
            f"{DESCRIPTION_MAX_BYTES}. Shorten their docstrings."
        )
    return verbs


def _served(body: object, declared: DeclaredVerb) -> Verb:
    declared.check()
    name, method = declared.name, declared.method
    lower = name.lower()
    if lower in {each.lower() for each in STOPS}:
        raise ValidationError(f"{method} cannot be the verb {name}: a robot's own verb is never a stop. Rename it.")
    if lower in _OURS:
        raise ValidationError(
            f"{method} cannot be the verb {name}, which other robots have in another sense. Rename it."
        )
    taken = next((each.name for each in declared.parameters if each.name in TRAVELLING), "")
    if taken:
        raise ValidationError(
            f"{method} cannot have the parameter {taken}, which goes with a call in another sense. Rename it."
        )
    if declared.motion and not declared.permit and not stops_motions(body):
        raise ValidationError(
            f"{method} is a motion that no stop would end: give {type(body).__name__} a halt() or stop_task(), or let "
            "the method take a Permit and return when it is void. A method that moves nothing is declared by "
            "@verb(motion=False)."
        )

    def begin(robot: Any, arguments: Arguments, request: MotionRequest | None) -> Envelope:
        # A default that the method changes is none for the next call.
        given = {each: copy.deepcopy(value) for each, value in arguments.items()}
        return answer_of(name, *declared.carry_out(body_of(robot), given, request))

    return Verb(
        name,
        Kind.MOTION if declared.motion else Kind.CHANGE if declared.changes else Kind.READ,
        declared.summary,
        declared.parameters,
        returns=declared.returns,
        begin=begin,
        critical=declared.motion,
        lasts=declared.lasts > 0,
        # It may move any robot of a world, so a lease on one of them refuses it.
        of_world=holds_robots(body),
        note=UNPROVEN if declared.motion else "",
        own=True,
        lasts_s=declared.lasts,
    )


def answer_of(verb: str, result: object, ended: str = "", why: str = "") -> Envelope:
    """Return what a robot's own verb returned as an envelope that JSON can carry.

    An envelope stays one. The items of another mapping are its fields, any other value is the field ``result``. A
    motion that did not come to its end is an error, as one of ours is, with what it returned.

    Args:
        verb: its name.
        result: as the method returned it.
        ended: ``task_status`` of a motion; empty for a read.
        why: the reason why a motion did not come to its end; empty where it did.
    """
    status = {"task_status": ended} if ended else {}
    said = f"{verb} {ended or 'answered'}{': ' if why else ''}{why}."
    unfit = uncarried(result)
    if unfit:
        return error(f"{said} It returned what JSON cannot carry: {unfit}.", **status)
    plain = jsonable(result)
    if why and not is_error(plain):
        given = plain if isinstance(plain, dict) else {} if plain is None else {"result": plain}
        facts = {key: each for key, each in fields_of(given).items() if key not in (*_OF_ENVELOPE, "reason")}
        return error(f"{said} {text_of(given)}".rstrip(), **{"why": why, **facts, **status})
    if not isinstance(plain, Mapping):
        return success(said, **status, **({} if plain is None else {"result": plain}))
    if plain.get("status") in ("success", "error"):
        return {"content": [{"text": str(plain.get("reason", said))}], **status, **plain}
    return success(said, **{**status, **{key: each for key, each in plain.items() if key not in _OF_ENVELOPE}})


_OF_ENVELOPE = frozenset({"content", "status"})
