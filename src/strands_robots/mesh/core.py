"""The mesh peer that a robot exposes: presence, commands, streams, safety, composed from their own modules."""

from __future__ import annotations

import logging
import re
import secrets
import threading
import time
from collections.abc import Callable
from itertools import count
from typing import Any

from strands_robots import settings
from strands_robots._mesh_switch import mesh_env_request
from strands_robots.mesh.assembly import Parts, assemble
from strands_robots.mesh.dispatch import fit
from strands_robots.mesh.security import validate_peer_id
from strands_robots.mesh.sensors import SensorLoopsMixin
from strands_robots.mesh.subscriptions import DataCallback, SampleCallback
from strands_robots.mesh.topics import stream
from strands_robots.mesh.transport import Sample
from strands_robots.utils import number

logger = logging.getLogger(__name__)

LOOP_JOIN_TIMEOUT_S = 2.0
"""Seconds that :meth:`Mesh.stop` waits, in all, for what it started."""

_local: dict[str, Mesh] = {}
_local_lock = threading.Lock()


class Mesh(SensorLoopsMixin):
    """A peer on the mesh, embedded in one robot or simulation; made by :func:`init_mesh`, ended by :meth:`stop`.

    Args:
        robot: a robot or a simulated world, or None for a peer that only watches and commands.
        peer_id: its name on the mesh.
        peer_type: ``robot``, ``sim`` or another word for what it is; a duck-typed object of type ``sim`` is exempt
            from the motion gate of real hardware.
        parts: clock, transport, registry, audit and safety plane, where they are not the process's own.

    Raises:
        ValueError: ``peer_id`` is no identifier, a reserved word or the name of another robot of this process, or
            ``robot`` is no robot.
    """

    def __init__(self, robot: Any, peer_id: str, peer_type: str = "robot", *, parts: Parts | None = None) -> None:
        self.peer_id = validate_peer_id(peer_id)
        self.peer_type = peer_type
        self.robot = fit(robot)
        self._parts = parts or Parts()
        self._lifecycle_lock = threading.Lock()
        self._frames: dict[str, count[int]] = {}
        self._assembled = assemble(self, self._parts)
        self._context = self._assembled.context
        self._sensors = self._assembled.sensors

    # Life.

    @property
    def alive(self) -> bool:
        """True while this peer is joined to the mesh."""
        return self._context.running()

    def start(self) -> None:
        """Join the mesh: take the session and start publishing. Twice is once; off the mesh it is logged why."""
        with self._lifecycle_lock:
            if self._context.transport is not None:
                return
            transport = self._parts.acquire()
            if transport is None:
                return
            try:
                self._assembled.door.open()
                self._assembled.begin(transport)
            except BaseException:
                # Whoever cannot join holds nothing: neither the session nor half of its subscribers.
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
        self._assembled.end(LOOP_JOIN_TIMEOUT_S)
        self._parts.release()
        # A locked peer stays with the safety plane: leaving and joining again must not unlock it.
        if not self._assembled.door.epochs():
            self._assembled.door.close()
        self._assembled = assemble(self, self._parts, self._assembled)
        self._context = self._assembled.context
        self._sensors = self._assembled.sensors

    def close(self) -> None:
        """Leave the mesh for good, and the safety plane with it."""
        self.stop()
        self._assembled.door.close()

    def announce(self) -> None:
        """Publish one heartbeat now, besides those the scheduler sends."""
        self._assembled.herald.announce()

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
        """One other peer, or None when it is unknown, this peer itself, or silent for longer than ``max_age_s``.

        Raises:
            ValidationError: ``max_age_s`` is not positive and finite.
        """
        bound = None if max_age_s is None else number("max_age_s", max_age_s, above=0)
        return None if peer_id == self.peer_id else self._context.registry.get(peer_id, bound)

    def peer_cert(self, peer_id: str) -> tuple[str, str] | None:
        """(SHA-256, common name) of the certificate that a peer last announced itself with, or None."""
        return self._context.registry.certificate_of(peer_id)

    def peer_wire_zid(self, peer_id: str) -> str | None:
        """The session that a peer last announced itself from, or None. A hint: its publisher chose it."""
        return self._context.registry.session_of(peer_id)

    # Asking.

    def send(self, target: str, cmd: dict[str, Any], timeout: float = 30.0) -> dict[str, Any]:
        """Send a command to one peer. Its raw reply; or status ``timeout``; or status ``error`` with the reason."""
        return self._assembled.caller.send(target, cmd, timeout)

    def ping(self, target: str, timeout: float = 2.0) -> dict[str, Any]:
        """Is a peer reachable, and how fast: ``status``, ``latency_ms``, ``via``, and ``confirmed`` where it is ok."""
        return self._assembled.caller.ping(target, timeout)

    def broadcast(self, cmd: dict[str, Any], timeout: float = 5.0) -> list[dict[str, Any]]:
        """Send a command to every peer and collect replies for ``timeout`` seconds."""
        return self._assembled.caller.broadcast(cmd, timeout)

    def tell(self, target: str, instruction: str, **kw: Any) -> dict[str, Any]:
        """Ask a peer to run a policy and wait: an ``execute`` with ``policy_provider=`` and what it needs."""
        duration = kw.get("duration")
        patience = 30.0 + (duration if isinstance(duration, int | float) and 0 < duration <= 3600 else 30.0)
        timeout = kw.pop("timeout", patience)
        return self.send(target, {"action": "execute", "instruction": instruction, **kw}, timeout)

    # Publishing and hearing.

    def publish(self, key: str, payload: dict[str, Any]) -> None:
        """Publish an object under a key.

        Raises:
            TransportError: the mesh is not running or the transport refused.
            WireError: JSON cannot hold the payload, or it is above the topic's size.
        """
        self._context.put(key, payload)

    def subscribe(
        self,
        topic: str,
        callback: DataCallback | None = None,
        name: str | None = None,
        *,
        on_sample: SampleCallback | None = None,
    ) -> str | None:
        """Hear a key expression; the subscription's name, or None with the reason at WARNING.

        Args:
            callback: called with key and object; without one they are kept in ``inbox[name]``.
            on_sample: called with key, object and the publisher's session id instead.

        Raises:
            ValueError: both callbacks are given.
        """
        if callback is not None and on_sample is not None:
            raise ValueError("subscribe takes callback or on_sample, not both.")
        transport = self._context.transport
        chosen = name or topic
        if transport is None:
            logger.warning("subscribe %s: %s is not on the mesh.", topic, self.peer_id)
            return None
        done = self._assembled.subscriptions.add(transport, topic, chosen, callback=callback, on_sample=on_sample)
        return chosen if done else None

    def listen(self, topic: str, heard: Callable[[Sample], None], name: str) -> bool:
        """Hear raw samples on the transport's thread; for parts of the mesh that return at once."""
        transport = self._context.transport
        return transport is not None and self._assembled.subscriptions.add(transport, topic, name, direct=heard)

    def unsubscribe(self, name: str) -> None:
        """Drop a subscription by its name; an unknown one is fine."""
        self._assembled.subscriptions.remove(name)

    @property
    def inbox(self) -> dict[str, Any]:
        """The latest messages of each subscription without a callback, oldest first."""
        return dict(self._assembled.subscriptions.inbox)

    def publish_step(
        self,
        step: int,
        observation: dict[str, Any],
        action: dict[str, Any],
        instruction: str = "",
        policy: str = "",
    ) -> None:
        """Publish one policy step; more than ``STRANDS_MESH_STREAM_HZ`` a second are thinned out.

        The rollouts of this peer's own robot are published without it, at the same rate.
        """
        self._assembled.steps.publish(step, observation, action, instruction, policy)

    def on_stream(self, peer_id: str, callback: DataCallback | None = None) -> str | None:
        """Hear another peer's policy steps."""
        return self.subscribe(stream(peer_id), callback)

    def announce_input(self, device: str, method: str | None, hz: float) -> None:
        """Name an input stream of this peer in its presence; without ``method`` it is no longer named."""
        if method is None:
            self._assembled.inputs.pop(device, None)
        else:
            self._assembled.inputs[device] = {"device": device, "method": method, "hz": hz}

    def next_input(self, device: str) -> int:
        """The number of the next frame of an input stream. It rises for as long as this peer lives, so that a follower
        does not take a leader that began again for one of its own earlier frames."""
        return next(self._frames.setdefault(device, count()))

    def record(self, event: str, about: str, **payload: Any) -> None:
        """Record an event about a peer in the audit log."""
        self._context.audit(event, about, **payload)

    def now(self) -> float:
        """Wall-clock seconds, as stated on the wire."""
        return self._context.clock()

    # Safety.

    @property
    def lockout_epoch(self) -> str | None:
        """The id of the e-stop that holds this peer's lockout, the oldest of several; None while clear."""
        return next(iter(self._assembled.door.epochs()), None)

    def emergency_stop(self) -> list[dict[str, Any]]:
        """Stop and lock this robot and every peer; the answer of the robot here, if any, then each peer's.

        A peer that did not stop or did not answer is named at CRITICAL.

        Raises:
            RuntimeError: this peer is not on the mesh.
        """
        # A link that is down for the moment keeps nobody from stopping here, and the fleet hears of it later.
        if self._context.transport is None:
            raise RuntimeError(f"{self.peer_id} is not on the mesh: no peer would hear the emergency stop.")
        return self._assembled.safety.emergency_stop()

    def resume(self, signing_key: Any, *, targets: list[str] | None = None) -> dict[str, Any]:
        """Clear this peer's lockout and the fleet's with the operator's key.

        Args:
            signing_key: from :func:`~strands_robots.mesh.resume_authority.load_signing_key`.
            targets: peers besides this one; every reachable peer by default.

        Returns:
            ``{"status": "ok"}``, or status ``error`` and ``resume rejected``; the reason is in the local audit.
        """
        return self._assembled.safety.resume(signing_key, targets)


def init_mesh(robot: Any, peer_id: str | None = None, peer_type: str = "robot", mesh: bool = True) -> Mesh | None:
    """Make a mesh peer for ``robot`` and start it; None when ``mesh`` is False or ``STRANDS_MESH`` forces it off.

    Args:
        peer_id: default ``<tool_name_str or "robot">-<8 hex>``.

    Raises:
        ValueError: ``peer_id`` is no identifier, a reserved word or the name of another robot of this process.
    """
    if not mesh or mesh_disabled_by_env():
        return None
    named = peer_id if peer_id is not None else _default_id(robot)
    started = Mesh(robot, named, peer_type, parts=Parts(keep=peer_id is not None))
    started.start()
    return started


def get_local_robots() -> dict[str, Mesh]:
    """The mesh peers of this process that are on the mesh, by id."""
    with _local_lock:
        return dict(_local)


def mesh_disabled_by_env() -> bool:
    """Whether ``STRANDS_MESH`` forces the mesh off."""
    return mesh_env_request() is False


def _default_id(robot: Any) -> str:
    thing = settings.raw("STRANDS_IOT_THING_NAME")
    if thing and settings.raw("STRANDS_MESH_BACKEND").lower() in ("iot", "bridge"):
        return thing  # the broker's policy pins this peer's topics to its client id
    word = str(getattr(robot, "tool_name_str", "") or "robot")
    safe = re.sub(r"[^A-Za-z0-9._-]", "-", word).lstrip("._-")[:100] or "robot"
    return f"{safe}-{secrets.token_hex(4)}"


def wait_for_peer(mesh: Mesh, peer_id: str, timeout: float = 5.0) -> bool:
    """Wait until a peer is seen; False after ``timeout`` seconds."""
    deadline = time.monotonic() + timeout
    while mesh.get_peer(peer_id) is None:
        if time.monotonic() >= deadline:
            return False
        time.sleep(0.02)
    return True
