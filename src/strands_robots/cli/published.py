"""Leaders on the mesh: one published from here, and one published elsewhere that drives a robot of this machine."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from strands_robots.cli.far import LEADER, SILENT_S, Wait, found, leads, reason_of
from strands_robots.cli.mesh import joined
from strands_robots.cli.output import Exit, Failure, Screen
from strands_robots.policies.base import Ranges, SpeedLimit, checked_action
from strands_robots.teleoperators.leader import UNBOUNDED_PER_S, LeaderFinished
from strands_robots.utils import ValidationError, number

NOBODY = "none"
"""The follower of a leader that is only published."""

_PAUSE_MAX_S = 0.04


class Glide:
    """Puts the frames of a stream into a robot no faster than a bound, from where it stands: no jump at the start.

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
        """Apply one frame; what the robot answers. Raises :class:`ValidationError` for a key it has not."""
        target = checked_action(action, self._bounds)
        now = self._now()
        # A pause may not be saved up for a jump.
        passed, self._at = min(now - self._at, _PAUSE_MAX_S), now
        self._last |= self._limit.limit(target, self._last, passed)
        return robot.send_action({key: self._last[key] for key in target})


class NoBody:
    """In the place of a follower where nobody follows here; a leader that needs to know of one is refused."""

    def body(self) -> NoBody:
        """Raises :class:`ValidationError`."""
        raise ValidationError(
            f"FOLLOWER must be a robot for this leader, which starts from where the robot stands, not {NOBODY}."
        )


def publish_far(
    screen: Screen, leader: str, peer: str, source: Any, wait: Wait, *, method: str, seconds: float | None, hz: float
) -> None:
    """Publish a leader on the mesh as ``peer``, for followers elsewhere, until it ends.

    Raises:
        Failure: there is no mesh, or nothing could be published.
    """
    from strands_robots.mesh.input import InputPublisher  # noqa: PLC0415 - loaded when something is led

    rate = number("hz", hz, low=1, high=1000)
    with joined(None, peer, "tool") as mesh:
        ending = _Ending(source)
        publisher = InputPublisher(mesh, ending, LEADER, method, rate)
        publisher.start()
        screen.say(f"{leader} is published as {peer}/{LEADER}. Ctrl-C ends it.")
        began = time.monotonic()

        def over() -> str:
            if ending.done:
                return "The leader has led to its end."
            return f"{seconds:g} s are over." if seconds is not None and time.monotonic() - began >= seconds else ""

        try:
            why = wait(over, getattr(source, "duration", None) or 0.0)
        finally:
            sent = publisher.stop()
    row = {"frames": sent["frames"], "errors": sent["errors"]}
    screen.data({"event": "ended", **row, "why": why})
    if not row["frames"]:
        raise Failure(f"{leader} gave no frame that could be published.", **row)
    screen.say(f"{why} {row['frames']} frames sent, {row['errors']} of the leader's unusable.", "green")


class _Ending:
    """A leader that says when it has ended; a follower elsewhere hears no more of it then."""

    def __init__(self, leader: Any) -> None:
        self.done = False
        self._leader = leader
        self.get_teleop_events = getattr(leader, "get_teleop_events", None)

    def get_action(self) -> dict[str, Any]:
        try:
            return dict(self._leader.get_action())
        except LeaderFinished:
            self.done = True
            raise


def follow_far(
    screen: Screen, peer: str, robot: Any, wait: Wait, *, seconds: float | None, max_speed: float
) -> tuple[str, dict[str, Any]]:
    """Let a leader that another peer publishes drive a robot of this machine: why it ended, and the counters.

    Args:
        screen: where it is told.
        peer: who publishes; its device is called ``leader``.
        robot: joined to the mesh.
        wait: as of :func:`lead_far`.
        seconds: end after so many.
        max_speed: whole joint ranges a second that the robot may cross.

    Raises:
        Failure: the mesh is off, nobody of that name is on it, or the robot may not move.
    """
    from strands_robots.mesh.input import InputReceiver  # noqa: PLC0415 - loaded when something is led

    if robot.mesh is None or not robot.mesh.alive:
        raise Failure("The mesh has no session, or STRANDS_MESH switches it off.")
    if not found(robot.mesh, peer):
        raise Failure(f"No peer {peer!r} is on the mesh of this machine.", Exit.SILENT)
    receiver = InputReceiver(robot.mesh, robot, peer, LEADER, Glide(robot.body(), max_speed))
    receiver.start()
    if receiver.start_refusal is not None:
        raise Failure(f"{peer} cannot lead: {receiver.start_refusal}.")
    try:
        leads(screen, f"{peer}/{LEADER}", robot.tool_name_str, receiver)
        return wait(_heard(peer, receiver, seconds), 0.0), receiver.stats
    finally:
        receiver.stop()


def _heard(peer: str, receiver: Any, seconds: float | None) -> Callable[[], str]:
    """Says why following is over, empty while it is not."""
    began = heard = time.monotonic()
    frames = 0

    def over() -> str:
        nonlocal heard, frames
        now, stats = time.monotonic(), receiver.stats
        if stats["frames_received"] != frames:
            frames, heard = stats["frames_received"], now
        if not stats["running"]:
            return f"The robot follows no more: {reason_of(stats)}."
        if now - heard > SILENT_S:
            return f"{peer} has been silent for {SILENT_S:g} s."
        return f"{seconds:g} s are over." if seconds is not None and now - began >= seconds else ""

    return over
