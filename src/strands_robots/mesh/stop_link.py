"""Emergency stops as a process receives them, and its questions for missed ones.

Stops and check-ins arrive on a Zenoh session of their own. Its callbacks hand stops over to the e-stop listener's
thread, so nothing that the presence session has queued is before them. Zenoh reads all sessions of a process with the
same few threads: a callback of the presence session hands over as well, and waits for nothing. That session is the
second way of stops, and the only one over MQTT and in memory. A repetition is known by its epoch.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any, ClassVar, Protocol

from strands_robots.envelope import Envelope, error
from strands_robots.mesh import session, topics, wire
from strands_robots.mesh.safety_adapter import SafetyAdapter
from strands_robots.mesh.scheduler import repeat
from strands_robots.mesh.session import Context
from strands_robots.mesh.transport import Declaration, Sample, Transport, TransportError, undeclare
from strands_robots.rate_limits import RecentKeys
from strands_robots.safety.estop_listener import EstopListener, ListenerRegistration, estop_listener
from strands_robots.safety.lockout import is_epoch
from strands_robots.safety.missed_stops import ANSWER_MAX_BYTES
from strands_robots.safety.orders import (
    MISSED,
    NO_REASON,
    StopOrder,
    StopRefused,
    StopRules,
    derived_epoch,
    stated_reason,
)
from strands_robots.safety.plane import SafetyPlane, plane
from strands_robots.safety.reporting import StopRun
from strands_robots.safety.scope import EVERY_ROBOT, SCOPE
from strands_robots.safety.statements import Purpose
from strands_robots.safety.stop_link import ANSWER, ESTOP, QUESTION, OnEvent, OnState, StopCodec, StopEvent
from strands_robots.threads import BoundedExecutor

logger = logging.getLogger(__name__)

LOOK_HZ = 5.0
"""Looks a second for a link that came back."""

COMMANDED = "command"
"""``path`` of a stop that came in a ``stop`` for one peer."""

COPY_S = 0.5
"""Seconds in which a stop with the same time is a copy of the other connection's, and no repetition."""

RECENT_MAX = 512

TOPICS = {QUESTION: topics.missed_ask, ANSWER: topics.missed_answer}


class MeshStopLink:
    """Stop link of the peers of one session, which carries the missed stops itself.

    Args:
        checks_in: the robots need a live controller, whose check-ins ``on_check_in`` takes.
    """

    def __init__(self, transport: Transport, *, checks_in: bool, on_check_in: Callable[[Sample], None]) -> None:
        self._transport = transport
        self._on_check_in = on_check_in if checks_in else None
        self._declared: list[Declaration] = []
        self._links_back, self._rejoined, self._refused = transport.links_back(), transport.rejoined(), False
        self._on_state: OnState = lambda up: None
        self.on_stop: Callable[[str, bytes], None] = lambda sender, payload: None
        """Hands a stop, with its sender's session, to the e-stop listener's thread."""
        self._end_looks: Callable[[], None] = lambda: None
        self._connecting = threading.Lock()
        self._close_stops: Callable[[], None] | None = None

    @property
    def up(self) -> bool:
        return self._transport.stops_up

    def open(self, events: Collection[str], on_event: OnEvent, on_state: OnState) -> None:
        transport, self._on_state = self._transport, on_state

        def handler(event: str) -> Callable[[Sample], None]:
            return lambda sample: on_event(event, sample.key.split("/", 2)[1], sample.payload)

        callbacks = {topic("*"): handler(event) for event, topic in TOPICS.items()}
        if self._on_check_in is not None:
            callbacks[topics.check_in("*")] = self._on_presence_check_in
        # No topic names who stops: until the message is read, a session stands for its sender.
        self.on_stop = partial(on_event, ESTOP)
        try:
            for key, callback in callbacks.items():
                self._declared.append(transport.declare_subscriber(key, callback))
        except TransportError:
            self.close()
            raise
        on_state(True)
        self._end_looks = repeat("missed stops", LOOK_HZ, self._look)

    def connect(self) -> None:
        """Open the connection for stops and check-ins; return at once. Twice is once."""
        with self._connecting:
            if self._close_stops is None:
                self._close_stops = self._transport.open_stops(self.on_stop, self._on_check_in)

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        try:
            self._transport.put(TOPICS[event](source), payload)
        except (TransportError, wire.WireError):
            return False
        return True

    def close(self) -> None:
        self._end_looks()
        undeclare(self._declared)
        self._declared.clear()
        with self._connecting:
            close, self._close_stops = self._close_stops, None
        if close is not None:
            close()

    def _on_presence_check_in(self, sample: Sample) -> None:
        # A signed check-in counts once: its second copy would be refused as one played again.
        if self._on_check_in is not None and (sample.sessionless or not self.up):
            self._on_check_in(sample)

    def _look(self) -> None:
        """Ask where a link came back or stops can be received again.

        Motions hold where no link was left. Where others stayed, the one that came back may be that of a stranger.
        """
        # Read first: a link that comes back between the two asks again.
        rejoined, back = self._transport.rejoined(), self._transport.links_back()
        refused = topics.estop() in self._transport.refusals()
        if rejoined != self._rejoined or (self._refused and not refused):
            self._on_state(False)
            self._on_state(True)
        elif back != self._links_back:
            self._on_state(True)
        self._links_back, self._rejoined, self._refused = back, rejoined, refused


class MeshStopCodec(StopCodec):
    """Emergency stops of the mesh: objects on one topic.

    They state their issuer and its session. Peers are asked for their verdicts by a ``stop``; they do not publish them.
    """

    names_source = False
    answers = False

    def __init__(self, stops: PeerStops) -> None:
        self._stops = stops

    def encode(self, event: str, fields: Mapping[str, Any]) -> bytes:
        return wire.encode(fields, topics.BY_NAME["missed_answer"].max_bytes)

    def fields(self, payload: bytes | int | None) -> Mapping[str, Any]:
        try:
            return wire.decode(payload, ANSWER_MAX_BYTES) if isinstance(payload, bytes) else {}
        except wire.WireError:
            return {}

    def epoch(self, source: str, fields: Mapping[str, Any]) -> str:
        """Return the id of a stop, else an epoch of its issuer and time."""
        stated, at = fields.get("estop_id"), fields.get("t")
        if is_epoch(stated):
            return str(stated)
        return derived_epoch(source, json.dumps(at).encode()) if wire.finite(at) is not None else ""

    def order(
        self, rules: StopRules, stop: StopEvent, fields: Mapping[str, Any], path: str, age_s: float = 0.0
    ) -> StopOrder | StopRefused | None:
        # The mesh's own rules: an unsigned stop counts unless signatures are demanded.
        stops, rules, missed = self._stops, self._stops.rules, path == MISSED
        try:
            source, at = wire.issuer_of(fields)
        except wire.WireError as exc:
            return StopRefused("", str(exc))
        if missed and source != stop.source:
            return StopRefused(source, "another peer issued it")
        if not missed and fields.get("source_zid") != (stop.source or None):
            return StopRefused(source, wire.OTHER_SESSION)
        if path not in (MISSED, COMMANDED) and source in stops.peers and stop.source == stops.session:
            return None
        why = rules.source_refusal(source)
        if why is None and (missed or rules.required):
            why = _unproven(rules, source, fields)
        if why is not None:
            return StopRefused(source, why)
        estop_id = fields.get("estop_id")
        return StopOrder(
            str(estop_id) if is_epoch(estop_id) else self.epoch(source, fields),
            source,
            stated_reason(fields) or NO_REASON,
            path,
            remote=True,
            issued=at,
            received=stop.at,
            pressed=wire.finite(fields.get("pressed_at")),
            scope=rules.scope(source, fields, demanded=rules.required) if SCOPE in fields else EVERY_ROBOT,
            # A console passes on what it sent, and nothing of others.
            original=stop.payload if stops.has_robots and isinstance(stop.payload, bytes) else None,
            network=stop.network,
            age_s=age_s,
        )

    def vouches(self, rules: StopRules) -> bool:
        # Where there is one way only, each signature is checked, however many fail.
        return self._stops.rules.required and self._stops.has_link

    def refused(self, refused: StopRefused) -> bool:
        self._stops.refused(refused)
        return True

    def begun(self, order: StopOrder, fields: Mapping[str, Any], run: StopRun | None) -> None:
        self._stops.begun(order, fields, run)


class StopPeer(Protocol):
    """A peer of this process that stops are for."""

    context: Context
    adapter: SafetyAdapter

    def issued(self, epoch: str) -> None:
        """Note the latest stop of every robot."""

    def resumed_since(self, epoch: str) -> bool:
        """Return True for a stop that the broker stored with its resume."""

    def on_check_in(self, sample: Sample) -> None:
        """Record the check-in of a controller."""

    def begun(self, order: StopOrder, fields: Mapping[str, Any], *, repeated: bool) -> None:
        """Note a stop whose halts are ordered; return at once."""


class PeerStops:
    """Receiver of the stops for the peers of a process on one session.

    Args:
        of: the plane that stops their robots.
        rules: by which stops count.
    """

    _all: ClassVar[dict[tuple[Transport, SafetyPlane], PeerStops]] = {}
    _joining: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, transport: Transport, of: SafetyPlane, rules: StopRules) -> None:
        self._transport, self._plane, self.rules = transport, of, rules
        self._listener = estop_listener() if of is plane() else EstopListener(of)
        self.codec = MeshStopCodec(self)
        self.network = session.network()
        self.peers: Mapping[str, StopPeer] = {}
        self.session = transport.session_id or ""
        self.has_robots = False
        """True where a peer of this process has a robot."""
        self._notes = BoundedExecutor("mesh-stops", RECENT_MAX)
        self._registered: dict[str, ListenerRegistration] = {}
        self._link: MeshStopLink | None = None
        self._subscription: Declaration | None = None
        self._sendings = RecentKeys(COPY_S, RECENT_MAX)

    @classmethod
    def joined_by(cls, peer: StopPeer) -> PeerStops:
        """Return that of a peer's session; a robot has its own connection opened.

        Raises:
            TransportError: the peer is not on the mesh.
        """
        transport = peer.context.transport
        if transport is None:
            raise TransportError("the mesh is not running.")
        key = (transport, peer.adapter.plane)
        with cls._joining:
            stops = cls._all.get(key) or cls(*key, peer.adapter.rules)
            stops._set_peers({**stops.peers, peer.context.peer_id: peer})
            before = stops._subscription
            # Declared anew for each peer: a broker then sends the stop that it stored once more.
            stops._subscription = transport.declare_subscriber(topics.estop(), stops.on_estop)
            cls._all[key] = stops
        if before is not None:
            undeclare([before])
        if peer.adapter.has_robot:
            if transport.stops_apart:
                # The thread that takes stops must start none of its own.
                stops._notes.prepare()
            try:
                stops.connect(peer)
            except TransportError:
                stops.left_by(peer)
                raise
        return stops

    def open(self, peer: StopPeer) -> None:
        """Have the e-stop listener serve a peer, also with what it has sent; twice is once.

        Raises:
            TransportError: the peer is not on the mesh.
        """
        name, adapter = peer.context.peer_id, peer.adapter
        if name in self._registered:
            return  # without a wait: a stop is being sent
        with self._joining:
            if name in self._registered:
                return
            self._registered[name] = registration = self._listener.register(
                name,
                (self._transport, self._plane),
                lambda: MeshStopLink(self._transport, checks_in=adapter.needs_check_in, on_check_in=self._on_check_in),
                adapter.own_identity,
                network=self.network,
                was_here=adapter.was_here_s is not None,
                codec=self.codec,
                opened=False,
                asks=adapter.has_robot,
            )
            self._link = registration.link if isinstance(registration.link, MeshStopLink) else None
        try:
            registration.open()
        except TransportError:
            # The next stop or check-in opens it anew.
            with self._joining:
                self._registered.pop(name, None)
                registration.close()
            raise

    def connect(self, peer: StopPeer) -> None:
        """Have a connection for stops alone; as :meth:`open` besides."""
        self.open(peer)
        link = self._link
        if link is not None:
            link.connect()

    def left_by(self, peer: StopPeer) -> None:
        """Receive no more for a peer; the last ends the subscriptions."""
        name = peer.context.peer_id
        with self._joining:
            self._set_peers({other: each for other, each in self.peers.items() if other != name})
            registration = self._registered.pop(name, None)
            last = not self.peers and self._all.pop((self._transport, self._plane), None) is not None
            subscription, self._subscription = self._subscription, None if last else self._subscription
            if registration is not None:
                # Who joins meanwhile gets a link of its own, and not the end of this one.
                registration.close()
        if last:
            undeclare([] if subscription is None else [subscription])
            self._notes.close()

    @property
    def has_link(self) -> bool:
        """True while stops also arrive on a connection of their own."""
        return self._transport.stops_up

    def on_estop(self, sample: Sample) -> None:
        """Receive a stop on the presence session; on return all robots are locked and halting."""
        peers = self.peers
        if not sample.payload or not peers:
            return  # a broker's stored stop was cleared
        fields = self.codec.fields(sample.payload)
        if sample.retained:
            issuer = str(fields.get("peer_id"))
            epoch = self.codec.epoch(issuer, fields)
            if any(each.resumed_since(epoch) for each in peers.values()):
                self._audit("remote_estop_redundant", issuer, estop_id=epoch, reason="resumed since")
                return
        stop = StopEvent(ESTOP, sample.session or "", sample.payload, time.monotonic(), self.network.text, self.codec)
        self._listener.accept(stop, "mesh", fields, only_way=sample.sessionless)

    def publish(self, key: str, body: Mapping[str, Any]) -> bool:
        """Publish on the connection for stops; False where that is not up.

        It states the presence session, as it does there: peers of a 0.5 release refuse a stop of any other.
        """
        with contextlib.suppress(TransportError, wire.WireError):  # the other connection carries it, or says why not
            return self._transport.put_stop(key, body)
        return False

    def refused(self, refused: StopRefused) -> None:
        """Record a stop that does not count."""
        self._audit("estop_rejected", refused.source, reason=refused.why)

    def begun(self, order: StopOrder, fields: Mapping[str, Any], run: StopRun | None) -> None:
        """Note a stop whose halts are ordered; the listener's thread does not wait."""
        if self.has_link:
            # Its halts are being carried out at this moment, on other threads.
            self._notes.submit(partial(self._note, order, fields, repeated=run is None))
        else:
            self._note(order, fields, repeated=run is None)

    def _note(self, order: StopOrder, fields: Mapping[str, Any], *, repeated: bool) -> None:
        copied = not self._sendings.first((order.epoch, order.issued)) and self.has_link
        if order.scope.everything:
            for each in self.peers.values():
                each.issued(order.epoch)
        if not (repeated and copied):
            for each in self._speaker():
                each.begun(order, fields, repeated=repeated)

    def _on_check_in(self, sample: Sample) -> None:
        for each in self.peers.values():
            if each.adapter.has_robot:
                each.on_check_in(sample)

    def _audit(self, event: str, about: str, **payload: Any) -> None:
        for each in self._speaker():
            each.context.audit(event, about, **payload)

    def _set_peers(self, peers: Mapping[str, StopPeer]) -> None:
        self.peers = peers
        self.has_robots = any(each.adapter.has_robot for each in peers.values())

    def _speaker(self) -> list[StopPeer]:
        """Return the peer that records and passes on for all, if any is left."""
        return sorted(self.peers.values(), key=lambda each: not each.adapter.has_robot)[:1]


class Hearing:
    """Latch on motion while the network refuses us the topic of emergency stops.

    Args:
        halt: stops what moves, with the reason; called when the topic is refused.
    """

    def __init__(self, context: Context, halt: Callable[[str], None]) -> None:
        self._context = context
        self._halt = halt
        self._problem = ""

    def refusal(self, verb: str) -> Envelope | None:
        """Return the refusal of ``verb`` while no emergency stop can arrive, or None."""
        if not self._problem:
            return None
        peer = self._context.peer_id
        return error(f"{verb} is refused: {peer} cannot receive emergency stops: {self._problem}.", robot=peer)

    def facts(self) -> dict[str, Any]:
        """Return ``estop_unheard`` with the reason while there is one."""
        return {"estop_unheard": self._problem} if self._problem else {}

    def look(self) -> None:
        """Compare with the transport; try a refused subscription again."""
        transport = self._context.transport
        if transport is None:
            return
        problem = transport.refusals().get(topics.estop(), "")
        known, self._problem = self._problem, problem
        peer = self._context.peer_id
        if problem and not known:
            logger.critical("%s CANNOT RECEIVE EMERGENCY STOPS and does not move: %s.", peer, problem)
            self._context.audit.always("estop_unheard", reason=problem)
            self._halt("it cannot receive emergency stops")
        elif known and not problem:
            logger.warning("%s receives emergency stops again.", peer)
            self._context.audit.always("estop_heard")
        transport.subscribe_again()


def _unproven(rules: StopRules, source: str, fields: Mapping[str, Any]) -> str | None:
    """Return the reason why the signature on a stop is not enough, or None.

    Where unsigned stops count, that is one which another peer passes on: its source is proven by a signature alone, and
    need not be where any source may stop.
    """
    why = rules.signature_refusal(source, fields, Purpose.EMERGENCY_STOP)
    if rules.required:
        return why
    proven = why is None and rules.signed
    return None if proven or rules.open else why or "it is unsigned, and not every source may stop"
