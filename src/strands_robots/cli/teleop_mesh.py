"""Teleoperation over the mesh: lead a peer, publish or follow a leader.

Authorization and lockout are the follower's, wherever its leader is.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from strands_robots.cli.network import mesh_peer, temporary_mesh_id
from strands_robots.cli.output import CliError, Exit, Screen, wait_until
from strands_robots.envelope import is_error, text_of
from strands_robots.policies.base import Ranges, SpeedLimit, checked_action, numbers
from strands_robots.teleoperators.leader import FULL_RANGES_PER_S, UNBOUNDED_PER_S, LeaderFinished, LeaderPolicy
from strands_robots.utils import ValidationError, number

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh
    from strands_robots.teleoperators.leader import BoundedLeader

MESH_PREFIX = "mesh:"
"""Prefix of the name of a leader or follower on the mesh."""

NO_FOLLOWER = "none"
"""Follower of a leader that is only published."""

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


@dataclass(frozen=True, slots=True)
class TeleopOptions:
    """Options of one teleoperation.

    Args:
        method: arm, gamepad or keyboard.
        seconds: end after so many; None for no limit.
        hz: frames a second.
        max_speed: whole joint ranges a second that the follower may cross.
    """

    method: str = "arm"
    seconds: float | None = None
    hz: float = 50.0
    max_speed: float = FULL_RANGES_PER_S


class RemoteFollower:
    """Peer of the mesh with the joints and ranges that it answered.

    Raises:
        CliError: it does not answer, or has no action that can be led.
    """

    def __init__(self, mesh: Mesh, peer: str) -> None:
        self._mesh = mesh
        self.peer = peer
        features, state = self.ask("features"), self.ask("state")
        robots = features.get("robots")
        if isinstance(robots, Mapping) and robots:
            name = next(iter(robots))
            self.bounds = _ranges(robots[name].get("actuators") or {}, ())
            self._joints = numbers((state.get("robots") or {}).get(name) or {})
        else:
            self.bounds = _ranges(features.get("ranges") or {}, features.get("action_features") or ())
            self._joints = numbers(state.get("joints") or {})
        if not self.bounds:
            raise CliError(f"{peer} reports no action key that could be led.")

    def body(self) -> RemoteFollower:
        """Return this object: the robot and its body are one here."""
        return self

    def get_joints(self) -> dict[str, float]:
        """Return the joints as the peer reported them."""
        return dict(self._joints)

    def ask(self, action: str, **fields: Any) -> dict[str, Any]:
        """Send a command; raise :class:`CliError` with the reason of a refusal."""
        reply = self._mesh.send(self.peer, {"action": action, **fields}, _ANSWER_S)
        result = reply.get("result")
        if reply.get("status") == "timeout":
            raise CliError(f"{self.peer} did not answer {action} within {_ANSWER_S:g} s.", Exit.SILENT)
        if not isinstance(result, dict):
            why = str(reply.get("error") or "no reason given").rstrip(".")
            raise CliError(f"{self.peer} refused {action}: {why}.")
        if action != "stop" and is_error(result):
            raise CliError(f"{self.peer} refused {action}: {text_of(result)}")
        return result

    def open_stream(self, leader: str) -> None:
        """Have the peer open the stream; retry until it knows the leader's id."""
        deadline = time.monotonic() + _OPEN_S
        while True:
            try:
                self.ask("teleop_receive", source_peer_id=leader, device_name=DEVICE)
            except CliError as refused:
                if "announced" not in refused.reason or time.monotonic() > deadline:
                    raise
                time.sleep(_ASK_EVERY_S)
            else:
                return

    def stop(self, screen: Screen) -> bool:
        """Stop the peer. Raises :class:`CliError` when it does not confirm that."""
        screen.say(f"Stopping {self.peer}...")
        answer = self.ask("stop")
        if answer.get("ok") is not True:
            raise CliError(f"{self.peer} did not confirm its stop: {answer.get('error') or 'no reason given'}.")
        screen.say(f"{self.peer} stands still.", "green")
        return True


class LimitedFollower:
    """Bounded-speed application of a stream, from the robot's present joints.

    Args:
        body: has ``bounds`` and ``get_joints``.
        max_speed: whole joint ranges a second.
        now: monotonic seconds.
    """

    def __init__(self, body: Any, max_speed: float, now: Callable[[], float] = time.monotonic) -> None:
        self._bounds: Ranges = dict(body.bounds)
        self._limit = SpeedLimit(self._bounds, number("max_speed", max_speed, above=0, high=20), UNBOUNDED_PER_S)
        self._last = {key: value for key, value in body.get_joints().items() if key in self._bounds}
        self._now = now
        self._at = now()

    def __call__(self, robot: Any, action: dict[str, float]) -> Any:
        """Apply a frame, return the answer; refuse an unknown key."""
        target = checked_action(action, self._bounds)
        now = self._now()
        # The time of a pause does not count, or the next frame could jump.
        passed, self._at = min(now - self._at, _PAUSE_MAX_S), now
        self._last |= self._limit.limit(target, self._last, passed)
        return robot.send_action({key: self._last[key] for key in target})


class NoFollower:
    """Stand-in for a robot where none follows here."""

    def body(self) -> NoFollower:
        """Raise :class:`ValidationError`."""
        raise ValidationError(
            f"FOLLOWER must be a robot for this leader, which starts from the robot's joints, not {NO_FOLLOWER}."
        )


class _PublishedLeader:
    """Leader that notes its end; its followers receive nothing more then."""

    def __init__(self, leader: Any) -> None:
        self.finished = False
        self._leader = leader
        self.get_teleop_events = getattr(leader, "get_teleop_events", None)

    def get_action(self) -> dict[str, Any]:
        try:
            return dict(self._leader.get_action())
        except LeaderFinished:
            self.finished = True
            raise


def peer_in_reach(mesh: Mesh, peer: str) -> bool:
    """Return whether a peer is seen in time, which is longer with stated endpoints."""
    from strands_robots.mesh.core import wait_for_peer  # noqa: PLC0415 - loaded when it is used
    from strands_robots.mesh.transport.zenoh_config import discovery_timeout  # noqa: PLC0415 - as above

    return wait_for_peer(mesh, peer, discovery_timeout(_PEER_S))


def check_keys(follower: str, leader: Any, bounds: Ranges) -> None:
    """Refuse a leader of joints that the follower lacks, before anything moves."""
    unknown = [key for key in getattr(leader, "keys", ()) if key not in bounds]
    if unknown:
        raise ValidationError(f"{follower} has {', '.join(bounds)}, not {', '.join(unknown)}, which the leader leads.")


def announce(screen: Screen, leader: str, follower: str, source: Any) -> None:
    """Print which leader leads which follower, and its keys."""
    screen.say(f"{leader} leads {follower}. Ctrl-C stops the follower.")
    for name, up, down in getattr(source, "help", []):
        screen.say(f"  {up} and {down} move {name}")


def lead_peer(
    screen: Screen,
    leader: str,
    peer: str,
    connected: Callable[[Any], AbstractContextManager[Any]],
    options: TeleopOptions,
) -> None:
    """Let a leader drive a peer of the mesh until it ends, then stop the peer.

    Args:
        screen: where it is reported.
        leader: name of the leader on the screen.
        peer: the follower's id.
        connected: returns the leader for a body that has ``bounds`` and ``get_joints``.
        options: of the teleoperation.

    Raises:
        CliError: it was refused, it failed, or the follower did not confirm its stop.
    """
    from strands_robots.mesh.input import InputPublisher  # noqa: PLC0415 - loaded when it is used
    from strands_robots.teleoperators.leader import BoundedLeader  # noqa: PLC0415 - as above

    rate = number("hz", options.hz, low=1, high=1000)
    speed = number("max_speed", options.max_speed, above=0, high=20)
    with mesh_peer(None, temporary_mesh_id("lead"), "tool") as mesh:
        if not peer_in_reach(mesh, peer):
            raise CliError(f"No peer {peer!r} is on the mesh of this machine.", Exit.SILENT)
        follower = RemoteFollower(mesh, peer)
        with connected(follower) as source:
            check_keys(peer, source, follower.bounds)
            policy = LeaderPolicy(source, device=DEVICE, method=options.method, max_speed=speed, period=1 / rate)
            bounded = BoundedLeader(policy, follower.get_joints(), follower.bounds)
            publisher = InputPublisher(mesh, bounded, DEVICE, options.method, rate)
            follower.open_stream(mesh.peer_id)
            counters: dict[str, Any] = {}
            try:
                publisher.start()
                announce(screen, leader, peer, source)
                over = _leading_over(follower, mesh.peer_id, bounded, options.seconds, counters)
                why = wait_until(screen, over, getattr(source, "duration", None) or 0.0)
            finally:
                # The follower is stopped first; publishing ends even when it does not answer.
                try:
                    stopped = follower.stop(screen)
                finally:
                    sent = publisher.stop()
    row = {"frames": sent["frames"], "errors": policy.errors, "applied": counters.get("frames_received", 0)}
    screen.data({"event": "ended", **row, "why": why, "stopped": stopped})
    if bounded.error:
        raise CliError(f"The leader failed: {bounded.error}", **row)
    if why.startswith(peer):
        raise CliError(f"Ended: {why}.", **row)
    _report_sent(screen, why, row)


def publish_leader(screen: Screen, leader: str, peer: str, source: Any, options: TeleopOptions) -> None:
    """Publish a leader on the mesh as ``peer`` until it ends.

    Raises:
        CliError: there is no mesh, or nothing could be published.
    """
    from strands_robots.mesh.input import InputPublisher  # noqa: PLC0415 - loaded when it is used

    rate = number("hz", options.hz, low=1, high=1000)
    with mesh_peer(None, peer, "tool") as mesh:
        published = _PublishedLeader(source)
        publisher = InputPublisher(mesh, published, DEVICE, options.method, rate)
        publisher.start()
        screen.say(f"{leader} is published as {peer}/{DEVICE}. Ctrl-C ends it.")
        began = time.monotonic()

        def over() -> str:
            return "The leader has finished." if published.finished else _time_over(began, options.seconds)

        try:
            why = wait_until(screen, over, getattr(source, "duration", None) or 0.0)
        finally:
            sent = publisher.stop()
    row = {"frames": sent["frames"], "errors": sent["errors"]}
    screen.data({"event": "ended", **row, "why": why})
    if not row["frames"]:
        raise CliError(f"{leader} gave no frame that could be published.", **row)
    _report_sent(screen, why, row)


def follow_peer(screen: Screen, peer: str, robot: Any, options: TeleopOptions) -> tuple[str, dict[str, Any]]:
    """Let a leader that another peer publishes drive a robot of this machine.

    Args:
        screen: where it is reported.
        peer: the publisher; its device is called ``leader``.
        robot: joined to the mesh.
        options: of the teleoperation.

    Returns:
        Why it ended, and the counters of the stream.

    Raises:
        CliError: the mesh is off, the peer is not on it, or the robot may not move.
    """
    from strands_robots.mesh.input import InputReceiver  # noqa: PLC0415 - loaded when it is used

    if robot.mesh is None or not robot.mesh.alive:
        raise CliError("The mesh has no session, or STRANDS_MESH switches it off.")
    if not peer_in_reach(robot.mesh, peer):
        raise CliError(f"No peer {peer!r} is on the mesh of this machine.", Exit.SILENT)
    receiver = InputReceiver(robot.mesh, robot, peer, DEVICE, LimitedFollower(robot.body(), options.max_speed))
    receiver.start()
    if receiver.start_refusal is not None:
        raise CliError(f"{peer} cannot lead: {receiver.start_refusal}.")
    try:
        announce(screen, f"{peer}/{DEVICE}", robot.tool_name_str, receiver)
        return wait_until(screen, _following_over(peer, receiver, options.seconds)), receiver.stats
    finally:
        receiver.stop()


def _leading_over(
    follower: RemoteFollower, leader: str, bounded: BoundedLeader, seconds: float | None, counters: dict[str, Any]
) -> Callable[[], str]:
    """Return a function that gives the reason why leading is over, or None."""
    began = time.monotonic()
    asked_at = answered_at = began

    def over() -> str:
        nonlocal asked_at, answered_at
        now = time.monotonic()
        if bounded.done.is_set():
            return "The leader has finished."
        if (ended := _time_over(began, seconds)) or now - asked_at < _ASK_EVERY_S:
            return ended
        asked_at = now
        try:
            streams = follower.ask("teleop_status").get("streams") or []
        except CliError as silent:
            return f"{follower.peer} is out of reach: {silent.reason}" if now - answered_at > _SILENT_S else ""
        answered_at = time.monotonic()
        counters.update(next((each for each in streams if each.get("source") == leader), {"running": False}))
        return "" if counters.get("running") else f"{follower.peer} stopped following: {_stream_end(counters)}"

    return over


def _following_over(peer: str, receiver: Any, seconds: float | None) -> Callable[[], str]:
    """Return a function that says why following is over, empty while it is not."""
    began = received = time.monotonic()
    frames = 0

    def over() -> str:
        nonlocal received, frames
        now, stats = time.monotonic(), receiver.stats
        if stats["frames_received"] != frames:
            frames, received = stats["frames_received"], now
        if not stats["running"]:
            return f"The robot stopped following: {_stream_end(stats)}."
        return (
            f"{peer} has been silent for {_SILENT_S:g} s." if now - received > _SILENT_S else _time_over(began, seconds)
        )

    return over


def _time_over(began: float, seconds: float | None) -> str:
    return f"{seconds:g} s are over." if seconds is not None and time.monotonic() - began >= seconds else ""


def _stream_end(counters: Mapping[str, Any]) -> str:
    """Return why a stream ended, from the follower's counters."""
    return next((text for name, text in _REASONS.items() if counters.get(name)), _STOPPED)


def _report_sent(screen: Screen, why: str, row: Mapping[str, Any]) -> None:
    screen.say(f"{why} {row['frames']} frames sent, {row['errors']} of the leader's unusable.", "green")


def _ranges(known: Mapping[str, Any], keys: Any) -> Ranges:
    unbounded = (float("-inf"), float("inf"))
    ranges = dict.fromkeys([str(key) for key in keys] or [str(key) for key in known], unbounded)
    for key, pair in known.items():
        if isinstance(pair, list | tuple) and len(pair) == 2:
            ranges[str(key)] = (float(pair[0]), float(pair[1]))
    return ranges
