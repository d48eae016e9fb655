"""Robots of a world as peers of their own: ``<parent>__<robot>``.

A child is announced from its parent's session, answers commands for its one robot, and stops with it when the fleet is
told to stop. Locking and resuming are its parent's. What concerns the whole world, its parent is asked for.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from strands_robots.contract import WorldRobot
from strands_robots.envelope import error
from strands_robots.mesh import topics
from strands_robots.mesh.commands import CommandReceiver, SenderCheck, execute_on
from strands_robots.mesh.input_receiver import TeleopReceivers
from strands_robots.mesh.presence import DESCRIBE_S, PresencePublisher
from strands_robots.mesh.safety import status_of
from strands_robots.mesh.scheduler import AuditThrottle
from strands_robots.mesh.session import Context
from strands_robots.mesh.transport import Declaration, Sample, TransportError, undeclare
from strands_robots.safety.gate import MotionRequest
from strands_robots.safety.identity import SigningIdentity
from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS, PICTURE_VERBS
from strands_robots.serving.peer_verbs import PEER_VERBS, TELEOP_VERBS, description_of
from strands_robots.serving.pipeline import Own, Pipeline
from strands_robots.serving.stops import OneRobot
from strands_robots.serving.verbs import Arguments, Verb
from strands_robots.utils import ValidationError, identifier

logger = logging.getLogger(__name__)

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
        kind: the parent's type.
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
        self._kind = kind
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
        pipeline = Pipeline.of(
            robot,
            lambda: peer,
            hardware=False,
            authorize=SenderCheck(context, hardware=False),
            own={
                **self._own(peer),
                **parents,
                **self._arm_verbs(name),
                "status": status_of(robot, partial(self._report, peer)),
                "describe": lambda arguments, _: description_of(robot),
                "execute": execute_on(robot, parent),
            },
            pending=self._pipeline.pending.of(name),
            shares=self._pipeline.shares,
            leases=None if self._pipeline.leases is None else self._pipeline.leases.only(name),
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
