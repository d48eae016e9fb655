"""Zenoh as a transport: one session a process, and a hub on loopback."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import count
from typing import Any

from strands_robots.mesh import topics, wire
from strands_robots.mesh.transport import Callback, LivenessCallback, Sample, Transport, TransportError, config
from strands_robots.mesh.transport.config import Posture
from strands_robots.utils import missing_extra
from strands_robots.zenoh_session import StopSession, close_in_background, direct

logger = logging.getLogger(__name__)

OPEN_S = 5.0
DIAL_MS = 300
"""Milliseconds in which a hub on loopback has to answer a caller that never becomes one."""

RESCUE_EVERY_S = 0.1
STEADY_LOOKS = 10
PUBLISHERS_MAX = 4096
"""Keys with a declared publisher: several for each robot of the process, and one for each peer that is asked."""


class ZenohTransport(Transport):
    """A Zenoh session as a transport.

    Without stated endpoints the first process of the machine is the hub on the loopback port and the others are
    its clients. When the hub dies, the survivors race for the port: the process that binds it relays for the
    others, and no session is reopened, so every subscriber and every session id stays.

    Args:
        posture: endpoints and certificates; the environment's by default.
    """

    stops_apart = True

    def __init__(self, posture: Posture | None = None) -> None:
        self._posture = posture
        self._id, self._stops_id = (secrets.token_hex(16).lstrip("0") or "1" for _ in range(2))
        self._stops: StopSession | None = None
        self._session: Any = None
        self._relay: Any = None
        self._zenoh: Any = None
        self._links: Any = None
        self._hub = False
        self._lost_link_at = -math.inf
        self.links_up = 0
        """Number of links to other sessions."""
        self._links_lost = self._links_back = 0
        self._cut, self._rejoined = False, 0
        self._numbers = count()
        self._publishers: dict[str, tuple[Any, Any]] = {}
        self._closing = threading.Event()
        self._rescuing = threading.Lock()
        self._lock = threading.Lock()

    @property
    def session(self) -> Any:
        """The ``zenoh.Session``, None while closed."""
        return self._session

    @property
    def session_id(self) -> str | None:
        return self._id if self._session is not None else None

    @property
    def posture(self) -> Posture | None:
        """The posture that the session was opened with; None before it is known."""
        return self._posture

    def connect(self) -> None:
        with self._lock:
            if self._session is not None:
                return
            try:
                import zenoh  # noqa: PLC0415 - an optional dependency, loaded when it is used
            except ImportError:
                raise missing_extra("The Zenoh mesh", "mesh") from None
            self._zenoh = zenoh
            posture = self._posture = self._posture or Posture.from_settings()
            self._closing.clear()
            self._hub, self.links_up, self._links_lost, self._cut = False, 0, 0, False
            if posture.hub is None:
                self._session = self._open(config.explicit(posture, self._id))
            else:
                self._session = self._open_on_loopback(posture)
            self._watch_links(self._session, of_hub=posture.hub is not None and not self._hub)
            if posture.credentials is None:
                logger.info("The mesh runs without certificates, on this machine alone or by the operator's opt-in.")

    def close(self) -> None:
        self._close_stops()
        self._closing.set()
        with self._lock:
            session, relay, links = self._session, self._relay, self._links
            self._session = self._relay = self._links = None
            publishers, self._publishers = self._publishers, {}
        for publisher, _ in publishers.values():
            with contextlib.suppress(*self.errors()):  # closing the session takes it along anyway
                publisher.undeclare()
        if links is not None:
            with contextlib.suppress(*self.errors()):  # likewise
                links.undeclare()
        for each in (session, relay):
            if each is not None:
                each.close()
        with self._rescuing:  # a rescue that was under way has seen the closing flag when this is free
            late, self._relay = self._relay, None
        if late is not None:
            late.close()

    def is_alive(self) -> bool:
        session = self._session
        return session is not None and not session.is_closed()

    def linked(self) -> bool:
        """True while any other Zenoh session is connected to ours."""
        session = self._session
        if session is None:
            return False
        return bool(session.info.peers_zid() or session.info.routers_zid())

    def anchored(self) -> bool:
        # Where we listen ourselves, others link to us; a client depends on the hub.
        posture = self._posture
        listens = self._hub or (posture is not None and bool(posture.listen))
        return listens or self.linked()

    def take_part(self) -> None:
        dialled, self.dials_only = self.dials_only, False
        posture = self._posture
        if dialled and posture is not None and posture.hub is not None and not self.anchored():
            threading.Thread(target=self._rescue, name="mesh-rescue", daemon=True).start()

    def lost_link_at(self) -> float | None:
        return self._lost_link_at

    def links_back(self) -> int:
        return self._links_back

    def rejoined(self) -> int:
        return self._rejoined

    def put(self, key: str, payload: bytes | Mapping[str, Any]) -> None:
        topic = topics.topic_of(key)
        data = payload if isinstance(payload, bytes) else wire.encode(payload, topic.max_bytes)
        if len(data) > topic.max_bytes:
            raise wire.TooLargeError(f"{key}: a message of {len(data)} bytes is above the topic's {topic.max_bytes}.")
        try:
            if topic.name == "response":
                self._put_once(key, data)
                return
            publisher, source = self._publishers.get(key) or self._publisher(key, topic)
            publisher.put(data, source_info=self._zenoh.SourceInfo(source, next(self._numbers) & 0xFFFFFFFF))
        except self.errors() as exc:
            raise TransportError(f"{key}: {exc}") from None

    def declare_subscriber(self, key: str, callback: Callback) -> Any:
        deliver = self._deliverer(key, callback)
        return self._declare(lambda session, handler: session.declare_subscriber(key, handler), deliver, key)

    @property
    def stops_up(self) -> bool:
        stops = self._stops
        return stops is not None and stops.up

    def open_stops(
        self, on_stop: Callable[[str, bytes], None], on_check_in: Callback | None = None
    ) -> Callable[[], None]:
        posture = self._posture
        if self._stops is not None or posture is None or not config.stops_through(posture):
            return lambda: None
        self._stops = stops = StopSession(lambda: config.stops(posture, self._stops_id))
        most, put = topics.BY_NAME["estop"].max_bytes, self._zenoh.SampleKind.PUT

        def on_message(sample: Any) -> None:
            source, payload = sample.source_info, sample.payload
            if sample.kind == put and len(payload) <= most:
                on_stop("" if source is None else str(source.source_id.zid), payload.to_bytes())

        keys: dict[str, Callable[[Any], None]] = {topics.estop(): on_message}
        if on_check_in is not None:
            keys[topics.check_in("*")] = self._deliverer(topics.check_in("*"), on_check_in)
        stops.start(keys, lambda up: None)
        return self._close_stops

    def put_stop(self, key: str, payload: Mapping[str, Any]) -> bool:
        stops, session = self._stops, self._session
        if stops is None or session is None or not stops.up:
            return False
        source = self._zenoh.SourceInfo(session.id, next(self._numbers) & 0xFFFFFFFF)
        data = wire.encode(payload, topics.topic_of(key).max_bytes)
        return stops.put(key, data, answer=False, source=source)

    def _close_stops(self) -> None:
        stops, self._stops = self._stops, None
        if stops is not None:
            stops.close()

    def _deliverer(self, key: str, callback: Callback) -> Callable[[Any], None]:
        def deliver(sample: Any) -> None:
            if sample.kind != self._zenoh.SampleKind.PUT:
                return
            source, name = sample.source_info, str(sample.key_expr)
            session = str(source.source_id.zid) if source is not None else None
            try:
                if len(sample.payload) > topics.topic_of(name).max_bytes:
                    logger.debug("%s: a message of %d bytes was dropped unread.", name, len(sample.payload))
                    return
                callback(Sample(name, sample.payload.to_bytes(), session))
            except Exception:
                logger.exception("A subscriber of %s failed.", key)

        return deliver

    def declare_token(self, key: str) -> Any:
        session = self._require()
        try:
            return session.liveliness().declare_token(key)
        except self.errors() as exc:
            raise TransportError(f"{key}: {exc}") from None

    def watch_tokens(self, key: str, callback: LivenessCallback) -> Any:
        def deliver(sample: Any) -> None:
            try:
                callback(str(sample.key_expr), sample.kind == self._zenoh.SampleKind.PUT)
            except Exception:
                logger.exception("A watcher of %s failed.", key)

        def declare(session: Any, handler: Any) -> Any:
            return session.liveliness().declare_subscriber(key, handler, history=True)

        return self._declare(declare, deliver, key)

    def errors(self) -> tuple[type[BaseException], ...]:
        """Exception types that Zenoh raises for a fault of the transport."""
        return (self._zenoh.ZError,) if self._zenoh is not None else (TransportError,)

    def _require(self) -> Any:
        session = self._session
        if session is None:
            raise TransportError("the Zenoh session is closed.")
        return session

    def _declare(self, declare: Any, deliver: Any, key: str) -> Any:
        session = self._require()
        try:
            # On Zenoh's own thread: a stop must not overtake a motion that waits for another one.
            return declare(session, direct(deliver))
        except self.errors() as exc:
            raise TransportError(f"{key}: {exc}") from None

    def _put_once(self, key: str, data: bytes) -> None:
        """Publish on a key that is used once, without declaring a publisher."""
        zenoh, session = self._zenoh, self._require()
        session.put(
            key,
            data,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            express=True,
            source_info=zenoh.SourceInfo(session.id, next(self._numbers) & 0xFFFFFFFF),
        )

    def _publisher(self, key: str, topic: topics.Topic) -> tuple[Any, Any]:
        zenoh = self._zenoh
        session = self._require()
        publisher = session.declare_publisher(
            key,
            # A peer that stopped reading must not delay the messages to the others.
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.INTERACTIVE_HIGH if topic.urgent else zenoh.Priority.DATA,
            express=topic.urgent,
        )
        declared = (publisher, publisher.id)
        with self._lock:
            while len(self._publishers) >= PUBLISHERS_MAX:
                # Zenoh undeclares it with the last reference: another thread may publish with it at this moment.
                del self._publishers[next(iter(self._publishers))]
            self._publishers[key] = declared
        return declared

    def _open(self, config: dict[str, Any]) -> Any:
        try:
            return self._zenoh.open(self._zenoh.Config.from_json5(json.dumps(config)))
        except self._zenoh.ZError as exc:
            raise TransportError(f"Zenoh session: {exc}") from None

    def _open_on_loopback(self, posture: Posture) -> Any:
        if self.dials_only:
            return self._dial(posture)
        deadline = time.monotonic() + OPEN_S
        while True:
            with contextlib.suppress(TransportError):  # another process is the hub
                session = self._open(config.hub(posture, self._id))
                self._hub = True
                logger.info("This process is the mesh's hub on %s.", posture.hub)
                return session
            try:
                session = self._open(config.child(posture, self._id))
            except TransportError as exc:
                if time.monotonic() < deadline:
                    continue  # the hub died in between, or is coming up
                raise TransportError(
                    f"{posture.hub} is taken and no mesh of ours answers there ({exc}); set STRANDS_MESH_PORT."
                ) from None
            return session

    def _dial(self, posture: Posture) -> Any:
        try:
            return self._open(config.child(posture, self._id, DIAL_MS))
        except TransportError:
            if posture.multicast:
                # The hubs of other machines are found later, if at all, and so is one that this machine gets.
                return self._open(config.explicit(replace(posture, connect=(str(posture.hub),)), self._id))
            raise TransportError(f"no mesh answers on {posture.hub}.") from None

    def _watch_links(self, session: Any, *, of_hub: bool) -> None:
        def changed(event: Any) -> None:
            if str(event.transport.zid) == self._stops_id:
                return  # our own second session, by which no other process is reached
            if event.kind == self._zenoh.SampleKind.PUT:
                close_in_background()
                self.links_up += 1
                self._rejoined, self._cut = self._rejoined + self._cut, False
                if self._links_lost:
                    self._links_lost -= 1
                    self._links_back += 1
                return
            self.links_up, self._links_lost = self.links_up - 1, self._links_lost + 1
            self._cut = self._cut or self.links_up <= 0
            if of_hub and not self._closing.is_set():
                self._lost_link_at = time.monotonic()
                threading.Thread(target=self._rescue, name="mesh-rescue", daemon=True).start()

        self._links = session.info.declare_transport_events_listener(direct(changed), history=True)

    def _rescue(self) -> None:
        """Try to become the hub until our session is linked to one again."""
        if not self._rescuing.acquire(blocking=False):
            return
        try:
            posture, steady = self._posture, 0
            # The lost link may still be listed for a moment, so only a link that lasts ends this.
            while posture is not None and not self._closing.is_set() and steady < STEADY_LOOKS:
                steady = steady + 1 if self.linked() else 0
                if steady == 0 and self._relay is None and not self.dials_only:
                    with contextlib.suppress(TransportError):  # another survivor was quicker
                        self._relay = self._open(config.hub(posture))
                        logger.warning("The mesh's hub is gone; this process relays on %s now.", posture.hub)
                self._closing.wait(RESCUE_EVERY_S)
        finally:
            self._rescuing.release()
        if not self._closing.is_set() and not self.linked():
            self._rescue()  # the link went again after the last look
