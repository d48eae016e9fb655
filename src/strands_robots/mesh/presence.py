"""Presence: heartbeats, liveliness tokens, and sessions bound to peers; robots of a world.

Robots of a world are peers of their own, ``<parent>__<robot>``. A child is announced from its parent's session, answers
commands for its one robot, and stops with it when the fleet is told to stop. Locking and resuming are its parent's.
What concerns the whole world, its parent is asked for.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

from strands_robots.contract import WorldRobot
from strands_robots.envelope import error
from strands_robots.mesh import session as mesh_session
from strands_robots.mesh import topics, wire
from strands_robots.mesh.commands import CommandReceiver, SenderCheck, execute_on
from strands_robots.mesh.input_receiver import TeleopReceivers
from strands_robots.mesh.safety import status_of
from strands_robots.mesh.scheduler import AuditThrottle, TroubleLog, repeat
from strands_robots.mesh.session import Context, PeerRegistry
from strands_robots.mesh.transport import Declaration, Sample, Transport, TransportError, undeclare
from strands_robots.mesh.wire_identity import IdentityError
from strands_robots.safety.gate import MotionRequest
from strands_robots.safety.identity import SigningIdentity
from strands_robots.safety.sightings import sightings
from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS, PICTURE_VERBS
from strands_robots.serving.peer_verbs import PEER_VERBS, TELEOP_VERBS, description_of
from strands_robots.serving.pipeline import Own, Pipeline
from strands_robots.serving.stops import OneRobot
from strands_robots.serving.verbs import Arguments, Verb
from strands_robots.utils import ValidationError, identifier

logger = logging.getLogger(__name__)

LOOK_HZ = 5.0
"""Looks a second for tokens that went and peers that fell silent."""

DESCRIBE_S = 0.2
"""Seconds that the first heartbeat waits for the description of the peer."""

TOKEN_PATIENCE_S = 0.3
SAME_LOSS_S = 0.5
RETURN_S = 2.0
"""Seconds after our own link is back, within which the tokens of living peers are back as well."""

LEAVING_MAX = 4096
SKEWED_MAX = 64


class PresencePublisher:
    """Announces one peer.

    Args:
        describe: returns the fields of a heartbeat besides id, type, host and time. It may read the robot slowly, so
            :meth:`refresh` calls it, and :meth:`announce` sends its last result.
        safety: returns the fields of lockout and check-in at once, for each heartbeat anew.
    """

    def __init__(
        self,
        context: Context,
        peer_type: str,
        describe: Callable[[], Mapping[str, Any]],
        safety: Callable[[], Mapping[str, Any]] = dict,
    ) -> None:
        self._context = context
        self._type = peer_type
        self._describe = describe
        self._safety = safety
        self._facts: dict[str, Any] = {}
        self._troubles = TroubleLog(logger)
        self.described = threading.Event()
        self.listener: PresenceListener | None = None
        self._token: Declaration | None = None
        self._declaring = threading.Lock()
        self._host = socket.gethostname()

    def start(self) -> None:
        """Listen to the others, and declare our token as soon as there is a session."""
        self.listener = PresenceListener.joined_by(self._context)
        self._declare_token()

    def _declare_token(self) -> None:
        transport, session = self._context.transport, self._context.session_id()
        if self._token is not None or session is None or transport is None:
            return
        with self._declaring:
            # A heartbeat may be under way while the peer leaves.
            if self._token is None and self.listener is not None:
                self._token = transport.declare_token(topics.token(self._context.peer_id, session))

    def stop(self) -> None:
        with self._declaring:
            listener, self.listener = self.listener, None
            token, self._token = self._token, None
        session = self._context.session_id()
        if session is not None:
            # Further peers of this process share the registry; they may leave before they see the token go.
            self._context.registry.lost(self._context.peer_id, session)
        if token is not None:
            undeclare([token])
        if listener is not None:
            listener.left_by(self._context)

    def refresh(self) -> None:
        """Read the description anew; a robot that fails is announced by name alone."""
        try:
            self._facts, trouble = dict(self._describe()), ""
        except Exception as exc:  # noqa: BLE001 - a robot that cannot be read is announced all the same
            self._facts, trouble = {}, f"{type(exc).__name__}: {exc}"
        self._troubles.note("", trouble, "%s cannot be described: %s", self._context.peer_id, trouble)
        self.described.set()

    def announce(self) -> None:
        """Publish one heartbeat, after our token once there is a session."""
        self._declare_token()
        context = self._context
        body = {
            **self._facts,
            **self._safety(),
            "robot_id": context.peer_id,
            "robot_type": self._type,
            "hostname": self._host,
            "timestamp": context.clock(),
        }
        try:
            context.put(topics.presence(context.peer_id), context.identity.sign(body))
        except (TransportError, wire.WireError) as exc:
            logger.warning("%s: presence was not published: %s", context.peer_id, exc)


class PresenceListener:
    """Registers the peers that are heard.

    All peers of a process on one session share one. A heartbeat is parsed and verified once for
    all of them.
    """

    _all: ClassVar[dict[tuple[Transport, PeerRegistry], PresenceListener]] = {}
    _joining: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, transport: Transport, registry: PeerRegistry) -> None:
        self._transport = transport
        self._registry = registry
        self._members: dict[str, Context] = {}
        self._network, self._remembered = mesh_session.network(), sightings()
        self._skewed: set[str] = set()
        self._leaving: dict[tuple[str, str], float] = {}
        self._tokens: dict[tuple[str, str], None] = {}
        self._watches = False
        # Where a link can be lost, its loss and that of the tokens come in any order.
        self._judged_later = transport.lost_link_at() is not None
        self._anchored_at: float | None = None
        self._declared: list[Declaration] = []
        self._end_looks: Callable[[], None] = lambda: None

    @classmethod
    def joined_by(cls, context: Context) -> PresenceListener:
        """Return the listener of a peer's session and registry.

        Raises:
            TransportError: the peer is not on the mesh.
        """
        transport = context.transport
        if transport is None:
            raise TransportError("the mesh is not running.")
        key = (transport, context.registry)
        with cls._joining:
            listener = cls._all.get(key) or cls(*key)
            listener._members = {**listener._members, context.peer_id: context}
            if key not in cls._all:
                listener._declared.append(transport.declare_subscriber(topics.presence("*"), listener.on_presence))
                cls._all[key] = listener
                listener._watch_tokens()
                listener._end_looks = repeat("tokens", LOOK_HZ, listener._look)
        return listener

    def left_by(self, context: Context) -> None:
        """Hear no more for a peer; the last ends the subscription."""
        with self._joining:
            self._members = {peer: each for peer, each in self._members.items() if each is not context}
            if not self._members:
                del self._all[self._transport, self._registry]
                self._end_looks()
                undeclare(self._declared)

    def _look(self) -> None:
        """Judge tokens and drop silent peers."""
        self.judge_tokens()
        self._registry.prune()

    def _watch_tokens(self) -> None:
        if not self._watches and self._transport.session_id is not None:
            self._watches = True
            self._declared.append(self._transport.watch_tokens(topics.token("*", "*"), self.on_token))

    def on_presence(self, sample: Sample) -> None:
        """Register the sender of a heartbeat, or drop the heartbeat and audit the reason."""
        members = list(self._members.values())
        if not members:
            return
        context = members[0]
        try:
            presence = wire.Presence.of(wire.decode(sample.payload, topics.BY_NAME["presence"].max_bytes))
        except wire.WireError as exc:
            context.audit("presence_rejected", reason=str(exc))
            return
        peer = presence.robot_id
        own = self._members.get(peer)
        if own is not None:
            _audit_impostor(own, sample)
            if len(members) == 1:
                return
        ahead = presence.timestamp - context.clock()
        if not wire.fresh(presence.timestamp, context.clock()):
            context.audit("presence_rejected", peer, reason="the timestamp is not fresh")
            self._name_skew(peer, ahead)
            return
        if sample.sessionless and not _owns_topic(sample.key, peer):
            context.audit("presence_rejected", peer, reason="the topic and the body disagree")
            return
        session, certificate = sample.session, None
        if context.identity.checks or context.identity.required:
            try:
                verified = context.identity.verify(presence.body, peer)
                certificate = (verified.cert_sha256, verified.common_name)
            except IdentityError as exc:
                if context.identity.required:
                    context.audit("presence_unverified", peer, reason=str(exc))
                    session = None
        certified = certificate is not None or not context.identity.required
        bound = context.registry.conflicts(peer, session, certified=certified)
        if bound is not None:
            context.audit("presence_identity_conflict", peer, held=bound, offered=session)
            return
        anonymous = session is None and not sample.sessionless
        if context.registry.full_for(peer, session, anonymous=anonymous):
            context.audit("presence_left_out", reason="the table of peers is full, or its session announced too many")
            return
        facts = presence.facts()
        older = not sample.sessionless and (peer, sample.session) not in self._tokens
        if context.registry.update(
            peer,
            presence.robot_type,
            presence.hostname,
            facts,
            session=session,
            certificate=certificate,
            older=older,
            anonymous=anonymous,
        ):
            logger.info("%s sees %s (%s).", context.peer_id, peer, presence.robot_type)
        self._remember(members, sample, peer, facts)

    def _remember(self, members: list[Context], sample: Sample, peer: str, facts: Mapping[str, Any]) -> None:
        """Have this machine remember a robot that was heard.

        Robots' own processes do not: that would cost the square of their number.
        """
        robot = "locked" in facts or "tool_name" in facts
        if not robot or any(each.has_robot for each in members) or self._registry.of_world(peer, sample.session):
            return
        cell = facts.get("cell")
        self._remembered.note(
            self._network,
            peer,
            cell=cell if isinstance(cell, str) else "",
            signed_only=True if facts.get("signed_stops") is True else None,
            stoppable=True,
        )

    def _name_skew(self, peer: str, ahead: float) -> None:
        """Log once a peer that is left out for its clock, for a bounded number."""
        if len(self._skewed) < SKEWED_MAX and peer not in self._skewed:
            self._skewed.add(peer)
            logger.warning(
                "%s is left out: its clock is %.0f s %s of ours, and a heartbeat may be 5 s ahead and 60 s behind.",
                peer,
                abs(ahead),
                "ahead" if ahead > 0 else "behind",
            )

    def on_token(self, key: str, alive: bool) -> None:
        """Note a token that came or went, for :meth:`judge_tokens`."""
        parts = key.split("/")
        if len(parts) != 4:
            return
        mark = (parts[1], parts[3])
        if alive:
            self._leaving.pop(mark, None)
            # Kept when it goes: peers of ours whose hub died are not of a 0.5 release for that.
            self._tokens[mark] = None
            if len(self._tokens) > LEAVING_MAX:
                del self._tokens[next(iter(self._tokens))]
        elif len(self._leaving) < LEAVING_MAX:
            self._leaving[mark] = time.monotonic()
            if not self._judged_later:
                self.judge_tokens(0.0)

    def judge_tokens(self, patience: float = TOKEN_PATIENCE_S) -> None:
        """Mark peers whose token went as gone, unless our own link was lost.

        When a hub dies every token goes at once, although the sessions may live on. A living session declares its
        token again on the next hub; a token that is not back :data:`RETURN_S` after our own link belongs to a peer
        that is gone.
        """
        self._watch_tokens()
        now, transport = time.monotonic(), self._transport
        if not transport.anchored():
            self._anchored_at = None
            return
        lost_link = transport.lost_link_at()
        self._anchored_at = self._anchored_at if self._anchored_at is not None else now
        for mark, went in list(self._leaving.items()):
            ours = lost_link is not None and abs(went - lost_link) < SAME_LOSS_S
            since = max(went, lost_link or went, self._anchored_at) if ours else went
            if now - since < (RETURN_S if ours else patience):
                continue
            self._leaving.pop(mark, None)
            if self._registry.lost(*mark):
                logger.info("%s left.", mark[0])


def _audit_impostor(context: Context, sample: Sample) -> None:
    ours = context.session_id()
    if sample.session is not None and ours is not None and sample.session != ours:
        context.audit("presence_identity_conflict", context.peer_id, held=ours, offered=sample.session)


def _owns_topic(key: str, peer: str) -> bool:
    """True for a topic of the peer itself or of its parent."""
    parts = key.split("/")
    return len(parts) > 1 and (peer == parts[1] or peer.startswith(f"{parts[1]}__"))


CHILDREN_MAX = 64


@dataclass(slots=True)
class _Child:
    context: Context
    presence: PresencePublisher
    pipeline: Pipeline
    handles: list[Declaration]
    since: float
    # In memory a heartbeat is delivered on the thread that announces, and who hears it may leave the mesh there.
    leaving: threading.RLock = field(default_factory=threading.RLock)
    gone: bool = False

    def presentable(self) -> bool:
        """True when it may be announced: described, or waited for long enough."""
        return self.presence.described.is_set() or self.context.monotonic() - self.since >= DESCRIBE_S


class Children:
    """Children of one peer; none while its world has fewer than two robots.

    Args:
        context: the parent's.
        pipeline: the parent's, whose threads and pending commands the children share.
        kind: the parent's type; ``hardware`` is False for a simulation.
        safety: returns, for a child's id, the parent's lockout, which holds it as well; ``report`` returns all of it,
            for a nonce.
        own: returns, for a child's id, the verbs that the parent answers for it.
        teleop: the parent's input streams, which may drive any of the robots.
        audit: makes the audit of a child.
        robot_key: the parent's, which signs for its children as well.
        lock_of: returns, for a child's id, what locks its parent; ``epochs`` returns those that lock it.
    """

    def __init__(
        self,
        context: Context,
        world: WorldRobot,
        pipeline: Pipeline,
        *,
        kind: str,
        hardware: bool = False,
        safety: Callable[[str], Mapping[str, Any]],
        report: Callable[[str, str], Mapping[str, Any]],
        own: Callable[[str], Mapping[str, Own]],
        teleop: TeleopReceivers,
        audit: Callable[[str], AuditThrottle],
        robot_key: SigningIdentity | None = None,
        lock_of: Callable[[str], Callable[[object, Sample, str], str | None]],
        epochs: Callable[[], Collection[str]],
    ) -> None:
        self._lock_of, self._epochs = lock_of, epochs
        self._context = context
        self._world = world
        self._pipeline = pipeline
        self._kind, self._hardware = kind, hardware
        self._safety, self._report = safety, report
        self._own = own
        self._teleop = teleop
        self._audit = audit
        self._robot_key = robot_key
        self._children: dict[str, _Child] = {}
        self._unnamed: set[str] = set()
        self._closed = threading.Event()

    @property
    def peers(self) -> set[str]:
        """The ids of the children that there are now."""
        return set(self._children)

    def refresh(self) -> None:
        """Announce the robots that came and take away those that went."""
        transport = self._context.transport
        if transport is None or transport.session_id is None or transport.pins_topics:
            return
        names = self._world.list_robots()
        wanted = {each: name for name in names[:CHILDREN_MAX] if (each := self._id(name))} if len(names) > 1 else {}
        for peer in list(self._children):
            if peer not in wanted:
                self._end(peer)
        for peer, name in wanted.items():
            if peer not in self._children and not self._closed.is_set():
                self._children[peer] = self._begin(peer, name)
                if self._closed.is_set():
                    self._end(peer)
        # When all have begun: a robot that hangs in its read costs no other its commands.
        for child in list(self._children.values()):
            child.presence.refresh()

    def announce(self) -> None:
        for child in list(self._children.values()):
            with child.leaving:
                # A heartbeat after its token went would have it in reach again.
                if not child.gone and child.presentable():
                    child.presence.announce()

    def close(self) -> None:
        self._closed.set()
        for peer in list(self._children):
            self._end(peer)

    def _id(self, robot: str) -> str | None:
        peer = f"{self._context.peer_id}__{robot}"
        try:
            return identifier("peer_id", peer)
        except ValidationError as exc:
            if robot not in self._unnamed:
                self._unnamed.add(robot)
                logger.warning("A robot of this world is not announced by itself: %s", exc)
            return None

    def _begin(self, peer: str, name: str) -> _Child:
        parent, robot = self._context, OneRobot(self._world, name)
        transport = parent.transport
        if transport is None:
            raise TransportError("the mesh is not running.")
        context = replace(parent, peer_id=peer, audit=self._audit(peer))
        parents = dict.fromkeys(TELEOP_VERBS, self._ask_parent(name))
        leases = None if self._pipeline.leases is None else self._pipeline.leases.only(name)
        pipeline = Pipeline.of(
            robot,
            lambda: peer,
            hardware=self._hardware,
            authorize=SenderCheck(context, hardware=self._hardware),
            own={
                **self._own(peer),
                **parents,
                **self._arm_verbs(name),
                "status": status_of(robot, partial(self._report, peer), lambda: leases),
                "describe": lambda arguments, _: description_of(robot),
                "execute": execute_on(robot, parent),
            },
            pending=self._pipeline.pending.of(name),
            shares=self._pipeline.shares,
            leases=leases,
        )
        server = CommandReceiver(
            context,
            pipeline,
            target_of=robot.stop_target,
            before_stop=self._teleop.void,
            after_stop=self._teleop.reap,
            robot_key=self._robot_key,
            lock=self._lock_of(peer),
            epochs=self._epochs,
        )
        presence = PresencePublisher(context, self._kind, robot.facts, partial(self._safety, peer))
        handles: list[Declaration] = []
        child = _Child(context, presence, pipeline, handles, context.monotonic())
        handles.append(transport.declare_subscriber(topics.command(peer), server.on_command))
        handles.append(transport.declare_subscriber(topics.broadcast(), server.on_command))
        session = transport.session_id
        if session is not None:
            handles.append(transport.declare_token(topics.token(peer, session)))
        return child

    def _arm_verbs(self, name: str) -> dict[str, Own]:
        """Return the verbs of an arm and its cameras, which the world carries out."""

        def carried_out(verb: Verb) -> Own:
            named = {"robot_name": name} if "robot_name" in verb.by_name else {}

            def begin(arguments: Arguments, request: MotionRequest | None) -> object:
                if arguments.get("robot_name", name) != name:
                    return error(f"robot_name must be {name}, or be left out.")
                return verb.call(self._world, {**arguments, **named}, request)()

            return begin

        verbs = {verb: PEER_VERBS[verb] for verb in (*ARM_MOTION_VERBS, *PICTURE_VERBS)}
        return {verb: carried_out(described) for verb, described in verbs.items()}

    def _ask_parent(self, name: str) -> Own:
        text = f"{name} is one robot of a world; ask {self._context.peer_id}."
        return lambda arguments, _: error(text)

    def _end(self, peer: str) -> None:
        # The sampler and a stop of the mesh may both come: the first one ends it.
        child = self._children.pop(peer, None)
        if child is None:
            return
        with child.leaving:
            child.gone = True
        child.pipeline.close()
        undeclare(child.handles)
        child.context.audit.close()
