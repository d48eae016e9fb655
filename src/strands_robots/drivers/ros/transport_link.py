"""Transport of strands-robots 0.5 as a link to a ROS graph.

Such a transport has ``twist_type``, ``publish`` and ``echo``, and may have ``service_call``; each answers with an
envelope. A program or its test double brings one.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from typing import Any

from strands_robots.envelope import fields_of, is_error, text_of
from strands_robots.ros.link import Message, OnMessage, RosError, RosLink, Unwatch
from strands_robots.utils import ValidationError, shown

TRANSPORT = ("publish", "echo")


class TransportLink:
    """Link that hands every message to a transport.

    It has no subscriptions, so a stop by it cannot wait to see the base still.

    Raises:
        ValidationError: the transport has no ``publish`` or no ``echo``.
    """

    def __init__(self, transport: Any) -> None:
        if not all(callable(getattr(transport, name, None)) for name in TRANSPORT):
            raise ValidationError(f"transport must have publish and echo, not {shown(transport)}.")
        self._transport = transport

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        self._ask("publish", topic=topic, type=kind, fields=dict(fields), count=1, rate=1.0)

    def read(self, topic: str, kind: str | None, within_s: float) -> dict[str, Any]:
        return _sample(self._ask("echo", topic=topic, type=kind, count=1, timeout=within_s), topic)

    def call(self, service: str, kind: str, fields: Message, within_s: float) -> dict[str, Any]:
        return fields_of(self._ask("service_call", service=service, type=kind, fields=dict(fields)))

    def watch(self, topic: str, kind: str | None, on_message: OnMessage) -> Unwatch:
        raise RosError(f"{topic} cannot be watched: the transport has no subscriptions.")

    def close(self) -> None:
        """Do nothing: the transport is the caller's."""

    def _ask(self, verb: str, **arguments: Any) -> Any:
        method = getattr(self._transport, verb, None)
        if not callable(method):
            raise RosError(f"the transport has no {verb}.")
        try:
            answer = method(**arguments)
        except Exception as exc:
            raise RosError(f"the transport's {verb} failed: {type(exc).__name__}: {exc}") from exc
        if is_error(answer):
            raise RosError(text_of(answer) or f"the transport refused {verb}.")
        if verb != "echo" and not (isinstance(answer, Mapping) and answer.get("status") == "success"):
            raise RosError(f"the transport answered {verb} with an unknown result shape: {shown(answer)}.")
        return answer


def _sample(answer: object, topic: str) -> dict[str, Any]:
    """Return the first message in an answer to ``echo``: of a field or of its text."""
    found: list[object] = [answer, *fields_of(answer).values()] if isinstance(answer, Mapping) else [answer]
    text = text_of(dict(answer)) if isinstance(answer, Mapping) else ""
    with contextlib.suppress(ValueError):
        found.append(json.loads(text[text.index("[") :]))
    for each in found:
        if isinstance(each, list) and each and isinstance(each[0], Mapping) and "text" not in each[0]:
            return dict(each[0])
    raise RosError(f"no message of {topic} came.")


def former_link(link: RosLink | str | None, topic: Any, kind: str, former: dict[str, Any]) -> tuple[RosLink, str, str]:
    """Return link, velocity topic and its type; from the arguments of 0.5, if given.

    Args:
        link: a link, or the velocity topic of 0.5.
        topic: the velocity topic, or the transport of 0.5.
        former: ``transport``, ``cmd_vel_topic`` and ``cmd_vel_type``, where named.

    Raises:
        TypeError: there is another argument, or no link.
    """
    transport = former.pop("transport", None if isinstance(topic, str) else topic)
    named = former.pop("cmd_vel_topic", link if isinstance(link, str) else topic)
    stated = former.pop("cmd_vel_type", None)
    if former:
        raise TypeError(f"MobileBaseRobot got an unexpected keyword argument {next(iter(former))!r}")
    if transport is not None:
        twist = getattr(transport, "twist_type", None)
        return TransportLink(transport), named, stated or (twist if isinstance(twist, str) else kind)
    if link is None or isinstance(link, str):
        raise TypeError("MobileBaseRobot needs a link, or a transport of 0.5")
    return link, named, stated or kind
