"""ROS graphs: names, interface types and messages, and the contract of a link.

A message class describes its fields by ``get_fields_and_field_types``, in the terms of the ROS 2 interface definition:
``double``, ``string<10>``, ``sequence<uint8>``, ``double[36]``, ``geometry_msgs/Vector3``. Those of bare DDS say
``float``, ``int``, ``bool``, ``str`` and ``bytes`` as well.
"""

from __future__ import annotations

import contextlib
import logging
import re
import threading
import time
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Protocol, runtime_checkable

from strands_robots import settings
from strands_robots.errors import StrandsRobotsError
from strands_robots.utils import ValidationError, plain_value, shown, whole

logger = logging.getLogger(__name__)

NAME_MAX = 255
"""Longest graph name in characters, the bound of DDS topic names."""

DOMAIN_MAX = 232
"""Highest DDS domain: RTPS derives its UDP ports from it, and those of 233 are past 65535."""

LATCHED = ("/robot_description", "/map", "/tf_static")
"""Topics whose publishers keep their last message for a late subscription, by the conventions of ROS 2."""

_NAME = re.compile(r"[/~]?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*\Z")
_NODE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_KIND = re.compile(r"([a-z][a-z0-9_]*)/(?:(?:msg|srv|action)/)?([A-Z][A-Za-z0-9]*)\Z")

Message = Mapping[str, Any]
OnMessage = Callable[[Message], None]
Unwatch = Callable[[], None]
CancelCheck = Callable[[], bool]

SUCCEEDED = 4
"""``action_msgs/GoalStatus`` of a goal that was reached."""

STATUS_NAMES = ("unknown", "accepted", "executing", "canceling", "succeeded", "canceled", "aborted")
"""The statuses of ``action_msgs/GoalStatus``, in the order of their numbers."""

CANCEL_S = 5.0
"""Seconds within which a cancelled goal has to end."""

SLICE_S = 0.01


def graph_name(name: str, value: object) -> str:
    """Check the name of a topic, service or action, such as /cmd_vel."""
    if not isinstance(value, str) or len(value) > NAME_MAX or not _NAME.match(value) or "__" in value:
        raise ValidationError(
            f"{name} must be a ROS name of letters, digits, '_' and '/', such as /cmd_vel, not {shown(value)}."
        )
    return value


def interface(name: str, value: object) -> str:
    """Check an interface type: ``pkg/Name`` (ROS 1) or ``pkg/msg/Name`` (ROS 2)."""
    if not isinstance(value, str) or len(value) > NAME_MAX or not _KIND.match(value):
        raise ValidationError(
            f"{name} must be a ROS type such as geometry_msgs/msg/Twist or geometry_msgs/Twist, not {shown(value)}."
        )
    return value


def is_latched(topic: str) -> bool:
    """Return True for a latched topic, by its name in any namespace."""
    return any(absolute(topic).endswith(name) for name in LATCHED)


@lru_cache(maxsize=256)
def bare_kind(kind: str) -> str:
    """Return ``pkg/Name`` for either spelling, so that types can be compared."""
    found = _KIND.match(kind)
    return f"{found[1]}/{found[2]}" if found else kind


def node_name(name: str, value: object) -> str:
    """Check the name of a node: letters, digits and underscores, the first no digit."""
    if not isinstance(value, str) or len(value) > NAME_MAX or not _NODE.match(value):
        raise ValidationError(
            f"{name} must be a ROS node name of letters, digits and '_', not starting with a digit, not {shown(value)}."
        )
    return value


def domain(domain_id: int | None) -> int:
    """Check a DDS domain, 0 to :data:`DOMAIN_MAX`; None stands for ``ROS_DOMAIN_ID``."""
    stated = settings.integer("ROS_DOMAIN_ID") if domain_id is None else domain_id
    return whole("domain_id", stated, low=0, high=DOMAIN_MAX)


def absolute(name: str) -> str:
    """Return a graph name with its leading slash; a private ``~`` name stays."""
    return name if name.startswith(("/", "~")) else f"/{name}"


class RosError(StrandsRobotsError, RuntimeError):
    """The link or the graph did not do what was asked; the message is one sentence."""


class EarlierRefusedError(RosError):
    """A message was not sent, because the server refused an earlier one."""


def never() -> bool:
    """Return False: the goal is not cancelled."""
    return False


class RosLink(Protocol):
    """A thread-safe connection to a ROS graph; every verb raises :class:`RosError`."""

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        """Hand one message to the graph; returns within the link's own time-out."""

    def read(self, topic: str, kind: str | None, within_s: float) -> dict[str, Any]:
        """Return the next message of a topic; ``kind`` None: ask the graph for it."""

    def call(self, service: str, kind: str, fields: Message, within_s: float) -> dict[str, Any]:
        """Call a service and return its response."""

    def watch(self, topic: str, kind: str | None, on_message: OnMessage) -> Unwatch:
        """Call ``on_message`` on the link's thread; it must return at once."""

    def close(self) -> None:
        """Leave the graph. A later use opens the link anew."""


class BroadcastLink(RosLink, Protocol):
    """A link that can publish without waiting for a subscription."""

    def open(self) -> Any:
        """Join the graph now. Raises :class:`RosError` where that fails."""

    def broadcast(self, topic: str, kind: str, fields: Message) -> None:
        """Publish, such as telemetry, whether or not there is a subscription."""


@runtime_checkable
class UrgentLink(Protocol):
    """A link with a second connection, for zeros alone, that nothing delays."""

    def prepare_urgent(self, topic: str, kind: str) -> None:
        """Have the second connection ready for ``topic``; returns at once."""

    def publish_urgent(self, topic: str, kind: str, fields: Message) -> None:
        """Send one message by it, or raise :class:`RosError` instead of waiting."""

    def cut(self) -> None:
        """Drop everything that the first connection has not sent yet."""


class NoReceiptError(RosError):
    """A message was sent, and the server has not confirmed that it received it."""


@runtime_checkable
class ConfirmingLink(Protocol):
    """A link that can ask whether what it sent has arrived."""

    def confirm(self, within_s: float) -> None:
        """Wait until everything sent has arrived, else :class:`NoReceiptError`."""


@runtime_checkable
class GoalLink(Protocol):
    """A link that carries actions."""

    def send_goal(
        self,
        action: str,
        kind: str,
        goal: Message,
        within_s: float,
        *,
        feedback: OnMessage | None = None,
        cancelled: CancelCheck = never,
    ) -> Goal:
        """Send a goal; return once it is accepted, out of time or ``cancelled``.

        A goal that is cancelled before the server took it is cancelled once it does.

        Raises:
            RosError: there is no server, or it refused the goal; nothing began.
        """


class Goal:
    """A goal that was sent; ``done`` once its end is known or cannot be known.

    Args:
        cancel: asks the server to end it; returns at once, raises :class:`RosError` when it cannot be asked.
    """

    def __init__(self, cancel: Callable[[], None]) -> None:
        self.done = threading.Event()
        self.status: int | None = None
        self.values: Any = {}
        self.rejected = False
        self.problem = ""
        self.cancel = cancel

    def end(self, status: int, values: Any) -> None:
        """Record the reported end: a ``GoalStatus`` and the result's fields."""
        if not self.done.is_set():
            self.status, self.values = status, values
            self.done.set()

    def reject(self, problem: str) -> None:
        """Record that the server did not take the goal, so that nothing began."""
        self.rejected = True
        self.fail(problem)

    def fail(self, problem: str) -> None:
        """Record why the end will not become known; the first reason counts."""
        if not self.done.is_set():
            self.problem = problem
            self.done.set()


@dataclass(frozen=True, slots=True)
class GoalReport:
    """Outcome of a goal.

    ``state``: one of :data:`STATUS_NAMES`, ``rejected``, or ``lost`` where its end is unknown. ``over``: the server
    reported the end, so that nothing goes on. ``ended_by``: what cut the goal short, "" nothing. ``lost_goal``: a lost
    goal itself, whose end may still come.
    """

    state: str
    over: bool
    ended_by: str = ""
    status: int | None = None
    values: Any = field(default_factory=dict)
    problem: str = ""
    lost_goal: Goal | None = None

    def sentence(self) -> str:
        """Return the report in one sentence."""
        if self.state == "lost":
            after = f"After {self.ended_by}, " if self.ended_by else ""
            return f"{after}it is unknown whether the goal still goes on: {self.problem}."
        if self.state == "rejected":
            return self.problem
        after = f" after {self.ended_by} ended it" if self.ended_by else ""
        return f"the goal {'was ' if self.state in ('canceled', 'aborted') else ''}{self.state}{after}."


def run_goal(
    link: object,
    action: str,
    kind: str,
    goal: Message,
    within_s: float,
    *,
    feedback: OnMessage | None = None,
    cancelled: CancelCheck = never,
) -> GoalReport:
    """Send a goal and wait for its end; cancel it in time or by ``cancelled``.

    Raises:
        RosError: the goal never began.
    """
    if not isinstance(link, GoalLink):
        raise RosError(f"{action} is an action, and bare DDS carries topics only; use rclpy or rosbridge.")
    deadline = time.monotonic() + within_s
    sent = link.send_goal(action, kind, goal, within_s, feedback=feedback, cancelled=cancelled)
    ended_by = ""
    try:
        while not ended_by and not sent.done.wait(SLICE_S):
            if cancelled():
                ended_by = "a stop"
            elif time.monotonic() >= deadline:
                ended_by = f"its time of {within_s:g} s"
    except BaseException:
        # A Ctrl-C in the wait must not leave the robot on its way.
        with contextlib.suppress(RosError):  # what interrupted the wait is what is raised
            sent.cancel()
        raise
    problem = _cancel(sent) if ended_by else ""
    if sent.rejected:
        return GoalReport("rejected", True, ended_by, problem=sent.problem)
    if sent.status is None:
        return GoalReport("lost", False, ended_by, problem=problem or sent.problem, lost_goal=sent)
    if not SUCCEEDED <= sent.status < len(STATUS_NAMES):
        problem = f"its server reported status {sent.status}, which ends nothing"
        return GoalReport("lost", False, ended_by, sent.status, sent.values, problem)
    return GoalReport(STATUS_NAMES[sent.status], True, ended_by, sent.status, sent.values)


def _cancel(sent: Goal) -> str:
    """Cancel a goal and wait for its end; why it did not come, or ""."""
    try:
        sent.cancel()
    except RosError as exc:
        return f"it could not be cancelled: {exc}"
    return "" if sent.done.wait(CANCEL_S) else f"it did not end within {CANCEL_S:g} s of being cancelled"


def deliver(on_message: OnMessage, message: Message, topic: str) -> None:
    """Hand a message to a watcher, whose failure keeps no other one from hearing."""
    try:
        on_message(message)
    except Exception:
        logger.exception("A watcher of %s failed.", topic)


def next_message(
    watch: Callable[[str, str | None, OnMessage], Unwatch], topic: str, kind: str | None, within_s: float
) -> dict[str, Any]:
    """Return the next message, for a link by its ``watch``; none is a RosError."""
    arrived, messages = threading.Event(), list[Message]()

    def keep(message: Message) -> None:
        messages.append(message)
        arrived.set()

    unwatch = watch(topic, kind, keep)
    try:
        if not arrived.wait(within_s):
            raise RosError(f"Nothing arrived on {topic} within {within_s:g} s.")
    finally:
        unwatch()
    return dict(messages[0])


NewMessage = Callable[[str], Any]
"""Returns an empty message of a kind."""

_SEQUENCE = re.compile(r"sequence<(.+?)(?:, *(\d+))?>\Z")
_ARRAY = re.compile(r"(.+)\[(\d+)\]\Z")
_INTEGER = re.compile(r"(u?)int(8|16|32|64)\Z")
_PLAIN: dict[str, type] = {
    **dict.fromkeys(("float", "double", "long double"), float),
    **dict.fromkeys(("boolean", "bool"), bool),
    **dict.fromkeys(("string", "wstring", "str"), str),
}


def filled(message: Any, fields: Mapping[str, Any], new: NewMessage, place: str = "") -> Any:
    """Set fields of ``message`` and return it; a wrong one is a RosError."""
    types = message.get_fields_and_field_types()
    for name, value in fields.items():
        if name not in types:
            raise RosError(f"{type(message).__name__} has no field {place}{name}; it has {', '.join(types)}.")
        where = f"{place}{name}"
        try:
            setattr(message, name, _value(types[name], value, where, new, getattr(message, name)))
        except (AssertionError, OverflowError) as exc:
            raise RosError(f"{where} must be a {types[name]}, not {shown(value)}.") from exc
    return message


def plain(message: Any) -> dict[str, Any]:
    """Return the fields of a message as numbers, text, bytes, lists and dictionaries."""
    types = message.get_fields_and_field_types()
    return {name: _plain(kind, getattr(message, name)) for name, kind in types.items()}


def _value(kind: str, value: Any, place: str, new: NewMessage, zero: Any = None) -> Any:
    if (several := _several(kind)) is not None:
        return _items(*several, value, place, new)
    value = plain_value(value)
    if "/" in kind:
        if not isinstance(value, Mapping):
            raise RosError(f"{place} must be an object of fields, not {shown(value)}.")
        return filled(new(kind) if zero is None else zero, value, new, f"{place}.")
    if kind == "bytes":
        return _bytes(value, place)
    if kind == "octet":
        if not isinstance(value, int) or isinstance(value, bool):
            raise RosError(f"{place} must be an octet, not {shown(value)}.")
        return value.to_bytes(1, "little")
    wanted = _PLAIN.get(kind.partition("<")[0], int)
    if wanted is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, wanted) or (wanted is int and isinstance(value, bool)):
        raise RosError(f"{place} must be a {kind}, not {shown(value)}.")
    # Newer ROS 2 checks no value in its setters, and the conversion to C would cut an integer.
    return _whole(kind, value, place) if isinstance(value, int) else value


def _whole(kind: str, value: int, place: str) -> int:
    integer = _INTEGER.match(kind)
    if integer is not None:
        bits = int(integer[2])
        low, high = (0, 2**bits) if integer[1] else (-(2 ** (bits - 1)), 2 ** (bits - 1))
        if not low <= value < high:
            raise RosError(f"{place} must be a {kind}, from {low} to {high - 1}, not {shown(value)}.")
    return value


def _items(kind: str, length: int | None, value: Any, place: str, new: NewMessage) -> Any:
    if kind == "uint8" and str(getattr(value, "dtype", "")) == "uint8":
        value = value.tobytes()
    if kind == "uint8" and isinstance(value, bytes | bytearray):
        items: Any = bytes(value)
    else:
        items = value.tolist() if callable(getattr(value, "tolist", None)) else value
        if not isinstance(items, Sequence) or isinstance(items, str | bytes):
            raise RosError(f"{place} must be a list, not {shown(value)}.")
        items = [_value(kind, each, f"{place}[{n}]", new) for n, each in enumerate(items)]
    if length is not None and len(items) != length:
        raise RosError(f"{place} must have {length} items, not {len(items)}.")
    # An array of the right type is taken as it is; every other sequence would be checked number by number.
    return array("B", items) if kind == "uint8" and length is None else items


def _bytes(value: Any, place: str) -> bytes:
    if isinstance(value, bytes | bytearray):
        return bytes(value)
    tobytes = getattr(value, "tobytes", None)
    if callable(tobytes):
        return bytes(tobytes())
    try:
        return bytes(value) if isinstance(value, list) else bytes([-1])
    except (TypeError, ValueError):
        raise RosError(f"{place} must be bytes or a list of them, not {shown(value)}.") from None


def _plain(kind: str, value: Any) -> Any:
    several = _several(kind)
    if several is not None:
        if several[0] == "uint8":
            return bytes(value)
        if "/" in several[0] or several[0] == "octet":
            return [_plain(several[0], each) for each in value]
        return value.tolist() if callable(getattr(value, "tolist", None)) else list(value)
    if "/" in kind:
        return plain(value)
    return value[0] if kind == "octet" else value


@lru_cache(maxsize=256)
def _several(kind: str) -> tuple[str, int | None] | None:
    """Return the item type and the fixed length of a list; None for other types."""
    if (found := _SEQUENCE.match(kind)) is not None:
        return found[1], None
    if (found := _ARRAY.match(kind)) is not None:
        return found[1], int(found[2])
    return None
