"""Robots on Device Connect, for the calling side."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from strands_robots.envelope import Envelope
from strands_robots.errors import (
    ArgumentsError,
    NoAnswerError,
    NoSuchRobotError,
    RefusalError,
    RobotError,
    UnknownVerbError,
    UnreachableError,
)
from strands_robots.fleet.adapter import CLOSED, DEVICE_CONNECT, FIND_S, STOP_S, FoundRobot, OnEvent, RobotEvent
from strands_robots.safety.identity import KeyFileError
from strands_robots.utils import ValidationError, plain_text

if TYPE_CHECKING:
    from strands_robots.device_connect.backends import LinkConfig
    from strands_robots.device_connect.client import DeviceEvent, FleetClient
    from strands_robots.device_connect.discovery import Peer

logger = logging.getLogger(__name__)

UNKNOWN_METHOD, BAD_PARAMS = -32601, -32602
"""JSON-RPC's codes of an unknown function and of arguments that do not fit."""

DESCRIBE_S = 2.0
"""Seconds in which a device has to describe itself."""

UNKNOWN_STOP_S = 1.0
"""Seconds in which a device that was not found has to answer a stop."""


class DeviceConnectNetwork:
    """One tenant of Device Connect.

    Args:
        link: how to reach it.
        source: the caller's name that goes with every call.
    """

    name = DEVICE_CONNECT
    announces_verbs = True
    reads: Mapping[str, str] = {"status": "getStatus", "state": "getState", "features": "getFeatures"}

    def __init__(self, link: LinkConfig, source: str) -> None:
        from strands_robots.device_connect.client import FleetClient  # noqa: PLC0415 - loaded when it is used

        self._client = FleetClient(link, source)
        self._peers: dict[str, Peer] = {}
        self._discoveries = 0
        self._open = False

    def open(self) -> None:
        """Connect; raise :class:`UnreachableError` where that fails."""
        from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - loaded when it is used

        try:
            self._client.__enter__()
        except (MessagingError, TimeoutError, OSError) as exc:
            raise UnreachableError(plain_text(str(exc))) from exc
        self._open = True

    def find(self, timeout: float = FIND_S) -> list[FoundRobot]:
        """Return the devices of the tenant."""
        self._discoveries += 1
        with _carried():
            self._peers = {peer.id: peer for peer in self._connected.peers(timeout)}
        return [
            FoundRobot(peer.id, plain_text(peer.type, 100), plain_text(peer.model, 100))
            for peer in self._peers.values()
        ]

    def bears(self, robot: str) -> bool:
        """Return whether a device of this id was found or has announced itself."""
        return robot in self._peers or (self._open and robot in self._client.known())

    def session(self, robot: str) -> object:
        """Return the number of discoveries: a device has no session."""
        return self._discoveries

    def enrolled_key(self, robot: str) -> bytes | None:
        """Return the device's enrolled key."""
        from strands_robots.device_connect.enrollment import enrolled_robots  # noqa: PLC0415 - loaded when it is used

        try:
            return enrolled_robots(self._client.link).get(robot)
        except (KeyFileError, OSError) as exc:
            logger.warning("The enrolled keys cannot be used, so none counts: %s", exc)
            return None

    def describe(self, robot: str, *, anew: bool = False) -> object:
        """Return the functions that the device announced."""
        if anew:
            try:
                self._peers[robot] = self._connected.describe(robot, DESCRIBE_S)
            except Exception as exc:
                refusal = _refusal(exc, robot, "requestRegistration")
                if refusal is None:
                    raise
                logger.debug("%s: it does not describe itself anew: %s", robot, refusal)
        peer = self._peers.get(robot)
        return None if peer is None else peer.functions

    def call(self, robot: str, verb: str, arguments: Mapping[str, Any], timeout: float) -> Envelope:
        """Call a function of the device."""
        try:
            return self._connected.call(robot, verb, arguments, timeout)
        except RefusalError:
            raise
        except Exception as exc:
            refusal = _refusal(exc, robot, verb)
            if refusal is None:
                raise
            raise refusal from exc

    def stop(self, robot: str, timeout: float = STOP_S, robot_name: str = "") -> Envelope | None:
        """Stop the device by ``stop``, else by ``stopMotion``."""
        within = timeout if self.bears(robot) else min(timeout, UNKNOWN_STOP_S)
        answer = self._connected.stop(robot, within, robot_name)
        unknown = answer.get("status") == "error" and answer.get("stopped") is None
        return None if unknown and not self.bears(robot) else answer

    def stop_all(self, timeout: float = STOP_S) -> dict[str, Envelope]:
        """Stop each device when it is found."""
        with _carried():
            return self._connected.stop_all(timeout)

    def subscribe(self, robot: str, on_event: OnEvent) -> Callable[[], None]:
        """Receive the device's events."""

        def arrived(event: DeviceEvent) -> None:
            on_event(RobotEvent(event.device, plain_text(event.name, 100), event.payload))

        with _carried():
            return self._connected.subscription(robot, arrived).close

    def close(self) -> None:
        """Disconnect."""
        self._open = False
        self._client.close()

    @property
    def _connected(self) -> FleetClient:
        if not self._open:
            raise UnreachableError("Device Connect is not joined: use the fleet as a context manager")
        return self._client


@contextmanager
def _carried() -> Iterator[None]:
    """Raise :class:`UnreachableError` for what the network cannot carry."""
    from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - loaded when it is used

    try:
        yield
    except (MessagingError, TimeoutError, OSError) as exc:
        if isinstance(exc, RefusalError):
            raise
        raise UnreachableError(plain_text(str(exc)) or "Device Connect did not answer in time") from exc


def _refusal(exc: Exception, robot: str, verb: str) -> RefusalError | None:
    from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - loaded when it is used

    from strands_robots.device_connect.client import (  # noqa: PLC0415 - as above
        CallRefusedError,
        ClientClosedError,
        NoSuchDeviceError,
    )

    if isinstance(exc, ClientClosedError):
        return NoAnswerError(CLOSED, robot=robot, verb=verb)
    why, cause = plain_text(str(exc)), None
    if isinstance(exc, CallRefusedError):
        cause = {UNKNOWN_METHOD: UnknownVerbError, BAD_PARAMS: ArgumentsError}.get(exc.code, RobotError)
    elif isinstance(exc, NoSuchDeviceError):
        cause = NoSuchRobotError
    elif isinstance(exc, ValidationError):
        cause = ArgumentsError
    elif isinstance(exc, TimeoutError):
        cause = NoAnswerError
    elif isinstance(exc, MessagingError):
        cause = UnreachableError
    return None if cause is None else cause(why or "no answer", robot=robot, verb=verb)
