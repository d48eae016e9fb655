"""Teleoperation over the mesh, where a leader leads the robot of another peer.

Authorization and lockout are the follower's, wherever its leader is.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from typing import TYPE_CHECKING, Any

from strands_robots.envelope import Envelope, is_error, text_of
from strands_robots.errors import NoAnswerError, NoSuchRobotError, RefusalError, RobotError, UnreachableError
from strands_robots.fleet.mesh.network import MeshNetwork
from strands_robots.policies.base import LEADER_UNBOUNDED_PER_S, Ranges, checked_action, limited, numbers, speeds_across
from strands_robots.serving.control_leases import leases_of
from strands_robots.teleoperators import BoundedLeader, LeaderFinished, LeaderPolicy
from strands_robots.utils import ValidationError, mapping, number, plain_text, shown, text

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh
    from strands_robots.mesh.input import InputPublisher, InputReceiver

DEVICE = "leader"
"""Name of the input device in the streams."""

_PEER_S, _ANSWER_S, _OPEN_S = 3.0, 5.0, 3.0
_ASK_EVERY_S = 0.25
_SILENT_S = 2.0
_PAUSE_MAX_S = 0.04
_STOPPED = "it was halted or locked"
_REASONS = {
    "rejected_lockout": _STOPPED,
    "rejected_expired": "the stream outlived its lifetime",
    "rejected_source": "another session took the leader's name",
}


class RemoteFollower:
    """Peer of the mesh with the joints and ranges that it answered.

    Raises:
        RefusalError: it is not in reach, does not answer, or has no action that can be led.
        ValidationError: it is a world of several robots, of which a stream moves the first alone.
    """

    def __init__(self, mesh: Mesh, peer: str) -> None:
        self._mesh = mesh
        self.peer = peer
        await_peer(mesh, peer)
        features, state = self.ask("features"), self.ask("state")
        try:
            robots = _fields("robots", features.get("robots"))
            if robots:
                name = next(iter(robots))
                self.bounds = _ranges(_fields("actuators", _fields(name, robots[name]).get("actuators")), ())
                joints = _fields("robots", state.get("robots")).get(name)
            else:
                actions = features.get("action_features")
                keys = actions if isinstance(actions, list) else _fields("action_features", actions)
                self.bounds, joints = _ranges(_fields("ranges", features.get("ranges")), keys), state.get("joints")
            reported = _fields("joints", joints)
            self._joints = numbers(reported) | {
                key: number(f"joints[{key!r}]", reported[key]) for key in self.bounds if key in reported
            }
        except ValidationError as exc:
            raise RobotError(f"{peer} cannot be led by what it reports: {exc}") from None
        if len(robots) > 1:
            known = ", ".join(f"{peer}/{name}" for name in robots)
            raise ValidationError(f"the follower must be one of {known}, without mesh:, not the world {peer}.")
        if not self.bounds:
            raise RobotError(f"{peer} reports no action key that could be led")

    def body(self) -> RemoteFollower:
        """Return this object: the robot and its body are one here."""
        return self

    def get_joints(self) -> dict[str, float]:
        """Return the joints as the peer reported them."""
        return dict(self._joints)

    def ask(self, action: str, **fields: Any) -> Envelope:
        """Send a command; raise :class:`RefusalError` with the reason of a refusal."""
        reply = self._mesh.send(self.peer, {"action": action, **fields}, _ANSWER_S)
        result = reply.get("result")
        if reply.get("status") == "timeout":
            raise NoAnswerError(f"{self.peer} did not answer {action} within {_ANSWER_S:g} s")
        if not isinstance(result, dict):
            raise RobotError(f"{self.peer} refused {action}: {plain_text(reply.get('error')) or 'no reason given'}")
        if action != "stop" and is_error(result):
            raise RobotError(f"{self.peer} refused {action}: {text_of(result)}")
        return result

    def open_stream(self, leader: str) -> None:
        """Have the peer open the stream; retry until it knows the leader's id."""
        deadline = time.monotonic() + _OPEN_S
        while True:
            try:
                self.ask("teleop_receive", source_peer_id=leader, device_name=DEVICE)
            except RefusalError as refused:
                if "announced" not in refused.why or time.monotonic() > deadline:
                    raise
                time.sleep(_ASK_EVERY_S)
            else:
                return

    def halt(self, reason: str) -> None:
        """Stop the peer; raise :class:`RefusalError` when it does not confirm that."""
        del reason  # a stop of the mesh carries none
        answer = self.ask("stop")
        if answer.get("ok") is not True:
            raise RobotError(f"{self.peer} did not confirm its stop: {answer.get('error') or 'no reason given'}")


class LimitedFollower:
    """Bounded-speed application of a stream, from the robot's present joints.

    Args:
        body: has ``bounds`` and ``get_joints``.
        max_speed: whole joint ranges a second.
        now: monotonic seconds.
    """

    def __init__(self, body: Any, max_speed: float, now: Callable[[], float] = time.monotonic) -> None:
        self._bounds: Ranges = dict(body.bounds)
        speed = number("max_speed", max_speed, above=0, high=20)
        self._speeds = speeds_across(self._bounds, speed, LEADER_UNBOUNDED_PER_S)
        self._last = {key: value for key, value in body.get_joints().items() if key in self._bounds}
        self._now = now
        self._at = now()

    def __call__(self, robot: Any, action: dict[str, float]) -> Any:
        """Apply a frame, return the answer; refuse an unknown key."""
        target = checked_action(action, self._bounds)
        now = self._now()
        # The time of a pause does not count, or the next frame could jump.
        passed, self._at = min(now - self._at, _PAUSE_MAX_S), now
        self._last |= limited(target, self._last, self._speeds, passed)
        return robot.send_action({key: self._last[key] for key in target})


class LedPeer:
    """Peer that a leader of this process leads.

    Attributes:
        policy: the leader with its counters.
        bounded: the leader within the follower's bounds and its speed.
        counters: of the stream, as the follower reported them last.
    """

    def __init__(self, follower: RemoteFollower, leader: str, policy: LeaderPolicy) -> None:
        self.policy, self.counters = policy, dict[str, Any]()
        self.bounded = BoundedLeader(policy, follower.get_joints(), follower.bounds)
        self._follower, self._leader = follower, leader
        self._asked_at = self._answered_at = time.monotonic()

    def over(self) -> str:
        """Return the reason why leading is over, empty while it is not."""
        now = time.monotonic()
        if self.bounded.done.is_set():
            return "The leader has finished."
        if now - self._asked_at < _ASK_EVERY_S:
            return ""
        self._asked_at, peer = now, self._follower.peer
        try:
            streams = self._follower.ask("teleop_status").get("streams")
            if not isinstance(streams, list) or not all(isinstance(each, Mapping) for each in streams):
                raise RobotError(f"{peer} reports no list of streams")
        except RefusalError as silent:
            return f"{peer} is out of reach: {silent}" if now - self._answered_at > _SILENT_S else ""
        self._answered_at = time.monotonic()
        of_leader = (each for each in streams if each.get("source") == self._leader)
        self.counters.update(next(of_leader, {"running": False}))
        return "" if self.counters.get("running") else f"{peer} stopped following: {_stream_end(self.counters)}"


class PublishedLeader:
    """Leader that notes its end; its followers receive nothing more then."""

    def __init__(self, leader: Any) -> None:
        self.finished = False
        self._leader = leader
        self.get_teleop_events = getattr(leader, "get_teleop_events", None)

    def get_action(self) -> dict[str, Any]:
        """Return the leader's action."""
        try:
            return dict(self._leader.get_action())
        except LeaderFinished:
            self.finished = True
            raise


class FollowedPeer:
    """Leader of another peer that leads a robot of this process."""

    def __init__(self, peer: str, receiver: InputReceiver) -> None:
        self._peer, self._receiver = peer, receiver

    @property
    def stats(self) -> dict[str, Any]:
        """The counters of the stream."""
        return self._receiver.stats

    def over(self) -> str:
        """Return why following is over; empty also while the leader pauses."""
        stats = self.stats
        return "" if stats["running"] else f"The robot stopped following {self._peer}: {_stream_end(stats)}."

    def leading(self) -> bool:
        """Return True while the leader may move the robot, also in a pause."""
        return self._receiver.leading

    def void(self) -> None:
        """Let no frame move the robot from now on; wait for nothing."""
        self._receiver.void()

    def end_pauses(self) -> None:
        """Do nothing: this command is its leader's follower, and nobody else's."""


@contextmanager
def dialled(source: str, peer: str) -> Iterator[Mesh]:
    """Join a peer's mesh as a caller, which is never its hub, for a block.

    Args:
        source: the first part of this caller's id.
        peer: the one to reach.

    Raises:
        NoSuchRobotError: there is no mesh.
    """
    network = MeshNetwork(source)
    try:
        network.open()
    except UnreachableError as exc:
        raise NoSuchRobotError(f"No peer {peer!r} is on the mesh of this machine: {exc.why}") from exc
    with closing(network):
        yield network.peer


def publisher(mesh: Mesh, leader: Any, method: str, hz: float) -> InputPublisher:
    """Return the publisher of a leader, not started; ``hz`` frames a second."""
    from strands_robots.mesh.input import InputPublisher  # noqa: PLC0415 - the network is loaded when it is used

    return InputPublisher(mesh, leader, DEVICE, method, number("hz", hz, low=1, high=1000))


@contextmanager
def followed(robot: Any, peer: str, max_speed: float) -> Iterator[FollowedPeer]:
    """Let the leader of another peer drive a robot for the length of a block.

    Args:
        robot: of this process, joined to the mesh.
        peer: the publisher; its device is called ``leader``.
        max_speed: whole joint ranges a second.

    Raises:
        RefusalError: the mesh is off, the peer is not on it, or the robot may not move.
    """
    from strands_robots.mesh.input import InputReceiver  # noqa: PLC0415 - the network is loaded when it is used

    if robot.mesh is None or not robot.mesh.alive:
        raise UnreachableError("The mesh has no session, or STRANDS_MESH switches it off")
    await_peer(robot.mesh, peer)
    receiver = InputReceiver(robot.mesh, robot, peer, DEVICE, LimitedFollower(robot.body(), max_speed))
    receiver.start()
    if receiver.start_refusal is not None:
        raise RobotError(f"{peer} cannot lead: {receiver.start_refusal}")
    followed_peer = FollowedPeer(peer, receiver)
    leases_of(robot, hardware=False).attach(followed_peer)
    try:
        yield followed_peer
    finally:
        receiver.stop()


def await_peer(mesh: Mesh, peer: str) -> None:
    """Wait until a peer is in reach, longer with stated endpoints.

    Raises:
        NoSuchRobotError: it is not seen in time.
    """
    from strands_robots.mesh.core import wait_for_peer  # noqa: PLC0415 - the network is loaded when it is used
    from strands_robots.mesh.transport.config import discovery_timeout  # noqa: PLC0415 - as above

    if not wait_for_peer(mesh, peer, discovery_timeout(_PEER_S)):
        raise NoSuchRobotError(f"No peer {peer!r} is on the mesh of this machine")


def _stream_end(counters: Mapping[str, Any]) -> str:
    """Return why a stream ended, from the follower's counters."""
    why = plain_text(counters.get("ended"), 200)
    return why or next((text for name, text in _REASONS.items() if counters.get(name)), _STOPPED)


def _fields(name: str, value: object) -> Mapping[str, Any]:
    """Return an object of a peer's answer; empty where the peer states none."""
    return {} if value is None else mapping(name, value)


def _ranges(known: Mapping[str, Any], keys: Iterable[object]) -> Ranges:
    """Return the range of each key; null, or none, is no limit.

    Raises:
        ValidationError: a key is no text, or a range no pair of finite numbers with the lower one first.
    """
    ranges = dict.fromkeys([text("action key", key) for key in keys] or known, (-math.inf, math.inf))
    for key, pair in known.items():
        if pair is not None:
            if not isinstance(pair, list | tuple) or len(pair) != 2:
                raise ValidationError(f"the range of {shown(key)} must be a pair of numbers, not {shown(pair)}.")
            low = -math.inf if pair[0] is None else number(f"the lower end of {shown(key)}", pair[0])
            high = math.inf if pair[1] is None else number(f"the upper end of {shown(key)}", pair[1], above=low)
            ranges[key] = low, high
    return ranges
