"""Approval of a motion of real hardware by the user of an MCP client.

The robot refuses a motion that its operator has not approved. A client that can ask its user (elicitation) is then
given the question: what will move, how far, how fast, and a picture. A yes issues a one-shot grant on this machine
for this caller and these arguments alone, and the motion is tried once more. Nothing is held while the user thinks; a
yes that the robot did not take is gone.
"""

# mypy: disable-error-code="misc"
from __future__ import annotations

import base64
import json
import logging
import math
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeGuard

from mcp.server.mcpserver import Context
from mcp.types import (
    CallToolResult,
    ElicitRequest,
    ElicitRequestFormParams,
    ElicitResult,
    ImageContent,
    InputRequiredResult,
)
from pydantic import BaseModel, Field

from strands_robots.envelope import Envelope, error, is_error
from strands_robots.errors import ApprovalError
from strands_robots.fleet.adapter import ReceivedCall
from strands_robots.fleet.reports import refusal_of
from strands_robots.mcp.caller import Caller, ClientAccess
from strands_robots.mcp.results import jpeg_of, result
from strands_robots.safety.authorization import Approval, Grants, digest
from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS
from strands_robots.state_files import StateFileError, state_dir
from strands_robots.utils import ValidationError

logger = logging.getLogger(__name__)

GRANT_S = 15.0
"""Seconds for which the grant of a yes is good: the motion is begun at once."""

ASKED_S = 300.0
"""Seconds in which a question is answered."""

ASKED_MAX = 64
FULL_SPEED = "2 rad/s a joint"
KNOWN = frozenset({"execute", "acquireControl", *ARM_MOTION_VERBS})
"""Verbs of which the question can say how far and how fast they move."""

SHOWN_MAX = 600
"""Characters of a motion's arguments that the question shows."""

KEY = "approval"
WITHOUT_PARTS = "2026-07-28"
"""The first revision in which a question is a result, and its answer comes with the call anew."""

Outcome: TypeAlias = CallToolResult | InputRequiredResult
Motion: TypeAlias = tuple[Caller, str]
"""Client and motion of a question."""


@dataclass(frozen=True)
class Wish:
    """A motion that a client asks for.

    Attributes:
        params: what the client asked for, as its user is shown it.
        sent: the arguments that the robot gets, besides the lease's: an approval is for these.
        run: carries it out.
    """

    robot: str
    verb: str
    params: Mapping[str, Any]
    sent: Mapping[str, Any]
    run: Callable[[], Awaitable[Envelope]]


class Approve(BaseModel):
    """The form that a user fills in."""

    # Strict: the texts and numbers that stand for true elsewhere are no yes.
    approve: bool = Field(strict=True, description="True lets the robot make this motion, once")


class Approvals:
    """Questions that were asked and not answered; each is good once."""

    def __init__(self, grants: Callable[[], Grants] = lambda: Grants(state_dir() / "grants")) -> None:
        self._grants = grants
        self._asked: dict[str, tuple[float, Motion | None]] = {}

    async def carry_out(self, context: Context[Any, Any], access: ClientAccess, wish: Wish) -> Outcome:
        """Carry out a motion, with the approval of the client's user if it needs one."""
        robot, verb, params = wish.robot, wish.verb, wish.params
        motion = access.caller, json.dumps([robot, verb, wish.sent], sort_keys=True, default=str)
        answered = self._answered(context, motion)
        if answered is not None:
            return result(await self._granted(access, wish) if answered else _declined(robot, verb))
        answer = await wish.run()
        refused = is_error(answer) and isinstance(refusal_of(robot, verb, answer), ApprovalError)
        if not refused or not _unapproved(answer, robot, await access.caller.received(robot, verb, wish.sent)):
            return result(answer)
        question, encoded = await _question(access, robot, verb, params)
        image = [ImageContent(type="image", data=encoded, mime_type="image/jpeg")] if encoded else []
        if not (access.approves and _can_ask(context)):
            return result({**answer, "question": question}, *image)
        shown = access.show_picture(base64.b64decode(encoded)) if encoded else ""
        message = f"{question}\nPicture: {shown or 'this robot gives none'}"
        if str(context.protocol_version or "") >= WITHOUT_PARTS:
            return self._ask(message, motion)
        yes = await _approved(context, message)
        return result(await self._granted(access, wish) if yes else _declined(robot, verb))

    def _ask(self, message: str, motion: Motion) -> InputRequiredResult:
        now = time.monotonic()
        self._asked = {key: each for key, each in self._asked.items() if now - each[0] < ASKED_S}
        while len(self._asked) >= ASKED_MAX:
            del self._asked[next(iter(self._asked))]
        nonce = secrets.token_hex(16)
        self._asked[nonce] = (now, motion)
        form = ElicitRequestFormParams(message=message, requested_schema=Approve.model_json_schema())
        return InputRequiredResult(input_requests={KEY: ElicitRequest(params=form)}, request_state=nonce)

    def _answered(self, context: Context[Any, Any], motion: Motion) -> bool | None:
        """Return the user's answer; None where this motion was not asked about."""
        replies, nonce = context.input_responses, context.request_state
        if not replies or not nonce:
            return None
        at, asked = self._asked.pop(nonce, (0.0, None))
        if asked != motion or time.monotonic() - at > ASKED_S:
            return None
        reply = replies.get(KEY)
        if not isinstance(reply, ElicitResult) or reply.action != "accept":
            return False
        return (reply.content or {}).get("approve") is True

    async def _granted(self, access: ClientAccess, wish: Wish) -> Envelope:
        robot, received = wish.robot, await access.caller.received(wish.robot, wish.verb, wish.sent)
        try:
            bound = {"caller": received.caller, "arguments_digest": digest(received.arguments)}
            grant = self._grants().grant(received.verb, robot, GRANT_S, **bound)
        except (StateFileError, ValidationError, OSError) as refused:
            return error(f"The approval could not be recorded: {refused}")
        try:
            answer = await wish.run()
        finally:
            # Where the robot did not take it, as one on another machine does not, nobody else may.
            unused = grant.exists()
            grant.unlink(missing_ok=True)
        if unused and _unapproved(answer, robot, received):
            return {**answer, "approved_here": "the robot is served by another machine or user, which has to approve"}
        return answer


def _unapproved(answer: Envelope, robot: str, received: ReceivedCall) -> bool:
    """Return whether a motion was refused for lack of its operator's approval."""
    # A network may put the robot's id before it.
    return str(answer.get("reason", "")).endswith(Approval.refusal(received.verb, robot))


async def _approved(context: Context[Any, Any], message: str) -> bool:
    """Ask the user in the midst of a call; True only where the form holds true."""
    try:
        reply = await context.elicit(message, Approve)
    except ValueError as unfit:
        logger.warning("The answer to a question is not its form, so it is no yes: %s", unfit)
        return False
    return reply.action == "accept" and reply.data.approve is True


def _can_ask(context: Context[Any, Any]) -> bool:
    capabilities = context.client_capabilities
    asks = None if capabilities is None else capabilities.elicitation
    return asks is not None and (asks.form is not None or asks.url is None)


def _declined(robot: str, verb: str) -> Envelope:
    return error(f"The user did not approve {verb} of {robot}. Do not ask again unless the user wants it.")


async def _question(access: ClientAccess, robot: str, verb: str, params: Mapping[str, Any]) -> tuple[str, str]:
    """Return the question and a picture as base64, empty where the robot gives none."""
    named = {name: params[name] for name in ("robot_name",) if name in params}
    pose = await access.caller.call(robot, "getPose", named)
    seen = await access.caller.call(robot, "getPicture", {"width": 640, "height": 480})
    # Of a verb of the robot's own nothing is known, so that all of it is shown.
    described = {"speed", "wait"} if verb in KNOWN else set[str]()
    asked = json.dumps({name: value for name, value in params.items() if name not in described}, default=str)
    cut = f"... ({len(asked)} characters)" if len(asked) > SHOWN_MAX else ""
    lines = [
        f"Let the real robot {json.dumps(robot)} move?",
        f"What: {verb} {asked[:SHOWN_MAX]}{cut}",
        f"How far: {_how_far(verb, params, pose)}",
        f"How fast: {_how_fast(verb, params)}",
    ]
    return "\n".join(lines), jpeg_of(seen) or ""


def _how_far(verb: str, params: Mapping[str, Any], pose: Envelope) -> str:
    if verb == "acquireControl":
        return "nothing yet; it is kept from other programs, and each motion is asked about"
    if verb not in KNOWN:
        return "not known before; it is a verb of the robot's own"
    offset = [params.get(name, 0.0) for name in ("dx", "dy", "dz")]
    if verb == "moveBy" and all(map(_is_number, offset)):
        return f"the tip by {math.hypot(*offset) * 1000:.0f} mm"
    tip = [pose.get(name) for name in "xyz"]
    goal = [params.get(name) for name in "xyz"]
    if all(map(_is_number, (*tip, *goal))):
        return f"the tip by {math.dist(tip, goal) * 1000:.0f} mm"  # type: ignore[arg-type]
    joints, now = params.get("joints"), pose.get("joints")
    if isinstance(joints, Mapping) and isinstance(now, Mapping):
        turns = [abs(to - now[name]) for name, to in joints.items() if _is_number(to) and _is_number(now.get(name))]
        if turns:
            return f"a joint by up to {max(turns):.0f} degrees"
    if verb == "setGripper":
        return "the gripper alone"
    return "not known before; anywhere within its reach"


def _how_fast(verb: str, params: Mapping[str, Any]) -> str:
    if verb not in KNOWN:
        return "not known before"
    speed, lasts = params.get("speed"), params.get("duration")
    if _is_number(speed):
        return f"up to {speed * 100:.0f} % of full speed, {FULL_SPEED}"
    if _is_number(lasts):
        return f"up to full speed, {FULL_SPEED}, for at most {lasts:g} s"
    return f"up to full speed, {FULL_SPEED}"


def _is_number(value: object) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
