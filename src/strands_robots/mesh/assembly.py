"""How the parts of one mesh peer are put together, and in which order they start and stop."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from strands_robots import settings
from strands_robots.contract import WorldRobot, body_of
from strands_robots.mesh import session, topics
from strands_robots.mesh.children import Children
from strands_robots.mesh.context import Context
from strands_robots.mesh.dispatch import Dispatcher
from strands_robots.mesh.executor import Lanes
from strands_robots.mesh.input_receiver import InputReceiver
from strands_robots.mesh.presence import DESCRIBE_S, PresencePublisher
from strands_robots.mesh.registry import PeerRegistry
from strands_robots.mesh.rpc import Requester
from strands_robots.mesh.safety import FleetSafety, SafetyAdapter
from strands_robots.mesh.scheduler import Scheduler
from strands_robots.mesh.sensors import CameraPublisher, SensorPublisher
from strands_robots.mesh.serving import Line, MotionDoor, Server
from strands_robots.mesh.state import Description, StateReader
from strands_robots.mesh.stream import StepPublisher
from strands_robots.mesh.subscriptions import Subscriptions
from strands_robots.mesh.teleop import TeleopDesk, join
from strands_robots.mesh.throttle import AuditSink, AuditThrottle
from strands_robots.mesh.transport import Transport
from strands_robots.mesh.transport.zenoh_config import Posture, TlsCredentials
from strands_robots.mesh.wire_identity import Identity, signature_policy
from strands_robots.recording.cameras import frames_of
from strands_robots.safety.persistence import simulation_key
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.stopping import StopVerdict, verdict_of

if TYPE_CHECKING:
    from strands_robots.mesh.core import Mesh

logger = logging.getLogger(__name__)

PRUNE_HZ = 1.0
TOKENS_HZ = 5.0


@dataclass(slots=True)
class Parts:
    """What a peer takes from its process, and a test gives it instead.

    Attributes:
        acquire: gives the transport, connected, or None; ``release`` gives it back.
        identity: gives the signer and verifier of a transport.
        audit: where safety events go; the audit log by default.
        keep: the lockout outlives the process under the peer's id.
    """

    acquire: Callable[[], Transport | None] = session.acquire
    release: Callable[[], None] = session.release_session
    registry: PeerRegistry = field(default_factory=session.registry)
    clock: Callable[[], float] = time.time
    monotonic: Callable[[], float] = time.monotonic
    identity: Callable[[Transport], Identity] | None = None
    audit: AuditSink | None = None
    plane: SafetyPlane | None = None
    keep: bool = False


@dataclass(slots=True)
class Assembled:
    """One peer's parts, good for one stay on the mesh."""

    mesh: Mesh
    context: Context
    scheduler: Scheduler
    lanes: Lanes
    door: SafetyAdapter
    caller: Requester
    server: Server
    herald: PresencePublisher
    safety: FleetSafety
    state: StateReader
    teleop: TeleopDesk
    subscriptions: Subscriptions
    steps: StepPublisher
    sensors: SensorPublisher
    identity_of: Callable[[Transport], Identity]
    inputs: dict[str, dict[str, Any]]
    children: Children | None = None
    held: list[Any] = field(default_factory=list)

    def begin(self, transport: Transport) -> None:
        """Hear before being seen: the safety topics first, then commands, presence, the publishers."""
        context, peer = self.context, self.context.peer_id
        context.transport = transport
        context.identity = self.identity_of(transport)
        hear = transport.declare_subscriber
        for key, heard in (
            # The resumes first: one that the broker kept tells which kept e-stop is over.
            (topics.resume(), self.safety.on_resume),
            (topics.estop(), self.safety.on_estop),
            (topics.command(peer), self.server.on_command),
            (topics.broadcast(), self.server.on_command),
            (topics.responses(peer), self.caller.on_response),
        ):
            self.held.append(hear(key, heard))
        self.herald.start()
        every, rates = self.scheduler.every, topics.BY_NAME
        if self.mesh.robot is not None:
            self.mesh.add_robot_sensors()
        every("describe", rates["presence"].rate_hz, self.herald.refresh)
        every("state", rates["state"].rate_hz, self._publish_state)
        if self.children is not None:
            every("children", rates["presence"].rate_hz, self.children.refresh)
            every("children's presence", rates["presence"].rate_hz, self.children.announce, quick=True)
        every("tokens", TOKENS_HZ, self.herald.judge_tokens, quick=True)
        every("prune", PRUNE_HZ, self._prune, quick=True)
        frames = frames_of(self.mesh.robot)
        if frames is not None:
            feed = CameraPublisher(context, frames)
            every("camera", settings.number("STRANDS_MESH_CAMERA_HZ"), feed.publish)
        self.scheduler.start()
        self.steps.start()
        # A robot whose bus is wedged is announced all the same, by its name alone.
        self.herald.described.wait(DESCRIBE_S)
        every("presence", rates["presence"].rate_hz, self.herald.announce, quick=True)
        if not _can_resume():
            logger.info("%s: no resume key is configured; an emergency stop is cleared at this machine only.", peer)

    def end(self, timeout: float) -> None:
        """Stop what publishes, then what hears, then the workers."""
        deadline = time.monotonic() + timeout
        streams = self.teleop.close()
        alive = self.scheduler.stop(max(0.0, deadline - time.monotonic()))
        alive += self.sensors.stop(max(0.0, deadline - time.monotonic()))
        alive += self.steps.stop(max(0.0, deadline - time.monotonic()))
        self.caller.close()
        dropped = self.subscriptions.clear()
        if dropped:
            logger.info("%s left the mesh and dropped %d subscriptions.", self.context.peer_id, dropped)
        self.herald.stop()
        if self.children is not None:
            self.children.close()
        for each in self.held:
            each.undeclare()
        self.held = []
        alive += self.lanes.stop(max(0.0, deadline - time.monotonic()))
        alive += join(streams, max(0.0, deadline - time.monotonic()))
        self.context.transport = None
        self.context.audit.close()
        if alive:
            logger.warning("%s left the mesh with loops still running: %s.", self.context.peer_id, ", ".join(alive))

    def _publish_state(self) -> None:
        body = self.state.read()
        if body is not None:
            self.context.put(topics.state(self.context.peer_id), body)

    def _prune(self) -> None:
        self.context.registry.prune()


def _safety_key(robot: Any, peer: str, *, keep: bool) -> str | None:
    """Under what the robot's lockout outlives the process: its hardware's own key, else the id it was given."""
    own = getattr(robot, "safety_key", None)
    if isinstance(own, str) and own:
        return own
    return simulation_key(peer) if keep and robot is not None else None


def assemble(mesh: Mesh, parts: Parts, before: Assembled | None = None) -> Assembled:
    """The parts of ``mesh``; those of a stay before give their door to the safety plane."""
    peer, robot = mesh.peer_id, mesh.robot

    def recorder(name: str) -> AuditThrottle:
        return AuditThrottle(name, parts.audit) if parts.audit is not None else AuditThrottle(name)

    context = Context(peer, parts.registry, recorder(peer), Identity(), parts.clock, parts.monotonic)
    simulated = isinstance(robot, WorldRobot) or mesh.peer_type == "sim"
    lanes = Lanes(peer)
    key = _safety_key(robot, peer, keep=parts.keep)
    door: SafetyAdapter = before.door if before is not None else SafetyAdapter(peer, robot, key, parts.plane)
    caller = Requester(context)
    safety = FleetSafety(context, door, caller, lanes.resumes, robot=robot is not None)
    teleop = TeleopDesk(lambda source, device: InputReceiver(mesh, body_of(robot), source, device), lanes)
    inputs: dict[str, dict[str, Any]] = {}

    def halt(reason: str) -> StopVerdict:
        return verdict_of(lambda: robot.halt(reason), peer) if robot is not None else StopVerdict()

    dispatcher = Dispatcher(robot, halt, closing=lambda: not context.running())
    desk = {
        "teleop_status": teleop.status,
        "teleop_receive": teleop.receive,
        "teleop_stop": teleop.stop,
        "ping": lambda command: {},
        "resume": lambda command: safety.on_resume_command(command["assertion"]),
    }

    def dispatch(command: dict[str, Any]) -> Any:
        with teleop.stopping() if command["action"] == "stop" else nullcontext():
            return (desk.get(command["action"]) or dispatcher)(command)

    line = Line(None if robot is None else robot.gate)
    approval_door = MotionDoor(context, hardware=robot is not None and not simulated)
    scheduler = Scheduler(f"mesh-{peer}")
    sensors = SensorPublisher(context, scheduler)
    description = Description(peer, robot)

    def facts() -> dict[str, Any]:
        told = description.read()
        if inputs:
            told["inputs"] = list(inputs.values())
        spoken = sensors.topics()
        if spoken:
            told["topics"] = spoken
        return told

    children: Children | None = None
    if isinstance(robot, WorldRobot):
        children = Children(
            context,
            robot,
            lanes,
            kind=mesh.peer_type,
            line=line,
            teleop=teleop,
            locked=safety.locked,
            resume=safety.on_resume_command,
            audit=recorder,
        )
    return Assembled(
        mesh=mesh,
        context=context,
        scheduler=scheduler,
        lanes=lanes,
        door=door,
        caller=caller,
        server=Server(context, lanes, approval_door, safety.locked, dispatch, line=line, meant=dispatcher.meant),
        herald=PresencePublisher(context, mesh.peer_type, facts),
        safety=safety,
        state=StateReader(peer, robot, parts.clock),
        teleop=teleop,
        subscriptions=Subscriptions(lanes.delivery),
        sensors=sensors,
        steps=StepPublisher(context, robot, settings.number("STRANDS_MESH_STREAM_HZ")),
        identity_of=parts.identity or identity_of,
        inputs=inputs,
        children=children,
    )


def identity_of(transport: Transport) -> Identity:
    """The identity that the environment asks for on this transport.

    Signed where the session has certificates. MQTT's own certificates are the broker's business, so there it is signed
    only where that is demanded, with the mesh's.
    """
    posture: Posture | None = getattr(transport, "posture", None)
    if posture is not None:
        return Identity.from_settings(posture.credentials)
    return Identity.from_settings(TlsCredentials.from_settings() if signature_policy() == "1" else None)


def _can_resume() -> bool:
    return settings.is_set("STRANDS_MESH_RESUME_PUBLIC_KEY")
