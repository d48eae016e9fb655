"""Adapter of one network to the calling side, in a file of its own each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from strands_robots.envelope import Envelope

DEVICE_CONNECT, MESH = "device_connect", "mesh"

FIND_S = 2.0
"""Seconds at most in which robots are looked for."""

CLOSED = "the fleet was closed before it answered"
"""Reason of a call that :meth:`NetworkAdapter.close` ends."""

STOP_S = 5.0
"""Seconds in which a robot has to answer a stop."""


@dataclass(frozen=True, slots=True)
class FoundRobot:
    """A robot as its network announces it; the texts are plain and short."""

    id: str
    type: str = ""
    model: str = ""


@dataclass(frozen=True, slots=True)
class RobotEvent:
    """An event of a robot, as it arrived. The robot is the one that the topic names."""

    robot: str
    name: str
    payload: Mapping[str, Any]


OnEvent = Callable[[RobotEvent], None]
"""Takes an event on a thread of the network: it returns at once and does not raise."""


class NetworkAdapter(Protocol):
    """Robots of one network: find, describe, call and stop them, follow their events.

    Attributes:
        name: :data:`DEVICE_CONNECT` or :data:`MESH`.
        announces_verbs: robots announce their verbs, so that :meth:`describe` asks no one.
        reads: the names on this network of the reads ``status``, ``state`` and ``features``.
    """

    name: str
    announces_verbs: bool
    reads: Mapping[str, str]

    def open(self) -> None:
        """Join the network.

        Raises:
            UnreachableError: it cannot be reached.
        """

    def find(self, timeout: float = FIND_S) -> list[FoundRobot]:
        """Return the robots in reach."""

    def bears(self, robot: str) -> bool:
        """Return whether a robot of this id is known here; asks no one."""

    def session(self, robot: str) -> object:
        """Return what differs once another robot may answer to this id; asks no one."""

    def enrolled_key(self, robot: str) -> bytes | None:
        """Return the public key that is enrolled for this id; None for none."""

    def describe(self, robot: str, *, anew: bool = False) -> object:
        """Return the robot's functions as they came over the wire.

        ``anew`` asks the robot itself.
        """

    def call(self, robot: str, verb: str, arguments: Mapping[str, Any], timeout: float) -> Envelope:
        """Call a verb and return the answer, also one of status error.

        Raises:
            RefusalError: the call got no answer, or was refused as such.
        """

    def stop(self, robot: str, timeout: float = STOP_S, robot_name: str = "") -> Envelope | None:
        """Stop a robot and return its answer, None where it is not on this network.

        ``robot_name`` stops one robot of a world alone. No answer in time is an envelope with ``stopped`` None.
        """

    def stop_all(self, timeout: float = STOP_S) -> dict[str, Envelope]:
        """Stop every robot in reach; return the answers by id."""

    def subscribe(self, robot: str, on_event: OnEvent) -> Callable[[], None]:
        """Receive the robot's events; return the function that ends it."""

    def close(self) -> None:
        """Leave the network; a second call does nothing."""
