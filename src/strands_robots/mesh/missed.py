"""Missed emergency stops on the mesh: its topics, its links and its envelopes."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from strands_robots.mesh import session, topics, wire
from strands_robots.mesh.context import Context
from strands_robots.mesh.safety_adapter import SafetyAdapter
from strands_robots.mesh.scheduler import repeat
from strands_robots.mesh.transport import Declaration, Sample, Transport, TransportError, undeclare
from strands_robots.safety.estop_listener import Member, RobotsPort, Stated
from strands_robots.safety.missed_stops import ANSWER_MAX_BYTES, PEER_BACK, MissedStops
from strands_robots.safety.orders import MISSED, NO_REASON, StopOrder, StopRefused, derived_epoch, stated_reason
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.process import AWAKE
from strands_robots.safety.statements import Purpose
from strands_robots.safety.stop_link import ANSWER, QUESTION

LOOK_HZ = 5.0
"""Looks a second for a link that came back."""

TOPICS = {QUESTION: topics.missed_ask, ANSWER: topics.missed_answer}


class MeshPort(RobotsPort):
    """The peers of a process on one session.

    Args:
        adapter: of any of them, for the plane and the rules that all of them share.
        peers: returns them by name.
        transport: of the session.
    """

    def __init__(
        self, adapter: SafetyAdapter, peers: Callable[[], Mapping[str, SafetyAdapter]], transport: Transport
    ) -> None:
        def members() -> list[Member]:
            return [
                Member(name, name, each.own_identity, each.was_here_s is not None) for name, each in peers().items()
            ]

        def publish(event: str, source: str, fields: Mapping[str, Any]) -> bool:
            try:
                transport.put(TOPICS[event](source), fields)
            except (TransportError, wire.WireError):
                return False
            return True

        self._adapter, self._peers = adapter, peers
        network = session.network()
        super().__init__(
            adapter.plane, adapter.rules, network, members=members, publish=publish, on_report=lambda report: None
        )

    def devices(self) -> Sequence[str]:
        return [name for name, each in self._peers().items() if each.moves]

    def learn(self, source: str, payload: bytes, age_s: float, answerer: str) -> bool:
        try:
            body = wire.decode(payload, topics.BY_NAME["estop"].max_bytes)
            notice = wire.EstopNotice.of(body)
        except wire.WireError:
            return False
        epoch = epoch_of(notice, body)
        if notice.peer_id != source or self._rules.source_refusal(source) is not None:
            return False
        return self.lock(
            epoch, lambda: self._decide(notice, epoch, body, payload, age_s), Stated(payload, age_s, answerer)
        )

    def _decide(
        self, notice: wire.EstopNotice, epoch: str, body: Mapping[str, Any], payload: bytes, age_s: float
    ) -> StopOrder | StopRefused:
        rules, source = self._rules, notice.peer_id
        why = rules.signature_refusal(source, body, Purpose.EMERGENCY_STOP)
        # Whoever passes on an unsigned stop is not its source: that counts where any source may stop.
        if (why is not None or not rules.signed) and (rules.required or not rules.open):
            return StopRefused(source, why or "it is unsigned, and not every source may stop")
        return StopOrder(
            epoch,
            source,
            stated_reason(body) or NO_REASON,
            MISSED,
            remote=True,
            issued=notice.t,
            received=time.monotonic(),
            pressed=wire.finite(body.get("pressed_at")),
            scope=self._adapter.scope(source, body),
            original=payload,
            network=self._network,
            age_s=age_s,
        )


class MeshMissedStops:
    """Asker and answerer on one session; the peers of a process share it."""

    _all: ClassVar[dict[tuple[Transport, SafetyPlane], MeshMissedStops]] = {}
    _joining: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, transport: Transport, adapter: SafetyAdapter) -> None:
        self._transport = transport
        self._peers: dict[str, SafetyAdapter] = {}
        self._links_back, self._rejoined, self._refused = transport.links_back(), transport.rejoined(), False
        self._missed = MissedStops(MeshPort(adapter, lambda: self._peers, transport), parse=_fields_of)
        self._declared: list[Declaration] = []
        self._end_watch: Callable[[], None] = lambda: None
        self._end_looks: Callable[[], None] = lambda: None

    @classmethod
    def joined_by(cls, context: Context, adapter: SafetyAdapter) -> MeshMissedStops:
        """Return that of a peer's session; a robot that was here lately asks.

        Raises:
            TransportError: the peer is not on the mesh.
        """
        transport = context.transport
        if transport is None:
            raise TransportError("the mesh is not running.")
        key = (transport, adapter.plane)
        with cls._joining:
            shared = cls._all.get(key) or cls(transport, adapter)
            shared._peers = {**shared._peers, context.peer_id: adapter}
            if key not in cls._all:
                shared._open()
                cls._all[key] = shared
        shared._missed.started()
        return shared

    def left_by(self, context: Context, adapter: SafetyAdapter) -> None:
        """Ask and answer no more for a peer; the last ends the subscriptions."""
        with self._joining:
            self._peers = {name: each for name, each in self._peers.items() if name != context.peer_id}
            if self._peers or self._all.pop((self._transport, adapter.plane), None) is None:
                return
        self._end_watch()
        self._end_looks()
        undeclare(self._declared)
        self._missed.close()

    def _look(self) -> None:
        """Ask where a link came back or stops can be received again.

        Motions hold where no link was left. Where others stayed, the one that came back may be that of a stranger.
        """
        # Read first: a link that comes back between the two asks again.
        rejoined, back = self._transport.rejoined(), self._transport.links_back()
        refused = topics.estop() in self._transport.refusals()
        if rejoined != self._rejoined or (self._refused and not refused):
            self._missed.back()
        elif back != self._links_back:
            self._missed.back(PEER_BACK)
        self._links_back, self._rejoined, self._refused = back, rejoined, refused

    def _open(self) -> None:
        for event, topic in TOPICS.items():
            self._declared.append(self._transport.declare_subscriber(topic("*"), self._receiver(event)))
        self._end_watch = AWAKE.watch(lambda: self._missed.ask("the process did not run for a while"))
        self._end_looks = repeat("missed stops", LOOK_HZ, self._look)

    def _receiver(self, event: str) -> Callable[[Sample], None]:
        def receive(sample: Sample) -> None:
            self._missed.receive(event, sample.key.split("/", 2)[1], sample.payload)

        return receive


def epoch_of(notice: wire.EstopNotice, body: Mapping[str, Any]) -> str:
    """Return the epoch of an e-stop: its id, else one of its issuer and time."""
    return notice.estop_id or derived_epoch(notice.peer_id, json.dumps(body["t"]).encode())


def _fields_of(payload: bytes | int) -> dict[str, Any]:
    try:
        return {} if isinstance(payload, int) else wire.decode(payload, ANSWER_MAX_BYTES)
    except wire.WireError:
        return {}
