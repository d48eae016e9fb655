"""Links that carry stops: their protocol, which each network supplies, and queue.

A network gives the e-stop listener a :class:`StopLink`, and a :class:`StopCodec` where its emergency stops are no
JSON-RPC notifications.
"""

from __future__ import annotations

import json
import secrets
import time
import uuid
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from strands_robots.safety.orders import StopOrder, StopRefused, StopRules, params_of, stated_epoch

if TYPE_CHECKING:
    from strands_robots.safety.reporting import StopRun

ESTOP = "emergencyStop"
VERDICT = "emergencyStopVerdict"
CHECK_IN = "safetyCheckIn"
CHECK_IN_ANSWER = "safetyCheckInAnswer"
QUESTION = "missedStops"
ANSWER = "missedStopsAnswer"
STOP_ROSTER = "stopRoster"
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

    fields: Callable[[bytes | int | None], Mapping[str, Any]] = staticmethod(params_of)
    """Returns the fields of a message; empty for what is none or is too long to be read."""

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
        """Return True where each stop that counts is signed."""
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


BUCKETS, BUCKET_CAPACITY = 64, 16
LATER_EVERY = 8
"""Of so many events that are taken from a full bucket one is not urgent, so that a flood of stops starves none."""

VOUCHED_MAX = 16
"""Sources with a share of their own in the queue: the first that signed validly."""


class _Bucket:
    """Events of the sources that share it: stops, and what is not urgent.

    Only the queue's one reader takes; appending is atomic.
    """

    __slots__ = ("later", "taken", "urgent")

    def __init__(self, capacity: int) -> None:
        self.urgent: deque[StopEvent] = deque(maxlen=capacity)
        self.later: deque[StopEvent] = deque(maxlen=capacity // 2)
        self.taken = 0


class _Share:
    """Buckets that are served in turn."""

    __slots__ = ("buckets", "turn")

    def __init__(self, buckets: Iterable[_Bucket] = ()) -> None:
        self.buckets = tuple(buckets)
        self.turn = 0


class FairQueue:
    """Bounded queue of events for one reader: fair between sources, newest first.

    A flood of forged stops must not delay a true one. Sources share a fixed number of buckets by a keyed hash; buckets
    are served in turn, one event each, the newest stop first. What overflows a bucket is its oldest stop; a controller
    repeats its stop, so a true one arrives again. A source that was vouched for has a bucket of its own, and every
    second turn is of such a one: names that are made up share the other turns. No method blocks or takes a lock.

    Args:
        buckets: number of those that all sources share.
        capacity: of a bucket, in stops; of others it holds half as many.

    Attributes:
        displaced: a stop took the place of an older one since :meth:`clear`.
    """

    def __init__(self, buckets: int = BUCKETS, capacity: int = BUCKET_CAPACITY) -> None:
        self._salt = secrets.token_hex(8)
        self._capacity = capacity
        self._crowd, self._signed = _Share(_Bucket(capacity) for _ in range(buckets)), _Share()
        self._vouched: dict[str, _Bucket] = {}
        self._crowd_next = False
        self.displaced = False

    def vouch(self, source: str) -> None:
        """Give a source that signed validly a bucket of its own."""
        if source not in self._vouched and len(self._vouched) < VOUCHED_MAX:
            bucket = self._vouched[source] = _Bucket(self._capacity)
            self._signed.buckets = (*self._signed.buckets, bucket)

    def vouched_for(self, source: str) -> bool:
        """Return True when this source has a bucket of its own."""
        return source in self._vouched

    def put(
        self,
        event: str,
        source: str,
        payload: bytes | int,
        *,
        urgent: bool = True,
        network: str = "",
        codec: StopCodec = JSON_RPC,
    ) -> None:
        """Add an event; of those that are not urgent, a full bucket drops the new."""
        received = StopEvent(event, source, payload, time.monotonic(), network, codec)
        bucket = self._vouched.get(source)
        if bucket is None:
            # Within one text: the hash of a pair keeps the same names together whatever the salt.
            bucket = self._crowd.buckets[hash(self._salt + source) % len(self._crowd.buckets)]
        # Adding to a bucket is atomic.
        if urgent:
            self.displaced = self.displaced or len(bucket.urgent) == self._capacity
            bucket.urgent.append(received)
        elif len(bucket.later) < self._capacity // 2:
            bucket.later.append(received)

    def take(self) -> StopEvent | None:
        """Return the next event, of the crowd and of vouched sources in turn."""
        self._crowd_next = not self._crowd_next
        for share in (self._crowd, self._signed) if self._crowd_next else (self._signed, self._crowd):
            buckets = share.buckets
            for _ in buckets:
                share.turn = (share.turn + 1) % len(buckets)
                bucket = buckets[share.turn]
                if not (bucket.urgent or bucket.later):
                    continue
                bucket.taken += 1
                if bucket.later and (not bucket.urgent or bucket.taken % LATER_EVERY == 0):
                    return bucket.later.popleft()
                return bucket.urgent.pop()
        return None

    def clear(self) -> None:
        """Forget what waits."""
        for bucket in (*self._crowd.buckets, *self._signed.buckets):
            bucket.urgent.clear()
            bucket.later.clear()
        self.displaced = False
