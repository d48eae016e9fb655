"""A second connection to a rosbridge server, for zeros alone: whatever clogs the first does not hold up a stop."""

from __future__ import annotations

import logging
from collections.abc import Callable
from itertools import count

from strands_robots.ros.link import Message, RosError
from strands_robots.ros.rosbridge_session import Session
from strands_robots.ros.rosbridge_wire import decoded, encoded
from strands_robots.utils import shown

logger = logging.getLogger(__name__)


class UrgentRoad:
    """Opened and advertised ahead of need, and never waited for.

    Args:
        host: of the server, with its ``port``.
        connect_s: how long one attempt to connect may take, in seconds.
    """

    def __init__(self, host: str, port: int, connect_s: float) -> None:
        self._session = Session(
            host, port, connect_s=connect_s, opened=self._opened, received=self._received, lost=self._lost
        )
        self._numbers = count(1)
        self._kinds: dict[str, str] = {}
        self._complaint = ""

    def prepare(self, topic: str, kind: str) -> None:
        """Have the connection made, and the topic advertised on it, without waiting for either."""
        known = self._kinds.get(topic) == kind
        self._kinds[topic] = kind
        if self._session.up:
            if not known:
                self._session.send(self._advertised(topic, kind))
        else:
            self._session.start()

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        """Send one message now. Raises :class:`RosError` where that cannot be done without waiting."""
        complaint, self._complaint = self._complaint, ""
        if complaint:
            raise RosError(complaint)
        self.prepare(topic, kind)
        if not self._session.up:
            raise RosError(f"The second connection to {self._session.url} is not there.")
        self._session.send(encoded("publish", id=f"publish:{next(self._numbers)}", topic=topic, type=kind, msg=fields))

    def close(self) -> None:
        """Close the connection."""
        self._kinds.clear()
        self._session.close()

    def _advertised(self, topic: str, kind: str) -> str:
        return encoded("advertise", id=f"advertise:{next(self._numbers)}", topic=topic, type=kind)

    # On the session's thread.

    def _opened(self, send: Callable[[str], None]) -> None:
        for topic, kind in list(self._kinds.items()):
            send(self._advertised(topic, kind))

    def _received(self, frame: str | bytes) -> None:
        try:
            message = decoded(frame)
        except RosError as exc:
            logger.warning("%s sent what cannot be used: %s", self._session.url, exc)
            return
        if message["op"] == "status" and message.get("level") == "error":
            self._complaint = f"rosbridge says: {shown(message.get('msg'))}"
            logger.warning("%s", self._complaint)

    def _lost(self, why: str) -> None:
        logger.info("The second connection to %s was lost: %s", self._session.url, why)
