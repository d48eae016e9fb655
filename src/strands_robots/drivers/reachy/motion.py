"""One move at a time, and the stop.

The daemon runs every move that it is asked for, together, and lets them fight. So the order is kept here: a new motion
stops the one before it, whatever it is; each write asks its permit under the lock of the write; and a halt voids all
permits, waits for the write in flight, and stops every move that the daemon says is running.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from strands_robots import settings
from strands_robots.contract import Observer, RolloutEvent, Unsubscribe
from strands_robots.drivers.reachy.connection import Connection
from strands_robots.drivers.reachy.envelope import STREAM_HZ, Target
from strands_robots.drivers.reachy.gestures import Frames, Gesture, ramp
from strands_robots.drivers.reachy.moves import DaemonMoves
from strands_robots.drivers.reachy.pose import HeadPose
from strands_robots.drivers.reachy.rest import DaemonError, DaemonFault, DaemonUnreachable
from strands_robots.drivers.reachy.updates import End, MoveUpdates
from strands_robots.envelope import error, success
from strands_robots.safety.gate import MotionGate, MotionRefused, Permit
from strands_robots.safety.stopping import StopVerdict, halt_each
from strands_robots.utils import ValidationError

logger = logging.getLogger(__name__)

FRAME_S = 1 / STREAM_HZ
POLL_S = 0.1
REST_MOVE_LONGEST_S = 600.0

Reached = Callable[[], str]
"""Why a finished move is not where it should be; empty when it is."""


@dataclass(eq=False)
class Motion:
    """One motion that runs, or the last one that ran. ``uuid`` only for a move of the daemon, ``brief`` for a frame."""

    name: str
    permit: Permit
    of_daemon: bool = False
    brief: bool = True
    uuid: str = ""
    state: str = "running"
    detail: str = ""
    started: float = field(default_factory=time.monotonic)
    cancelled: threading.Event = field(default_factory=threading.Event)
    posted: threading.Event = field(default_factory=threading.Event)
    done: threading.Event = field(default_factory=threading.Event)

    @property
    def running(self) -> bool:
        return not self.done.is_set()

    def still_permitted(self) -> None:
        """Raises :class:`MotionRefused` once halted, locked or replaced."""
        if self.cancelled.is_set() or not self.permit.valid:
            raise MotionRefused(error(f"{self.name} was halted."))

    def facts(self) -> dict[str, str]:
        return {"name": self.name, "state": self.state, "detail": self.detail}


class Motions:
    """The motions of one robot."""

    def __init__(self, connection: Connection, gate: MotionGate, robot: str, *, automatic_body_yaw: bool) -> None:
        self._connection, self._gate, self._robot = connection, gate, robot
        self._moves = DaemonMoves(connection)
        self._automatic_body_yaw = automatic_body_yaw
        self._turn = threading.Lock()
        self._write = threading.Lock()
        self._slot = 0.0
        self._current: Motion | None = None
        self._sent = Target()
        self._sent_on = 0
        self._told_yaw_on = 0
        self._observers: list[Observer] = []
        self.frames_sent = 0
        self.last_write = 0.0

    @property
    def current(self) -> Motion | None:
        """The running motion, else the last one, else None."""
        return self._current

    @property
    def sent_head(self) -> HeadPose | None:
        """The head pose that was last sent and still counts."""
        return self._sent.head if self._sent_on == self._connection.connects else None

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Tell ``observer`` of every motion's start and end."""
        self._observers.append(observer)
        return lambda: self._observers.remove(observer) if observer in self._observers else None

    def present(self) -> Target:
        """Where the robot is: what was last sent while nobody else moved it, else what it measures."""
        feed = self._connection.feed
        joints = feed.fresh_joints
        measured = Target(feed.pose(), joints.body_yaw if joints else None, (joints.antennas if joints else None))
        if self._sent_on != self._connection.connects:
            self._sent = Target()
        return self._sent.over(measured)

    def stream(self, target: Target, name: str) -> Target:
        """Send one frame now; a longer way is cut to what one frame may do. Returns what was sent."""
        with self._taken(name) as motion:
            start = self.present()
            steps = target.step_from(start)
            sent = start.toward(target, 1 / steps) if steps > 1 else target
            self._pace()
            self._send(motion, sent)
            self._end(motion, "completed")
            return sent

    def go(self, target: Target, name: str) -> bool:
        """Go there: at once when one frame may, else by a ramp whose first frame is sent now. True for a ramp."""
        with self._taken(name) as motion:
            start = self.present()
            far = target.step_from(start) > 1
            self._play(motion, ramp(start, target) if far else iter((target,)))
            return far

    def gesture(self, frames: Gesture, name: str) -> None:
        """Play frames at 50 Hz; the first one is sent now."""
        with self._taken(name) as motion:
            self._play(motion, frames(self.present()))

    def daemon_move(self, name: str, path: str, *, reached: Reached, before: Callable[[], None] | None = None) -> str:
        """Let the daemon play a move and watch it end; returns its uuid at once.

        ``before`` runs once the turn is ours and earlier motions are stopped. Raises :class:`DaemonError`.
        """
        with self._taken(name, of_daemon=True, limp=before is not None) as motion:
            updates = None
            try:
                updates = MoveUpdates(self._connection.host, self._connection.port)
                if before is not None:
                    before()
                motion.still_permitted()
                motion.uuid = _uuid(path, self._connection.rest.post(path))
            except Exception as exc:
                if updates is not None:
                    updates.close()
                motion.posted.set()
                self._end(motion, "error", str(exc))
                raise
            motion.brief = False
            motion.posted.set()
            self._forget()
            try:
                motion.still_permitted()
            except MotionRefused:
                updates.close()
                self._moves.stop(motion.uuid, time.monotonic() + 1.0)
                self._end(motion, "stopped")
                raise
            threading.Thread(
                target=self._watch, args=(motion, updates, reached), name="reachy-move", daemon=True
            ).start()
            return motion.uuid

    def torque(self, change: Callable[[], None], name: str) -> None:
        """Run ``change``, a write of the motors' torque, in its turn; what moves is stopped first."""
        with self._taken(name, limp=True) as motion:
            try:
                with self._write:  # so that a halt waits for it as for a frame
                    motion.still_permitted()
                    change()
            except Exception as exc:
                self._end(motion, "error", str(exc))
                raise
            self._forget()
            self._end(motion, "completed")

    def halt(self, reason: str) -> StopVerdict:
        """Stop every motion source and say what it did. Any thread, never waits for a turn."""
        self._gate.revoke()
        deadline = time.monotonic() + 0.85 * settings.number("STRANDS_HALT_DEADLINE_S")
        motion = self._current
        running = motion is not None and motion.running
        if motion is not None and running:
            motion.detail = motion.detail or reason
            motion.cancelled.set()
        name = motion.name if motion is not None and running and not motion.of_daemon else "stream"
        sources: dict[str, Callable[[], object]] = {
            name: lambda: self._still(motion if running else None, deadline),
            "moves of the daemon": lambda: self._stop_moves(motion if running else None, deadline),
        }
        return halt_each(sources)

    # Turns.

    def moving(self) -> bool:
        """A motion of ours runs, or the daemon plays a move, by its own word now. Raises :class:`DaemonError`."""
        motion = self._current
        return (motion is not None and motion.running) or bool(self._moves.running(time.monotonic() + 1.0))

    @contextmanager
    def _taken(self, name: str, *, of_daemon: bool = False, limp: bool = False) -> Iterator[Motion]:
        """The turn, with a new motion once nothing else moves. Leave comes first: a stop is newer than what waits."""
        permit = self._gate.permit(name)
        with self._turn:
            permit.check()
            refusal = self._connection.refusal()
            if refusal is not None:
                raise MotionRefused(error(f"{name} refused: {refusal}.", connected=self._connection.alive))
            if not limp and self._connection.motor_mode == "disabled":
                raise MotionRefused(error(f"{name} refused: the motors are disabled; first wakeUp or enableMotors."))
            self._replace(name)
            motion = self._current = Motion(name, permit, of_daemon)
            try:
                self._ready(motion)
            except (MotionRefused, DaemonUnreachable) as exc:
                self._end(motion, "stopped" if isinstance(exc, MotionRefused) else "error", str(exc))
                raise
            yield motion

    def _ready(self, motion: Motion) -> None:
        """What a new connection has to be told before its first motion."""
        motion.still_permitted()
        if self._told_yaw_on != self._connection.connects:
            with self._write:
                self._connection.link().send_automatic_body_yaw(self._automatic_body_yaw)
            self._told_yaw_on = self._connection.connects

    def _replace(self, name: str) -> None:
        """Stop what runs: our own motion, and the moves that somebody else had the daemon play."""
        before = self._current
        ours = before is not None and before.running
        if before is not None and ours:
            before.detail = f"replaced by {name}"
            before.cancelled.set()
        moves = set(self._connection.polled.moves)
        if before is not None and before.uuid:
            if ours:
                moves.add(before.uuid)
            else:
                moves.discard(before.uuid)
        for uuid in moves:
            self._moves.stop(uuid, time.monotonic() + 2.0)
            self._forget()
        if before is not None and ours and not before.done.wait(2.0):
            raise MotionRefused(error(f"{name} refused: {before.name} did not end.", running=before.name))

    def _end(self, motion: Motion, state: str, detail: str = "") -> None:
        if motion.done.is_set():
            return
        motion.state, motion.detail = state, detail or motion.detail
        motion.done.set()
        if motion.brief and state == "completed":
            return
        self._tell(
            RolloutEvent(
                kind="finished",
                robot=self._robot,
                instruction=motion.name,
                policy="reachy",
                elapsed_s=time.monotonic() - motion.started,
                state=state,
                error=motion.detail,
            )
        )

    def _tell(self, event: RolloutEvent) -> None:
        for observer in tuple(self._observers):
            observer(event)

    # Frames.

    def _pace(self) -> None:
        """Keep frames 20 ms apart, with a quarter of that for a caller's own jitter."""
        wait = self._slot - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        self._slot = max(self._slot + FRAME_S, time.monotonic() + 0.75 * FRAME_S)

    def _send(self, motion: Motion, target: Target) -> None:
        try:
            with self._write:
                motion.still_permitted()
                self._connection.link().send_target(target)
                self.last_write = time.monotonic()
        except (DaemonUnreachable, MotionRefused) as exc:
            self._end(motion, "stopped" if isinstance(exc, MotionRefused) else "error", str(exc))
            raise
        self.frames_sent += 1
        self._sent = target.over(self.present())
        self._sent_on = self._connection.connects

    def _play(self, motion: Motion, frames: Frames) -> None:
        self._pace()
        self._send(motion, next(frames))
        second = next(frames, None)
        motion.brief = second is None
        if second is None:
            self._end(motion, "completed")
            return
        threading.Thread(target=self._run, args=(motion, second, frames), name="reachy-frames", daemon=True).start()

    def _run(self, motion: Motion, target: Target | None, frames: Frames) -> None:
        try:
            self._stream_frames(motion, target, frames)
        except MotionRefused:
            self._end(motion, "stopped")
        except DaemonUnreachable as exc:
            logger.warning("%s: %s ended early: %s", self._robot, motion.name, exc)
        finally:
            self._end(motion, "error", "its frames ended with a fault; the log has it")

    def _stream_frames(self, motion: Motion, target: Target | None, frames: Frames) -> None:
        due = time.monotonic()
        while target is not None:
            due += FRAME_S
            if motion.cancelled.wait(max(0.0, due - time.monotonic())):
                self._end(motion, "stopped")
                return
            self._send(motion, target)
            # A thread that was held up goes on from now: a burst of late frames would be a jump.
            due = max(due, time.monotonic() - FRAME_S)
            target = next(frames, None)
        self._slot = time.monotonic() + 0.75 * FRAME_S
        self._end(motion, "completed")

    def _forget(self) -> None:
        """Somebody else moves the robot: only measuring says where it is."""
        self._sent = Target()

    # The daemon's moves.

    def _watch(self, motion: Motion, updates: MoveUpdates, reached: Reached) -> None:
        """Follow a move of the daemon to its end, and look whether it arrived: its word `completed` proves nothing."""
        end: End | None = None
        deadline = time.monotonic() + REST_MOVE_LONGEST_S
        try:
            while end is None and not motion.cancelled.is_set() and time.monotonic() < deadline:
                end = updates.wait(motion.uuid, POLL_S)
            if end is not None and end.state == "completed":
                # Joints come at 37 to 50 Hz: a tenth of a second later they show the end.
                motion.cancelled.wait(POLL_S)
                why = reached()
                end = End("error", why) if why else end
        except (DaemonError, ValidationError) as exc:
            end = End("unknown", str(exc))
        finally:
            updates.close()
        if motion.cancelled.is_set():
            self._end(motion, "stopped")
        elif end is None:
            self._end(motion, "unknown", f"no end was told in {REST_MOVE_LONGEST_S:g} s")
        else:
            self._end(motion, end.state, end.detail or ("somebody else stopped it" if end.state == "stopped" else ""))

    def _still(self, motion: Motion | None, deadline: float) -> object:
        """After this no frame of a permit given before reaches the link. None when nothing was streaming."""
        if not self._write.acquire(timeout=max(0.0, deadline - time.monotonic())):
            return error("a write to the daemon does not return", stopped=False)
        self._write.release()
        streaming = motion is not None and not motion.of_daemon
        return success("no frame is sent any more", stopped=True) if streaming else None

    def _stop_moves(self, motion: Motion | None, deadline: float) -> object:
        """List the running moves, stop each, read every answer, and list again. None when there was none."""
        if motion is not None and motion.of_daemon:
            motion.posted.wait(max(0.0, deadline - time.monotonic()))
        if self._connection.connects == 0 and (motion is None or not motion.of_daemon):
            # Never connected: nothing was ever asked of this daemon.
            return None
        asked, left = self._moves.stop_all(motion.uuid if motion is not None else "", deadline)
        if not asked:
            return None
        self._forget()
        if left:
            return error(f"the daemon still runs {', '.join(sorted(left))}", stopped=False)
        return success(f"stopped {len(asked)} moves", stopped=True, moves=sorted(asked))


def _uuid(path: str, answer: object) -> str:
    if not isinstance(answer, dict) or not isinstance(answer.get("uuid"), str):
        raise DaemonFault(f"POST {path}: the answer has no uuid.")
    return str(answer["uuid"])


def head_distance(a: HeadPose | None, b: HeadPose | None) -> float | None:
    """Radians between two heads, None where one is unknown."""
    return a.angle_to(b) if a is not None and b is not None else None
