"""A follower that is a peer of the mesh, led over its input stream: authorization and lockout are the follower's."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

from strands_robots.cli.mesh import joined, own_id
from strands_robots.cli.output import Exit, Failure, Screen
from strands_robots.envelope import is_error, text_of
from strands_robots.policies.base import Ranges, numbers
from strands_robots.teleoperators.leader import LeaderPolicy
from strands_robots.utils import ValidationError, number

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh
    from strands_robots.teleoperators.leader import BoundedLeader

MESH = "mesh:"
"""What stands before the name of a follower on the mesh."""

LEADER = "leader"

_FOUND_S, _ANSWER_S, _OPEN_S = 3.0, 5.0, 3.0
_LOOK_S = 0.05
_ASK_EVERY_S = 0.25
SILENT_S = 2.0
_HALTED = "it was halted or locked"
_REASONS = {
    "rejected_lockout": _HALTED,
    "rejected_expired": "the stream outlived its lifetime",
    "rejected_source": "another session took the leader's name",
}

Wait = Callable[[Callable[[], str], float], str]


class FarBody:
    """What a leader has to know of its follower: where it stands, and its ranges, as it answered."""

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
            raise Failure(f"{peer} says of no action key how it could be led.")

    def body(self) -> FarBody:
        """The robot and its body are one here."""
        return self

    def get_joints(self) -> dict[str, float]:
        """Where it stood when it was asked."""
        return dict(self._joints)

    def ask(self, action: str, **fields: Any) -> dict[str, Any]:
        """Send a command. Raises :class:`Failure` with the follower's own sentence when it refuses."""
        reply = self._mesh.send(self.peer, {"action": action, **fields}, _ANSWER_S)
        result = reply.get("result")
        if reply.get("status") == "timeout":
            raise Failure(f"{self.peer} did not answer {action} within {_ANSWER_S:g} s.", Exit.SILENT)
        if not isinstance(result, dict):
            why = str(reply.get("error") or "no reason given").rstrip(".")
            raise Failure(f"{self.peer} refused {action}: {why}.")
        if action != "stop" and is_error(result):
            raise Failure(f"{self.peer} refused {action}: {text_of(result)}")
        return result


def found(mesh: Mesh, peer: str) -> bool:
    """Whether a peer is seen in time, which is longer with stated endpoints."""
    from strands_robots.mesh.core import wait_for_peer  # noqa: PLC0415 - loaded when something is led
    from strands_robots.mesh.transport.zenoh_config import discovery_timeout  # noqa: PLC0415 - as above

    return wait_for_peer(mesh, peer, discovery_timeout(_FOUND_S))


def known_to(follower: str, leader: Any, bounds: Ranges) -> None:
    """Refuse a leader that leads what the follower has not. Raises :class:`ValidationError`, before anything moves."""
    unknown = [key for key in getattr(leader, "keys", ()) if key not in bounds]
    if unknown:
        raise ValidationError(f"{follower} has {', '.join(bounds)}, not {', '.join(unknown)}, which the leader leads.")


def leads(screen: Screen, leader: str, follower: str, source: Any) -> None:
    """Say who leads whom, and by which keys."""
    screen.say(f"{leader} leads {follower}. Ctrl-C stops the follower.")
    for name, up, down in getattr(source, "help", []):
        screen.say(f"  {up} and {down} move {name}")


def lead_far(
    screen: Screen,
    leader: str,
    peer: str,
    led: Callable[[Any], AbstractContextManager[Any]],
    wait: Wait,
    *,
    method: str,
    seconds: float | None,
    hz: float,
    max_speed: float,
) -> None:
    """Let a leader drive a peer of the mesh to the end, and stop the peer whatever happens.

    Args:
        screen: where it is told.
        leader: what the leader is called on the screen.
        peer: the follower's id.
        led: gives the leader for a body that has ``bounds`` and ``get_joints``.
        wait: waits until the callable it is given says why it is over, showing the seconds that are over.
        method: arm, gamepad or keyboard.
        seconds: end after so many.
        hz: frames a second.
        max_speed: whole joint ranges a second that the follower may cross.

    Raises:
        Failure: it was refused, it failed, or the follower did not confirm its stop.
    """
    from strands_robots.mesh.input import InputPublisher  # noqa: PLC0415 - as above
    from strands_robots.teleoperators.leader import BoundedLeader  # noqa: PLC0415 - loaded when something is led

    rate, speed = number("hz", hz, low=1, high=1000), number("max_speed", max_speed, above=0, high=20)
    with joined(None, own_id("lead"), "tool") as mesh:
        if not found(mesh, peer):
            raise Failure(f"No peer {peer!r} is on the mesh of this machine.", Exit.SILENT)
        far = FarBody(mesh, peer)
        with led(far) as source:
            known_to(peer, source, far.bounds)
            policy = LeaderPolicy(source, device=LEADER, method=method, max_speed=speed, period=1 / rate)
            bounded = BoundedLeader(policy, far.get_joints(), far.bounds)
            publisher = InputPublisher(mesh, bounded, LEADER, method, rate)
            _open(far, mesh.peer_id)
            told: dict[str, Any] = {}
            try:
                publisher.start()
                leads(screen, leader, peer, source)
                why = wait(_end(far, mesh.peer_id, bounded, seconds, told), getattr(source, "duration", None) or 0.0)
            finally:
                # The follower first, and the frames end even where it does not answer.
                try:
                    stopped = _stop(screen, far)
                finally:
                    sent = publisher.stop()
    row = {"frames": sent["frames"], "errors": policy.errors, "applied": told.get("frames_received", 0)}
    screen.data({"event": "ended", **row, "why": why, "stopped": stopped})
    if bounded.error:
        raise Failure(f"The leader failed: {bounded.error}", **row)
    if why.startswith(peer):
        raise Failure(f"Ended: {why}.", **row)
    screen.say(f"{why} {row['frames']} frames sent, {row['errors']} of the leader's unusable.", "green")


def reason_of(stats: Mapping[str, Any]) -> str:
    """Why a stream that has ended did, from the follower's counters."""
    return next((text for name, text in _REASONS.items() if stats.get(name)), _HALTED)


def _open(far: FarBody, leader: str) -> None:
    """Have the follower open the stream; it may not have heard yet who we are."""
    deadline = time.monotonic() + _OPEN_S
    while True:
        try:
            far.ask("teleop_receive", source_peer_id=leader, device_name=LEADER)
        except Failure as refused:
            if "announced" not in refused.reason or time.monotonic() > deadline:
                raise
            time.sleep(_ASK_EVERY_S)
        else:
            return


def _end(
    far: FarBody, leader: str, bounded: BoundedLeader, seconds: float | None, told: dict[str, Any]
) -> Callable[[], str]:
    """Says why it is over, empty while it is not; asks the follower for its counters a few times a second."""
    began = time.monotonic()
    asked = heard = began

    def over() -> str:
        nonlocal asked, heard
        now = time.monotonic()
        if bounded.done.is_set():
            return "The leader has led to its end."
        if seconds is not None and now - began >= seconds:
            return f"{seconds:g} s are over."
        if now - asked < _ASK_EVERY_S:
            return ""
        asked = now
        try:
            streams = far.ask("teleop_status").get("streams") or []
        except Failure as silent:
            return f"{far.peer} is out of reach: {silent.reason}" if now - heard > SILENT_S else ""
        heard = time.monotonic()
        told.update(next((each for each in streams if each.get("source") == leader), {"running": False}))
        if told.get("running"):
            return ""
        return f"{far.peer} follows no more: {reason_of(told)}"

    return over


def _stop(screen: Screen, far: FarBody) -> bool:
    screen.say(f"Stopping {far.peer}...")
    answer = far.ask("stop")
    if answer.get("ok") is not True:
        raise Failure(f"{far.peer} did not confirm its stop: {answer.get('error') or 'no reason given'}.")
    screen.say(f"{far.peer} stands still.", "green")
    return True


def _ranges(known: Mapping[str, Any], keys: Any) -> Ranges:
    unbounded = (float("-inf"), float("inf"))
    found = dict.fromkeys([str(key) for key in keys] or [str(key) for key in known], unbounded)
    for key, pair in known.items():
        if isinstance(pair, list | tuple) and len(pair) == 2:
            found[str(key)] = (float(pair[0]), float(pair[1]))
    return found
