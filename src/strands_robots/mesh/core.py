"""Robot as a peer of the mesh: presence, commands, streams and safety."""

from __future__ import annotations

import logging
import re
import secrets
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from strands_robots import settings
from strands_robots._mesh_switch import mesh_env_request
from strands_robots.adapted import simulated, warn_endless
from strands_robots.contract import body_of, holds_robots, stated_name
from strands_robots.mesh import session, topics
from strands_robots.mesh.commands import CommandReceiver, SenderCheck, execute_on, pong
from strands_robots.mesh.input_receiver import InputReceiver, InputSide, TeleopReceivers, join
from strands_robots.mesh.presence import DESCRIBE_S, Children, PresencePublisher
from strands_robots.mesh.rpc import Requester
from strands_robots.mesh.safety import FleetSafety, OnAnswers, status_of
from strands_robots.mesh.safety_adapter import SafetyAdapter
from strands_robots.mesh.scheduler import AuditSink, AuditThrottle, Scheduler
from strands_robots.mesh.security import validate_peer_id
from strands_robots.mesh.sensors import CameraPublisher, SensorLoopsMixin, SensorPublisher
from strands_robots.mesh.session import Context, Pacer, PeerRegistry
from strands_robots.mesh.state import IDLE_HZ, STATE_RATES, Description, StateRate, StateReader, StepPublisher
from strands_robots.mesh.stop_link import Hearing
from strands_robots.mesh.transport import (
    DataCallback,
    Declaration,
    Sample,
    SampleCallback,
    Subscriptions,
    Transport,
)
from strands_robots.mesh.wire_identity import ConsoleSigner, ConsoleTrust, Identity, identity_of
from strands_robots.moved import of_module
from strands_robots.recording.cameras import frames_of
from strands_robots.safety.gate import MotionGate
from strands_robots.safety.persistence import simulation_key
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.scope import EVERY_ROBOT, Remembers, Scope, none_known, own_cell
from strands_robots.serving.offered_verbs import own_verbs
from strands_robots.serving.peer_verbs import description_of
from strands_robots.serving.pipeline import Own, Pipeline
from strands_robots.serving.robot_verbs import served
from strands_robots.tags import tags_of
from strands_robots.threads import BoundedExecutor
from strands_robots.utils import DURATION_MAX_S, ValidationError, number, plain_value, shown, text

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


logger = logging.getLogger(__name__)

LOOP_JOIN_TIMEOUT_S = 2.0
"""Seconds that :meth:`Mesh.stop` waits, in all, for what it started."""

LATE_HZ, REST_HZ = 2.0, 0.2
HEARING_HZ = 2.0
DELIVERIES_MAX = 1024
"""Messages of the user's subscriptions that wait for their callbacks."""

_local: dict[str, Mesh] = {}
_local_lock = threading.Lock()


@dataclass(slots=True)
class Parts:
    """Dependencies of a peer that a test replaces.

    Attributes:
        acquire: gives the transport, connected, or None; ``release`` gives it back.
        identity: gives the signer and verifier of a transport.
        audit: where safety events go; the audit log by default.
        keep: the lockout outlives the process under the peer's id.
        cell: the cell that the robot is in; empty for none.
        tags: of the robot.
    """

    acquire: Callable[[], Transport | None] = session.acquire
    release: Callable[[], None] = session.release_session
    registry: PeerRegistry = field(default_factory=session.registry)
    pacer: Pacer = field(default_factory=session.pacer)
    clock: Callable[[], float] = time.time
    monotonic: Callable[[], float] = time.monotonic
    identity: Callable[[Transport], Identity] | None = None
    audit: AuditSink | None = None
    plane: SafetyPlane | None = None
    keep: bool = False
    cell: str = ""
    tags: tuple[str, ...] = ()

    def recorder(self, name: str) -> AuditThrottle:
        """Return the audit of a peer."""
        return AuditThrottle(name) if self.audit is None else AuditThrottle(name, self.audit)


class Mesh(SensorLoopsMixin):
    """Peer on the mesh; made by :func:`init_mesh`, ended by :meth:`stop`.

    Args:
        robot: a robot or a simulated world, or None for a peer that only watches and commands.
        peer_id: its name on the mesh.
        peer_type: ``robot``, ``sim`` or another word for what it is; a duck-typed object of type ``sim`` is exempt
            from the motion gate of real hardware.
        parts: clock, transport, registry, audit and safety plane, where they are not the process's own.

    Raises:
        ValueError: ``peer_id`` is no identifier, a reserved word or the name of another robot of this process,
            ``peer_type`` is no text, or ``robot`` is a plain value, such as a name.
    """

    def __init__(self, robot: Any, peer_id: str, peer_type: str = "robot", *, parts: Parts | None = None) -> None:
        self.peer_id = validate_peer_id(peer_id)
        self.peer_type = text("peer_type", peer_type, longest=100)
        self.robot = None if robot is None else served(robot)
        self._own_verbs = {} if self.robot is None else own_verbs(self.robot)
        self._parts = parts or Parts()
        self._lifecycle_lock = threading.Lock()
        self._hardware = self.robot is not None and not simulated(self.robot, peer_type)
        self.inputs = InputSide(hardware=self._hardware)
        key = _safety_key(self.robot, self.peer_id, keep=self._parts.keep)
        # A locked robot that leaves the mesh stays on the safety plane: to leave and join again must not unlock it.
        self._adapter = SafetyAdapter(self.peer_id, self.robot, key, self._parts.plane, self._parts.cell)
        self._adapter.idle()
        self._compose()

    def _compose(self) -> None:
        """Make the parts of one stay on the mesh."""
        parts, robot, peer = self._parts, self.robot, self.peer_id
        hardware = self._hardware
        self._context = context = Context(
            peer, parts.registry, parts.recorder(peer), Identity(), parts.clock, parts.monotonic
        )
        context.pacer, context.has_robot = parts.pacer, robot is not None
        context.console, context.consoles = ConsoleSigner(parts.clock), ConsoleTrust(parts.clock)
        self.inputs.begin(context)
        self._handles: list[Declaration] = []
        self._unwatch: Callable[[], None] = lambda: None
        self._scheduler = Scheduler(peer)
        self._sensors = SensorPublisher(context, self._scheduler)
        self._requester = Requester(context)
        self._teleop = TeleopReceivers(lambda source, device: InputReceiver(self, body_of(robot), source, device))
        self._description = Description(peer, robot, self._own_verbs)
        self._hearing = Hearing(context, self._adapter.halt)
        self._presence = PresencePublisher(context, self.peer_type, self._describe, self._announced)
        self._state = StateReader(peer, robot, parts.clock)
        self._steps = StepPublisher(context, robot, settings.number("STRANDS_MESH_STREAM_HZ"))
        self._delivery = BoundedExecutor(f"{peer}-delivery", DELIVERIES_MAX)
        self._subscriptions = Subscriptions(self._delivery)
        own: dict[str, Own] = {
            "teleop_status": self._teleop.status,
            "teleop_receive": self._teleop.receive,
            "teleop_stop": self._teleop.stop,
            "ping": lambda arguments, _: pong(context),
            "resume": self._resume_of(peer),
            "describe": lambda arguments, _: description_of(robot, self._own_verbs),
        }
        if robot is not None:
            own["status"] = status_of(
                robot,
                lambda nonce: {**self._adapter.report("", nonce), **self._hearing.facts()},
                lambda: self._pipeline.leases,
            )
            own["execute"] = execute_on(robot, context, lambda: self._pipeline.closed)
        self._pipeline = Pipeline.of(
            robot, lambda: peer, hardware=hardware, authorize=SenderCheck(context, hardware=hardware), own=own
        )
        if self._pipeline.leases is not None:
            self._pipeline.leases.attach(self._teleop)
        self._commands = CommandReceiver(
            context,
            self._pipeline,
            before_stop=self._teleop.void,
            after_stop=self._teleop.reap,
            robot_key=self._adapter.identity,
            lock=self._lock_of(peer),
            epochs=self._adapter.epochs,
            own_verbs=self._own_verbs,
        )
        self._safety = FleetSafety(
            context, self._adapter, self._requester, self._pipeline.shares.urgent, robot=robot is not None
        )
        self.children: Children | None = None
        if holds_robots(robot):
            self.children = Children(
                context,
                robot,
                self._pipeline,
                kind=self.peer_type,
                hardware=hardware,
                safety=self._announced,
                report=self._adapter.report,
                own=lambda child: {"ping": own["ping"], "resume": self._resume_of(child)},
                robot_key=self._adapter.identity,
                lock_of=self._lock_of,
                epochs=self._adapter.epochs,
                teleop=self._teleop,
                audit=parts.recorder,
            )

    def _safety_facts(self, peer_id: str = "") -> dict[str, Any]:
        return {**self._adapter.announced(peer_id), **self._hearing.facts()}

    def _announced(self, peer_id: str = "") -> dict[str, Any]:
        return self._safety_facts(peer_id) | ({"tags": list(self._parts.tags)} if self._parts.tags else {})

    def _lock_of(self, peer_id: str) -> Callable[[object, Sample, str], str | None]:
        return lambda estop, sample, sender: self._safety.on_own_estop(estop, sample, sender, peer_id)

    def _resume_of(self, peer_id: str) -> Own:
        return lambda arguments, _: self._safety.on_resume_command(arguments.get("assertion"), peer_id)

    def _describe(self) -> dict[str, Any]:
        """Return the fields of presence: the robot's own, and the streams of this peer."""
        fields = self._description.read()
        if inputs := self.inputs.announced():
            fields["inputs"] = inputs
        return {**fields, "topics": published} if (published := self._sensors.topics()) else fields

    # Life.

    @property
    def alive(self) -> bool:
        """True while this peer is joined to the mesh."""
        return self._context.running()

    def start(self) -> None:
        """Join the mesh and start publishing; a second call does nothing."""
        with self._lifecycle_lock:
            if self._context.transport is not None:
                return
            self._adapter.leave_if_served_elsewhere(session.network())
            transport = self._parts.acquire()
            if transport is None:
                return
            try:
                self._adapter.open(joins=True)
                self._adapter.serve(session.network())
                self._begin(transport)
            except BaseException:
                # A peer that cannot join gives back the session and its subscribers.
                self._leave()
                raise
        with _local_lock:
            _local[self.peer_id] = self

    def stop(self) -> None:
        """Leave the mesh: end the loops, drop every subscription, give the session back."""
        with self._lifecycle_lock:
            if self._context.transport is None:
                return
            self._leave()
        with _local_lock:
            if _local.get(self.peer_id) is self:
                del _local[self.peer_id]

    def _leave(self) -> None:
        self._end(LOOP_JOIN_TIMEOUT_S)
        self._parts.release()
        self._adapter.leave()
        if not self._adapter.epochs():
            self._adapter.close()
        self._compose()

    def _begin(self, transport: Transport) -> None:
        """Open safety topics first, then commands, presence, the publishers."""
        context, peer = self._context, self.peer_id
        context.transport = transport
        context.identity = (self._parts.identity or identity_of)(transport)
        # The resumes first: one that the broker kept tells which kept e-stop is over.
        self._handles.append(transport.declare_subscriber(topics.resume(), self._safety.on_resume))
        self._safety.join()
        for key, receive in (
            (topics.command(peer), self._commands.on_command),
            (topics.broadcast(), self._commands.on_command),
            (topics.responses(peer), self._requester.on_response),
            (topics.check_in_answer("*"), self._safety.on_check_in_answer),
        ):
            self._handles.append(transport.declare_subscriber(key, receive))
        if self.robot is not None:
            self.robot.gate.attach(self._hearing)
            self._hearing.look()
        self._presence.start()
        every, rates = self._scheduler.every, topics.BY_NAME
        if self.robot is not None:
            self.add_robot_sensors()
            self._report_states(self.robot.gate)
        else:
            every("describe", rates["presence"].rate_hz, self._presence.refresh)
        warn_endless(self.robot, peer)
        if self.children is not None:
            every("children", rates["presence"].rate_hz, self.children.refresh)
            every("children's presence", rates["presence"].rate_hz, self.children.announce, quick=True)
        self._look_for_late_peers()
        frames = frames_of(self.robot)
        if frames is not None:
            every("camera", settings.number("STRANDS_MESH_CAMERA_HZ"), CameraPublisher(context, frames).publish)
        self._scheduler.start()
        self._steps.start()
        # A robot whose bus is wedged is announced all the same, by its name alone.
        self._presence.described.wait(DESCRIBE_S)
        every("presence", rates["presence"].rate_hz, self._presence.announce, quick=True)
        if self.robot is not None and self._adapter.open_to_all:
            logger.info("%s: any name on the mesh may stop and lock it; DEVICE_CONNECT_ESTOP_ALLOW is not set.", peer)
        if not settings.is_set("STRANDS_MESH_RESUME_PUBLIC_KEY"):
            logger.info("%s: no resume key is configured; an emergency stop is cleared at this machine only.", peer)

    def _end(self, timeout: float) -> None:
        """Stop what publishes, then what receives, then the workers."""
        deadline = time.monotonic() + timeout

        def left() -> float:
            return max(0.0, deadline - time.monotonic())

        streams = self._teleop.close()
        alive = self._scheduler.stop(left()) + self._steps.stop(left())
        self._safety.close(left())
        self._requester.close()
        dropped = self._subscriptions.clear()
        if dropped:
            logger.info("%s left the mesh and dropped %d subscriptions.", self.peer_id, dropped)
        self._presence.stop()
        if self.children is not None:
            self.children.close()
        for handle in self._handles:
            handle.undeclare()
        self._handles = []
        alive += self._pipeline.close(left()) + self._delivery.stop(left()) + join(streams, left())
        self._safety.leave()
        self._context.transport = None
        self._unwatch()
        if self.robot is not None:
            self.robot.gate.detach(self._hearing)
        self._context.audit.close()
        if alive:
            logger.warning("%s left the mesh with loops still running: %s.", self.peer_id, ", ".join(alive))

    def _look_for_late_peers(self) -> None:
        late, pace = self._safety.late, self._scheduler.pace

        def look() -> None:
            late.look()
            if not late.waits:
                pace("late peers", REST_HZ)

        def hear() -> None:
            self._hearing.look()
            # Noticed here, so that a stop that is noted takes no lock of the timer's.
            if late.waits:
                pace("late peers", LATE_HZ)

        self._scheduler.every("hearing", HEARING_HZ, hear, quick=True)
        # A stop that is published again may wait for its turn, and behind no robot.
        self._scheduler.every("late peers", LATE_HZ, look, queue="late peers")

    def _report_states(self, gate: MotionGate) -> None:
        hz, describe_hz = topics.BY_NAME["state"].rate_hz, topics.BY_NAME["presence"].rate_hz

        def hurry() -> None:
            self._scheduler.pace("state", hz, soon=True)
            self._scheduler.pace("describe", describe_hz, soon=True)

        rate = StateRate(gate, self._adapter.epochs, hurry)

        def describe() -> None:
            self._presence.refresh()
            self._scheduler.pace("describe", describe_hz if rate.active else IDLE_HZ)

        def publish() -> None:
            body = self._state.read()
            if body is not None:
                self._context.put(topics.state(self.peer_id), body | self._safety_facts())
                rate.published(body)
            self._scheduler.pace("state", hz if rate.active else IDLE_HZ)

        self._scheduler.every("describe", describe_hz, describe)
        self._scheduler.every("state", hz, publish)
        STATE_RATES.join(rate)
        unwatch = gate.watch(rate.begins)

        def unwatch_all() -> None:
            unwatch()
            STATE_RATES.leave(rate)

        self._unwatch = unwatch_all

    def close(self) -> None:
        """Leave the mesh for good, and the safety plane with it."""
        self.stop()
        self._adapter.close()

    def announce(self) -> None:
        """Publish one heartbeat now, besides those the scheduler sends."""
        self._presence.announce()

    # Who is there.

    @property
    def peers(self) -> list[dict[str, Any]]:
        """Every other peer."""
        return [row for row in self._context.registry.all() if row["peer_id"] != self.peer_id]

    @property
    def peers_by_id(self) -> dict[str, dict[str, Any]]:
        """Every other peer, by id."""
        return {row["peer_id"]: row for row in self.peers}

    def get_peer(self, peer_id: str, max_age_s: float | None = None) -> dict[str, Any] | None:
        """Return another peer, or None when unknown or silent above ``max_age_s``.

        Raises:
            ValidationError: ``max_age_s`` is not positive and finite.
        """
        bound = None if max_age_s is None else number("max_age_s", max_age_s, above=0)
        return None if peer_id == self.peer_id else self._context.registry.get(peer_id, bound)

    def peer_cert(self, peer_id: str) -> tuple[str, str] | None:
        """Return SHA-256 and common name of a peer's last certificate, or None."""
        return self._context.registry.certificate_of(peer_id)

    def peer_wire_zid(self, peer_id: str) -> str | None:
        """Return the session that a peer claimed last, or None."""
        return self._context.registry.session_of(peer_id)

    def left(self, peer_id: str, session: str) -> bool:
        """Return True where a peer has left the mesh, or came back by another session."""
        return self._context.registry.left(peer_id, session)

    @property
    def stops_waiting(self) -> int:
        """The stops of other peers that have no answer yet."""
        return len(self._commands.stops)

    # Asking.

    def send(self, target: str, cmd: dict[str, Any], timeout: float = 30.0) -> dict[str, Any]:
        """Send a command; return the raw reply, status ``timeout`` or ``error``."""
        return self._requester.send(target, cmd, timeout)

    def ping(self, target: str, timeout: float = 2.0) -> dict[str, Any]:
        """Return a peer's ``status``, ``latency_ms``, ``via``, and ``confirmed``."""
        return self._requester.ping(target, timeout)

    def broadcast(self, cmd: dict[str, Any], timeout: float = 5.0) -> list[dict[str, Any]]:
        """Send a command to every peer and collect replies for ``timeout`` seconds."""
        return self._requester.broadcast(cmd, timeout)

    def tell(self, target: str, instruction: str, **kw: Any) -> dict[str, Any]:
        """Ask a peer to ``execute`` with a ``policy_provider`` and wait."""
        duration = plain_value(kw.get("duration"))
        patience = 30.0 + (duration if isinstance(duration, int | float) and 0 < duration <= DURATION_MAX_S else 30.0)
        timeout = kw.pop("timeout", patience)
        return self.send(target, {"action": "execute", "instruction": instruction, **kw}, timeout)

    # Publishing and hearing.

    def publish(self, key: str, payload: dict[str, Any]) -> None:
        """Publish an object under a key; nothing while the peer is not on the mesh.

        Raises:
            TransportError: the transport refused.
            WireError: JSON cannot hold the payload, or it is above the topic's size.
        """
        if self._context.transport is None:
            logger.debug("publish %s: %s is not on the mesh.", key, self.peer_id)
            return
        self._context.put(key, payload)

    def subscribe(
        self,
        topic: str,
        callback: DataCallback | None = None,
        name: str | None = None,
        *,
        on_sample: SampleCallback | None = None,
    ) -> str | None:
        """Subscribe to a key expression; return the name, or None with a warning.

        Args:
            callback: called with key and object; without one they are kept in ``inbox[name]``.
            on_sample: called with key, object and the publisher's session id instead.

        Raises:
            ValueError: both callbacks are given, ``topic`` or ``name`` is no text, or a callback cannot be called.
        """
        _check_subscription(topic, name, callback=callback, on_sample=on_sample)
        if callback is not None and on_sample is not None:
            raise ValueError("subscribe takes callback or on_sample, not both.")
        transport = self._context.transport
        chosen = name or topic
        if transport is None:
            logger.warning("subscribe %s: %s is not on the mesh.", topic, self.peer_id)
            return None
        done = self._subscriptions.add(transport, topic, chosen, callback=callback, on_sample=on_sample)
        return chosen if done else None

    def listen(self, topic: str, receive: Callable[[Sample], None], name: str) -> bool:
        """Subscribe to raw samples on the transport's thread, for quick handlers."""
        transport = self._context.transport
        return transport is not None and self._subscriptions.add(transport, topic, name, direct=receive)

    def unsubscribe(self, name: str) -> None:
        """Drop a subscription by its name; an unknown one is fine."""
        self._subscriptions.remove(name)

    @property
    def inbox(self) -> dict[str, list[tuple[str, dict[str, Any]]]]:
        """Latest keys and messages of subscriptions without a callback, oldest first."""
        return {name: list(kept) for name, kept in list(self._subscriptions.inbox.items())}

    def publish_step(
        self,
        step: int,
        observation: dict[str, Any],
        action: dict[str, Any],
        instruction: str = "",
        policy: str = "",
    ) -> None:
        """Publish a policy step, at most ``STRANDS_MESH_STREAM_HZ`` a second.

        The rollouts of this peer's own robot are published without it, at the same rate.
        """
        self._steps.publish(step, observation, action, instruction, policy)

    def on_stream(self, peer_id: str, callback: DataCallback | None = None) -> str | None:
        """Hear another peer's policy steps."""
        return self.subscribe(topics.stream(peer_id), callback)

    # Safety.

    @property
    def lockout_epoch(self) -> str | None:
        """Return the oldest epoch that locks this peer, or None."""
        return next(iter(self._adapter.epochs()), None)

    def emergency_stop(
        self,
        signing_key: Any = None,
        *,
        reason: str = "",
        estop_id: str = "",
        on_answers: OnAnswers = lambda replies: None,
        scope: Scope = EVERY_ROBOT,
        remembers: Remembers = none_known,
        on_widened: Callable[[], None] = lambda: None,
    ) -> list[dict[str, Any]]:
        """Stop and lock every robot, this one too, or those of ``scope``.

        A peer that did not stop or did not answer is named at CRITICAL.

        Args:
            signing_key: for fleets that act on signed stops only.
            reason: sent to the robots.
            estop_id: 32 hex digits, the same for one press; a fresh one by default.
            on_answers: called with the replies so far.
            scope: the robots that it is for; where none of them is there, every robot is stopped.
            remembers, on_widened: says whether one is known here; called where every robot is stopped.

        Raises:
            RuntimeError: this peer is not on the mesh.
        """
        # A link that is down must not keep this robot from stopping; the fleet gets the stop later.
        if self._context.transport is None:
            raise RuntimeError(f"{self.peer_id} is not on the mesh: no peer would hear the emergency stop.")
        meant: dict[str, Any] = {"scope": scope, "remembers": remembers, "on_widened": on_widened}
        return self._safety.emergency_stop(
            signing_key, reason=reason, estop_id=estop_id, on_answers=on_answers, **meant
        )

    def check_in_every(self, interval_s: float, signing_key: Any = None) -> None:
        """Check in with robots that need a live controller, while this peer is joined.

        Raises:
            ValidationError: ``interval_s`` is not from 0.02 to 60.
        """
        hz = 1.0 / number("interval_s", interval_s, low=0.02, high=60)
        self._scheduler.every("check-in", hz, lambda: self._safety.check_in(signing_key), quick=True)

    def resume(self, signing_key: Any, *, targets: list[str] | None = None) -> dict[str, Any]:
        """Clear this peer's lockout and the fleet's with the operator's key.

        Args:
            signing_key: from :func:`~strands_robots.mesh.resume_authority.load_signing_key`.
            targets: peers besides this one; every reachable peer by default.

        Returns:
            ``{"status": "ok"}``, or status ``error`` and ``resume rejected``; the reason is in the local audit.
        """
        return self._safety.resume(signing_key, targets)


def _check_subscription(topic: object, name: object, **callbacks: object) -> None:
    """Refuse arguments of another kind, as in another order, by name."""
    if not isinstance(topic, str) or not topic:
        raise ValidationError(f"topic must be a key expression, such as strands/*/state, not {shown(topic)}.")
    if name is not None and not isinstance(name, str):
        raise ValidationError(f"name must be text, not {shown(name)}.")
    for called, each in callbacks.items():
        if each is not None and not callable(each):
            raise ValidationError(f"{called} must be callable, not {shown(each)}.")


def _safety_key(robot: Any, peer: str, *, keep: bool) -> str | None:
    """Return the key of the robot's lockout: its hardware's, else its given id."""
    own = getattr(robot, "safety_key", None)
    if isinstance(own, str) and own:
        return own
    return simulation_key(peer) if keep and robot is not None else None


def init_mesh(
    robot: Any,
    peer_id: str | None = None,
    peer_type: str = "robot",
    mesh: bool = True,
    *,
    cell: str | None = None,
    tags: Collection[str] | str | None = None,
) -> Mesh | None:
    """Make and start a mesh peer for ``robot``; None when the mesh is off.

    Args:
        peer_id: default ``<tool_name_str or "robot">-<8 hex>``.
        cell: the cell that the robot is in, for stops of one cell; that of ``STRANDS_CELL`` by default, "" for none.
        tags: by which callers choose robots; the robot's own or those of ``STRANDS_TAGS`` by default.

    Raises:
        ValueError: ``peer_id`` is no identifier, a reserved word or the name of another robot of this process, or
            ``cell`` or a tag is no identifier.
        DuplicateDeviceError: another process of this machine serves a robot of this id.
    """
    if not mesh or mesh_disabled_by_env():
        return None
    parts = Parts(keep=peer_id is not None, cell=own_cell(cell), tags=tags_of(tags, robot))
    started = Mesh(robot, peer_id if peer_id is not None else _default_id(robot), peer_type, parts=parts)
    started.start()
    return started


def get_local_robots() -> dict[str, Mesh]:
    """The mesh peers of this process that are on the mesh, by id."""
    with _local_lock:
        return dict(_local)


def mesh_disabled_by_env() -> bool:
    """Return True when ``STRANDS_MESH`` forces the mesh off."""
    return mesh_env_request() is False


def _default_id(robot: Any) -> str:
    thing = settings.raw("STRANDS_IOT_THING_NAME")
    if thing and settings.raw("STRANDS_MESH_BACKEND").lower() in ("iot", "bridge"):
        return thing  # the broker's policy pins this peer's topics to its client id
    safe = re.sub(r"[^A-Za-z0-9._-]", "-", stated_name(robot)).lstrip("._-")[:100] or "robot"
    return f"{safe}-{secrets.token_hex(4)}"


def wait_for_peer(mesh: Mesh, peer_id: str, timeout: float = 5.0) -> bool:
    """Wait until a peer is seen; False after ``timeout`` seconds."""
    deadline = time.monotonic() + timeout
    while mesh.get_peer(peer_id) is None:
        if time.monotonic() >= deadline:
            return False
        time.sleep(0.02)
    return True
