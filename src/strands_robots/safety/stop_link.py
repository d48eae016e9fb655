"""Protocol of the connections that carry stops, which each network supplies.

A network gives the e-stop listener a :class:`StopLink`, and a :class:`StopCodec` where its emergency stops are no
JSON-RPC notifications.
"""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from strands_robots.safety.missed_stops import ANSWER, QUESTION
from strands_robots.safety.orders import StopOrder, StopRefused, StopRules, params_of, stated_epoch

if TYPE_CHECKING:
    from strands_robots.safety.reporting import StopRun

ESTOP = "emergencyStop"
VERDICT = "emergencyStopVerdict"
CHECK_IN = "safetyCheckIn"
CHECK_IN_ANSWER = "safetyCheckInAnswer"
EVENTS = (ESTOP, CHECK_IN, CHECK_IN_ANSWER, QUESTION, ANSWER)

OnEvent = Callable[[str, str, bytes | int], None]
"""Called with event, source and bytes on a thread of the link; it must return at once and may not raise.

In place of more than :data:`~.orders.PARSED_MAX_BYTES` a link gives their number.
"""

OnState = Callable[[bool], None]
"""Called with the link's state, True for up, on a thread of the link, at each change.

Also with True while it is up, when a connection is new or a peer that was lost is back.
"""


class StopLink(Protocol):
    """A connection that carries stops and nothing else, supplied by a network.

    No method blocks on the network, and none raises for the connection's state.
    """

    @property
    def up(self) -> bool:
        """True while a peer can be reached."""

    def open(self, events: Collection[str], on_event: OnEvent, on_state: OnState) -> None:
        """Subscribe to these events of the tenant; return before the link is up."""

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        """Send as ``source`` now; False, without a later try, when the link is down."""

    def close(self) -> None:
        """Close the connection and end the link's thread. Safe to call twice."""


@runtime_checkable
class RenewableLink(Protocol):
    """A link that can be made anew while it is used."""

    def renew(self) -> None:
        """Open a connection in place of the present one; return at once."""


@runtime_checkable
class ReportingLink(Protocol):
    """A link of a network that tells a sender what it refuses."""

    @property
    def denied(self) -> str:
        """The broker's refusal of a stop of this connection, or ""."""


def notification(event: str, params: Mapping[str, Any], event_id: str = "") -> bytes:
    """Encode an event as a JSON-RPC 2.0 notification with ``event_id`` and ``ts``."""
    stamp = {"event_id": event_id or uuid.uuid4().hex, "ts": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}
    return json.dumps({"jsonrpc": "2.0", "method": event, "params": {**params, **stamp}}).encode()


class StopCodec:
    """Events of stops as JSON-RPC notifications, the form of Device Connect.

    Another network overrides what differs on its wire. Nothing here blocks, reads a file or waits for a network.

    Attributes:
        names_source: the link names who sends, so that a source that may not stop is refused before it is read.
        answers: robots answer a stop with a verdict over the link.
    """

    names_source = True
    answers = True

    def encode(self, event: str, fields: Mapping[str, Any]) -> bytes:
        """Encode an event of this process."""
        return notification(event, fields)

    def fields(self, payload: bytes | int | None) -> Mapping[str, Any]:
        """Return the fields of a message; empty for what is none or is too long to be read."""
        return {} if payload is None else params_of(payload)

    def epoch(self, source: str, fields: Mapping[str, Any]) -> str:
        """Return the epoch that a stop states; empty for none."""
        return stated_epoch(source, fields)

    def order(
        self, rules: StopRules, stop: StopEvent, fields: Mapping[str, Any], path: str, age_s: float = 0.0
    ) -> StopOrder | StopRefused | None:
        """Decide whether a stop counts; None for one that is to be passed over.

        Args:
            fields: of its payload.
            path: how it arrived.
            age_s: seconds since the first process received it, where it was missed.
        """
        return rules.order(stop.source, fields, path, stop.payload, stop.at, network=stop.network, age_s=age_s)

    def vouches(self, rules: StopRules) -> bool:
        """Return True where each stop that counts is signed, so that its source has a share of its own."""
        return rules.signed

    def refused(self, refused: StopRefused) -> bool:
        """Record a refused stop; False to have the listener do so."""
        return False

    def begun(self, order: StopOrder, fields: Mapping[str, Any], run: StopRun | None) -> None:
        """Note a stop whose halts are ordered; return at once.

        Args:
            run: None where no robot had anything to do, as for a repetition.
        """


JSON_RPC = StopCodec()


class StopEvent(NamedTuple):
    """Event from a network.

    Attributes:
        source: the sender as the topic names it, or its session where none does.
        payload: its bytes, or their number where there are too many to be read; None where only its fields are known.
        at: monotonic s at receipt.
        network: where it was received.
        codec: of that network.
    """

    event: str
    source: str
    payload: bytes | int | None
    at: float
    network: str = ""
    codec: StopCodec = JSON_RPC
