"""Follower's side of input streams: the guards before a frame moves it."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from itertools import count
from typing import Any, Protocol

from strands_robots import settings
from strands_robots.bus_access import read_joints
from strands_robots.contract import Haltable, for_request
from strands_robots.envelope import Envelope, error, is_error, success
from strands_robots.mesh import topics, wire
from strands_robots.mesh.security import INPUT_VALUE_ABS, validate_input_frame, validate_mesh_identifier
from strands_robots.mesh.session import Context
from strands_robots.mesh.transport import Sample
from strands_robots.mesh.wire_identity import INPUT
from strands_robots.policies.base import numbers
from strands_robots.safety.gate import MotionGate, MotionRefused, MotionRequest, Permit
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stopping import explain
from strands_robots.serving.verbs import Arguments
from strands_robots.serving.workers import UNBOUNDED
from strands_robots.stop_log import stop_logger
from strands_robots.threads import BoundedExecutor
from strands_robots.utils import ValidationError, integral

logger = stop_logger(__name__)

LOGGED_ERRORS = 5

ApplyFn = Callable[[Any, dict[str, float]], Any]

HOLD_S = 0.5
"""Silence of a leader, in seconds, after which its follower holds its position."""

LOST_S = 2.0
"""Silence after which others may move the follower, which ends the stream, as does a leader that left the mesh."""

POSITION = ".pos"
"""End of a key whose value a servo holds by itself, LeRobot's word for positions."""

WATCH_S = 0.05

AUDIT_EVERY = 100
DEPTH = 32
BURST = 10.0
REJECTIONS = ("source", "lockout", "expired", "freshness", "invalid")
UNITS_FULL_SCALE = {"normalized": 100.0, "radians": 6.283185307179586, "degrees": 360.0, "percent": 100.0}
"""Largest magnitude in each unit: LeRobot's normalised range is -100 to 100, an angle's one turn."""


class InputSide:
    """Numbers, names and signatures of the input streams of one peer.

    Args:
        hardware: it takes signed frames alone.
    """

    _context: Context

    def __init__(self, *, hardware: bool) -> None:
        self._hardware = hardware
        self._frames: dict[str, count[int]] = {}
        self._newest: dict[tuple[str, str], tuple[float, float]] = {}
        self._announced: dict[str, dict[str, Any]] = {}

    def now(self) -> float:
        """Return wall-clock seconds, as stated on the wire."""
        return self._context.clock()

    def record(self, event: str, about: str, **payload: Any) -> None:
        """Record an event about a peer in the audit log."""
        self._context.audit(event, about, **payload)

    def begin(self, context: Context) -> None:
        """Begin a stay on the mesh.

        The numbers rise and the newest frames are known for as long as the peer lives: no follower takes a leader that
        began again for one of its own earlier frames, and no frame counts again on a stream that was reopened.
        """
        self._context = context
        self._announced.clear()

    def announced(self) -> list[dict[str, Any]]:
        """Return the streams as the presence names them."""
        return list(self._announced.values())

    def announce(self, device: str, method: str | None, hz: float) -> None:
        """Name an input stream in the presence, or remove it without ``method``."""
        if method is None:
            self._announced.pop(device, None)
        else:
            self._announced[device] = {"device": device, "method": method, "hz": hz}

    def next_number(self, device: str) -> int:
        """Return the number of the next frame of an input stream."""
        return next(self._frames.setdefault(device, count()))

    def sign(self, frame: dict[str, Any]) -> dict[str, Any]:
        """Return an input frame signed by our certificate, else by this user's console."""
        identity = self._context.identity
        return identity.sign(frame) if identity.signs else self._context.console.sign(frame, INPUT)

    def refusal(self, frame: Mapping[str, Any]) -> str | None:
        """Return the reason why a frame may not move this peer's robot, or None.

        Only real hardware asks for a signature, and takes each signed frame once, also on a stream that was reopened.
        """
        if not self._hardware:
            return None
        identity, source = self._context.identity, str(frame.get("peer_id"))
        certified = identity.refusal(frame, source) if identity.checks else "no certificate is checked here"
        why = certified and (certified if identity.required else self._context.consoles.refusal(frame, INPUT))
        if why is not None:
            return why
        stream, sequence = (source, str(frame.get("device"))), wire.finite(frame.get("seq")) or 0.0
        newest = (wire.finite(frame.get("t")) or 0.0, sequence)
        if self._context.predates(newest[0]):
            return "it was sent before this peer started, by its sender's clock"
        if newest <= self._newest.get(stream, (0.0, -1.0)):
            return "it is no newer than the last one"
        self._newest[stream] = newest
        return None


class InputMesh(Protocol):
    """The part of a mesh peer that publishers and receivers use."""

    peer_id: str
    robot: Any
    inputs: InputSide

    @property
    def alive(self) -> bool:
        """True while the peer is on the mesh."""

    @property
    def lockout_epoch(self) -> str | None:
        """The epoch that locks the peer, or None."""

    def peer_wire_zid(self, peer_id: str) -> str | None:
        """Return the session that a peer announced itself from, or None."""

    def left(self, peer_id: str, session: str) -> bool:
        """Return True where a peer is no more on the mesh by this session."""

    def publish(self, key: str, payload: dict[str, Any]) -> None:
        """Publish an object under a key."""

    def listen(self, topic: str, receive: Callable[[Sample], None], name: str) -> bool:
        """Receive raw samples on the transport's thread; False off the mesh."""

    def unsubscribe(self, name: str) -> None:
        """Drop a subscription."""


class InputReceiver:
    """Applies a remote peer's actions to ``robot``.

    Frames are applied one after another on a thread of the stream's own, so that a slow bus holds up neither the
    transport nor a stop; a bus slower than the leader loses the oldest frames, counted as rate-dropped.

    A leader may pause: after 0.5 s without a frame the follower holds its position, and the first frame after that is
    bounded from where the follower then is. The stream goes on until it is stopped, its lifetime is over, its leader
    has left the mesh, or another caller moves the robot after 2 s of silence. None of them locks.

    Raises:
        ValidationError: ``source_peer_id`` or ``device_name`` is no identifier.
    """

    def __init__(
        self,
        mesh: InputMesh,
        robot: Any,
        source_peer_id: str,
        device_name: str = "leader",
        apply_fn: ApplyFn | None = None,
    ) -> None:
        self._mesh = mesh
        self._robot = robot
        self._source = validate_mesh_identifier(source_peer_id, "source_peer_id")
        self._device = validate_mesh_identifier(device_name, "device_name")
        self._apply = apply_fn
        self._limits = joint_limits(robot)
        self._executor: BoundedExecutor | None = None
        self._running = False
        self._permit: Permit | None = None
        self._session: str | None = None
        self._opened = self._ended = self._moved = self._came = 0.0
        self._end = ""
        self._led: set[str] = set()
        self._holds = False
        self._holding: threading.Thread | None = None
        self._closed = threading.Event()
        self._sequence = -1
        self._last: dict[str, tuple[float, float]] = {}
        self._seeded = False
        self._tokens, self._refilled = BURST, 0.0
        self._counts: Counter[str] = Counter()
        self.start_refusal: str | None = None

    @property
    def topic(self) -> str:
        """The key this receiver hears."""
        return topics.input_stream(self._source, self._device)

    @property
    def running(self) -> bool:
        """True while a frame may move the robot; False after the stop that voids it."""
        return self._running and self._permit is not None and self._permit.valid

    @property
    def leading(self) -> bool:
        """True while the leader may move the follower, also in a pause."""
        return self.running

    @property
    def pauses(self) -> bool:
        """True while the leader has been silent for so long that another may move it."""
        return self.running and time.monotonic() - max(self._opened, self._moved) >= LOST_S

    @property
    def stats(self) -> dict[str, Any]:
        """Return the counters; ``rejected`` is the sum of the ``rejected_*``."""
        running = self.running
        counts, elapsed = self._counts, (self._ended or time.monotonic()) - self._opened
        rejections = {f"rejected_{why}": counts[why] for why in REJECTIONS}
        return {
            "source": self._source,
            "device": self._device,
            "running": running,
            "holding": self._holds,
            "frames_received": counts["received"],
            "errors": counts["errors"],
            "out_of_order": counts["out_of_order"],
            "rate_dropped": counts["rate_dropped"] + (self._executor.dropped if self._executor else 0),
            "slew_rejected": counts["slew"],
            "rejected": sum(rejections.values()),
            **rejections,
            "ended": self._end,
            "hz_actual": round(counts["received"] / elapsed, 2) if elapsed > 0 else 0.0,
        }

    def start(self, request: MotionRequest | None = None) -> None:
        """Open the stream for the leader's session, or set :attr:`start_refusal`.

        Args:
            request: of the command that opens it; a halt since it was made refuses the stream.
        """
        if self.running:
            return
        self.close()
        self.start_refusal = self._open(request)
        fields = {"device": self._device, "session": self._session}
        if self.start_refusal is not None:
            logger.warning("%s was not opened: %s", self.topic, self.start_refusal)
            self._mesh.inputs.record("input_stream_refused", self._source, **fields, reason=self.start_refusal)
            return
        ttl = settings.number("STRANDS_MESH_INPUT_STREAM_TTL_S")
        self._mesh.inputs.record("input_stream_opened", self._source, **fields, lifetime_s=ttl)

    def stop(self) -> dict[str, Any]:
        """Close the stream, wait up to 2 s for its last frame, return the counters."""
        self.close()
        self.join(2.0)
        return self.stats

    def void(self, why: str = "") -> None:
        """Let no frame move the robot from now on; one flag, which waits for nothing."""
        self._end = why or self._end
        if self._permit is not None:
            self._permit.withdraw()

    def close(self) -> None:
        """Hear no further frame; one that is being applied is not waited for."""
        if self._running:
            self._running, self._ended = False, time.monotonic()
            self._closed.set()
            self._mesh.unsubscribe(self._name)
            if self._executor is not None:
                self._executor.close()

    def join(self, timeout: float) -> bool:
        """Wait for the last frame of a closed stream; False, with a warning, if late."""
        if self._executor is None or not self._executor.join(timeout):
            return True
        logger.warning("%s: an action is still being applied.", self.topic)
        return False

    def on_frame(self, sample: Sample) -> None:
        """A frame on the transport's thread: queued for the stream's own."""
        executor = self._executor
        if not self._running or executor is None or sample.retained:
            return  # a frame that a broker stored is of another moment
        if sample.session != self._session:
            # Not queued, so that a stranger's flood displaces none of the leader's frames.
            self._counts["source"] += 1
            return
        received = time.monotonic()
        executor.submit(lambda: self._take(sample, received))

    def _open(self, request: MotionRequest | None) -> str | None:
        session = self._mesh.peer_wire_zid(self._source)
        if session is None:
            return f"{self._source} has not announced itself from any session"
        gate = getattr(self._robot, "gate", None) or getattr(self._mesh.robot, "gate", None)
        try:
            self._permit = (gate if isinstance(gate, MotionGate) else MotionGate()).permit("teleop_receive", request)
        except MotionRefused as refused:
            return str(refused)
        if self._mesh.lockout_epoch is not None:
            return f"locked by the emergency stop {self._mesh.lockout_epoch}"
        self._session, self._sequence, self._last, self._seeded = session, -1, {}, False
        self._came, self._end, self._led = 0.0, "", set()
        self._tokens, self._refilled = BURST, time.monotonic()
        self._counts = Counter()
        self._executor = BoundedExecutor(f"mesh-follow-{self._device}", DEPTH)
        self._opened, self._ended, self._running = time.monotonic(), 0.0, True
        if not self._mesh.listen(self.topic, self.on_frame, self._name):
            self._running, self._ended = False, time.monotonic()
            return "the mesh is not running"
        self._moved, self._holds, self._closed = 0.0, False, threading.Event()
        watch = partial(self._watch, self._closed)
        try:
            threading.Thread(target=watch, name=f"mesh-watch-{self._device}", daemon=True).start()
        except RuntimeError as exc:
            self.close()
            return f"nothing would watch for the leader's silence: {exc}"
        return None

    def _watch(self, closed: threading.Event) -> None:
        """Hold the follower of a leader that pauses; close the stream at its end."""
        while not closed.wait(WATCH_S) and self.running:
            now = time.monotonic()
            silent = now - max(self._opened, self._moved)
            if self._expired(now):
                self._counts["expired"] += 1
                self._expire()
                return
            if silent >= LOST_S and self._session is not None and self._mesh.left(self._source, self._session):
                self._lose(silent, "its leader has left the mesh")
                return
            if not self._moved or silent < HOLD_S:
                continue
            if not self._holds and (self._holding is None or not self._holding.is_alive()):
                self._holds = True
                # It waits for the bus, which a write may block; the stream of a lost leader is closed all the same.
                self._holding = threading.Thread(target=self._hold, name=f"mesh-hold-{self._device}", daemon=True)
                try:
                    self._holding.start()
                except RuntimeError:
                    logger.critical("%s: the system has no thread for the hold.", self.topic, exc_info=True)
                    self._lose(silent, "its leader is silent, and the system has no thread for a hold")
                    self._hold()
                    return

    def _lose(self, silent: float, why: str) -> None:
        logger.warning("%s: the stream is closed: %s.", self.topic, why)
        self._end = why
        self._mesh.inputs.record("input_stream_lost", self._source, device=self._device, silent_s=round(silent, 2))
        self.close()

    def _hold(self) -> None:
        body = getattr(self._robot, "body", None)
        # A stranger without a halt is stopped as its contract has it.
        robot = self._robot if isinstance(self._robot, Haltable) else self._mesh.robot
        try:
            if callable(body):
                body().hold(self._permit)
            elif isinstance(robot, Haltable) and not all(key.endswith(POSITION) for key in self._led):
                # What it was given last may be a speed, which it keeps. A halt ends the stream.
                verdict = stop_executor().halt(robot, self._mesh.peer_id, "its leader is silent")
                if not verdict.stopped:
                    logger.critical(
                        "%s: in its leader's pause the follower %s.", self.topic, explain(verdict.envelope())
                    )
        except Exception:
            logger.critical("%s: the follower could not hold its position.", self.topic, exc_info=True)

    @property
    def _name(self) -> str:
        return f"input:{self._source}/{self._device}"

    def _take(self, sample: Sample, received: float) -> None:
        if not self._running:
            return
        permit = self._permit
        if self._mesh.lockout_epoch is not None or (permit is not None and not permit.valid):
            self._counts["lockout"] += 1
            self.close()
            return
        if self._expired(time.monotonic()):
            self._counts["expired"] += 1
            self._expire()
            return
        try:
            frame = wire.decode(sample.payload, topics.BY_NAME["input"].max_bytes)
        except wire.WireError:
            self._counts["invalid"] += 1
            return
        action = self._checked(frame, received)
        if action is not None:
            self._do(action)

    def _expired(self, now: float) -> bool:
        return now - self._opened > settings.number("STRANDS_MESH_INPUT_STREAM_TTL_S")

    def _expire(self) -> None:
        if self._running:
            self.close()
            self._mesh.inputs.record("input_stream_expired", self._source, device=self._device)

    def _checked(self, frame: Mapping[str, Any], received: float) -> dict[str, float] | None:
        """Return the action of a frame that passed every guard; else count it."""
        stamp = wire.finite(frame.get("t"))
        if stamp is None or not wire.fresh(stamp, self._mesh.inputs.now()):
            self._counts["freshness"] += 1
            return None
        if frame.get("action") is None:
            return None
        try:
            sequence = integral("seq", frame.get("seq"))
        except ValidationError:
            self._counts["invalid"] += 1
            return None
        if sequence <= self._sequence:
            self._counts["out_of_order"] += 1
            return None
        why = self._mesh.inputs.refusal(frame)
        if why is not None or frame.get("peer_id") != self._source or frame.get("device") != self._device:
            self._counts["source"] += 1
            if self._counts["source"] <= LOGGED_ERRORS:
                logger.warning("%s: not applied: %s", self.topic, why or "the topic and the body disagree")
            return None
        self._sequence = sequence
        now = time.monotonic()
        cap = settings.number("STRANDS_MESH_INPUT_MAX_HZ")
        if cap > 0:
            # A few frames may come together where a link or a scheduler held them up; a flood may not. Counted as they
            # arrive: those that waited here for a slow bus were none.
            self._tokens = min(BURST, self._tokens + (received - self._refilled) * cap)
            self._refilled = received
            if self._tokens < 1.0:
                self._counts["rate_dropped"] += 1
                return None
            self._tokens -= 1.0
        try:
            action = self._validated(frame["action"])
        except ValidationError as exc:
            self._counts["invalid"] += 1
            if self._counts["invalid"] <= LOGGED_ERRORS:
                logger.warning("%s: %s", self.topic, exc)
            return None
        if self._too_fast(action, now, cap):
            self._counts["slew"] += 1
            return None
        return action

    def _validated(self, action: object) -> dict[str, float]:
        checked = validate_input_frame(action)
        for joint, value in checked.items():
            limit = self._limits.get(joint, self._limits.get(joint.removesuffix(".pos")))
            if limit is not None and abs(value) > limit:
                raise ValidationError(f"{joint} must be within {limit:g}, not {value:g}.", "TELEOP_VALUE_OUT_OF_RANGE")
        return checked

    def _too_fast(self, action: Mapping[str, float], now: float, cap: float) -> bool:
        fastest = settings.number("STRANDS_MESH_INPUT_SLEW_ABS")
        floor = 1.0 / cap if cap > 0 else 1.0 / 100.0
        paused, self._came = now - self._came >= HOLD_S, now
        if fastest <= 0:
            return False
        if paused:
            # The follower held meanwhile, and may not catch up in one step with what its leader did.
            self._seeded = False
        if not self._seeded:
            # A leader that stands apart is let in when the slew bound would have brought the follower to it.
            try:
                present = present_joints(self._robot)
            except ConnectionError as exc:
                if not self._counts["slew"]:
                    logger.warning("%s: nothing is applied until the follower's joints are read: %s", self.topic, exc)
                return True
            self._seeded = True
            last = {joint: value for joint, (value, _) in self._last.items()}
            self._last = {joint: (value, now) for joint, value in {**last, **present}.items()}
        for joint, value in action.items():
            known = self._last.get(joint)
            if known is not None and abs(value - known[0]) > fastest * max(now - known[1], floor):
                return True
        self._last.update({joint: (value, now) for joint, value in action.items()})
        return False

    def _do(self, action: dict[str, float]) -> None:
        permit = self._permit
        if permit is not None and not permit.valid:
            self._counts["lockout"] += 1
            return
        if permit is not None and permit.held:
            self._counts["rate_dropped"] += 1
            return
        try:
            # A frame that waits for the bus is as old as its stream: a halt since then refuses it there.
            request = None if permit is None else permit.request
            if self._apply is None:
                answer = for_request(request, self._robot.send_action)(action)
            else:
                answer = for_request(request, self._apply)(self._robot, action)
        except Exception as exc:  # noqa: BLE001 - a bus raises what it likes; the frame counts as not applied
            answer = {"status": "error", "reason": f"{type(exc).__name__}: {exc}"}
        self._counts["received"] += 1
        self._led |= action.keys()
        self._moved, self._holds = time.monotonic(), False
        if is_error(answer):
            self._counts["errors"] += 1
            if self._counts["errors"] <= LOGGED_ERRORS:
                logger.warning("%s: not applied: %s", self.topic, answer.get("reason"))
        if self._counts["received"] % AUDIT_EVERY == 0:
            self._mesh.inputs.record(
                "input_stream_applied", self._source, device=self._device, frames=self._counts["received"]
            )


def joint_limits(robot: Any) -> dict[str, float]:
    """Return the largest magnitude by joint: twice its full scale, if known."""
    units = getattr(robot, "joint_units", None)
    if not isinstance(units, Mapping):
        return {}
    known = {str(joint): UNITS_FULL_SCALE.get(str(unit)) for joint, unit in units.items()}
    return {joint: min(2 * scale, INPUT_VALUE_ABS) for joint, scale in known.items() if scale is not None}


def present_joints(robot: Any) -> dict[str, float]:
    """Return a follower's joints by name, of a world its first robot's.

    Raises:
        ConnectionError: it can tell, but not now, as while its bus is busy.
    """
    reader = getattr(robot, "get_state", None)
    try:
        state = reader() if callable(reader) else {"joints": read_joints(robot)}
    except Exception as exc:  # noqa: BLE001 - a bus raises what it likes; the first frame is then bounded by its range
        logger.warning("A follower's joints could not be read: %s: %s", type(exc).__name__, exc)
        return {}
    if not isinstance(state, Mapping):
        return {}
    if state.get("joints_error"):
        raise ConnectionError(state["joints_error"])
    robots = state.get("robots")
    joints = next(iter(robots.values()), None) if isinstance(robots, Mapping) else state.get("joints")
    return numbers(joints) if isinstance(joints, Mapping) else {}


STREAMS_MAX = 8
JOIN_S = 2.0

Key = tuple[str, str]


class TeleopReceivers:
    """Opens, lists and closes receivers; at most eight at once."""

    def __init__(self, open_receiver: Callable[[str, str], InputReceiver]) -> None:
        self._open = open_receiver
        self._receivers: dict[Key, InputReceiver] = {}
        self._lock = threading.Lock()

    def receive(self, command: Arguments, request: MotionRequest | None = None) -> Envelope:
        """Follow ``source_peer_id``'s device (``leader`` by default)."""
        key = (command["source_peer_id"], command.get("device_name", "leader"))
        with self._lock:
            self._end(lambda key, each: not each.running)
            if key in self._receivers:
                return success(f"Already following {key[0]}/{key[1]}.", **self._receivers[key].stats)
            if len(self._receivers) >= STREAMS_MAX:
                return error(f"teleop_receive: {STREAMS_MAX} input streams are open already.")
            receiver = self._open(*key)
            receiver.start(request)
            if receiver.start_refusal is not None:
                return error(f"teleop_receive: {receiver.start_refusal}.")
            self._receivers[key] = receiver
        return success(f"Following {key[0]}/{key[1]}.", **receiver.stats)

    def status(self, command: Arguments, request: MotionRequest | None = None) -> Envelope:
        """The counters of every stream."""
        with self._lock:
            streams = [receiver.stats for receiver in self._receivers.values()]
        return success(f"{sum(stream['running'] for stream in streams)} input streams run.", streams=streams)

    def stop(self, command: Arguments, request: MotionRequest | None = None) -> Envelope:
        """Close the named stream or all, and wait up to 2 s for last frames."""
        source, device = command.get("source_peer_id"), command.get("device_name")
        with self._lock:
            ended = self._end(lambda key, _: source in (None, key[0]) and device in (None, key[1]))
        join(ended, JOIN_S)
        return success(f"{len(ended)} input streams closed.", streams=[each.stats for each in ended])

    def close(self) -> list[InputReceiver]:
        """Close all of them; those closed, to :func:`join`."""
        with self._lock:
            return self._end(lambda key, each: True)

    def leading(self) -> bool:
        """Return True while a leader may move a robot, also in a pause."""
        return any(receiver.leading for receiver in list(self._receivers.values()))

    def end_pauses(self) -> None:
        """Void the streams of leaders that pause, because another caller wants the robot."""
        voided = [receiver for receiver in list(self._receivers.values()) if receiver.pauses]
        for receiver in voided:
            receiver.void("another caller has taken the robot in its leader's pause")
        if voided:
            UNBOUNDED.submit(self.reap)

    def void(self) -> None:
        """Let no frame move anything from now on, because a robot is being stopped.

        It waits for nothing, neither for the lock nor for a frame that a slow bus still takes.
        """
        for receiver in list(self._receivers.values()):
            receiver.void()

    def reap(self) -> None:
        """Close the streams that a stop has voided, without waiting."""
        with self._lock:
            ended = self._end(lambda key, each: not each.running)
        if ended:
            UNBOUNDED.submit(lambda: _joined(ended))

    def _end(self, chosen: Callable[[Key, InputReceiver], bool]) -> list[InputReceiver]:
        ended = [self._receivers.pop(key) for key, each in list(self._receivers.items()) if chosen(key, each)]
        for receiver in ended:
            receiver.close()
        return ended


def join(closed: Iterable[InputReceiver], timeout: float) -> list[str]:
    """Wait for the last frames of closed streams; return the unfinished ones."""
    deadline = time.monotonic() + timeout
    return [each.topic for each in closed if not each.join(max(0.0, deadline - time.monotonic()))]


def _joined(closed: Iterable[InputReceiver]) -> None:
    join(closed, JOIN_S)
