"""Motions of one Reachy Mini, one at a time, and their stop.

The daemon runs every move that it is asked for at the same time, and lets them fight. So the order is kept here: a new
motion stops the one before it; each write checks its permit under the lock of the write; and a halt voids all permits,
waits for the write in flight, and stops every move that the daemon reports as running.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from strands_robots import settings
from strands_robots.bounded_json import SMALL_BYTES, json_object
from strands_robots.contract import RolloutEvent
from strands_robots.drivers.reachy.connection import RUNNING_PATH, Connection, running_moves
from strands_robots.drivers.reachy.links import open_socket
from strands_robots.drivers.reachy.rest import (
    DaemonError,
    DaemonFaultError,
    DaemonUnreachableError,
    StopRound,
    StopRounds,
)
from strands_robots.drivers.reachy.target import STREAM_HZ, Frames, Gesture, HeadPose, Target, ramp
from strands_robots.envelope import error, success
from strands_robots.policies.rollout import RolloutObservers
from strands_robots.safety.gate import MotionGate, MotionRefused, MotionRequest, Permit
from strands_robots.safety.stopping import StopVerdict, halt_each
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError

logger = stop_logger(__name__)

FRAME_S = 1 / STREAM_HZ
JITTER_SHARE = 0.75
"""Part of a frame's time that frames must be apart; the rest is for a caller's own jitter."""
POLL_S = 0.1
REPLACE_S = 2.0
"""Longest time that the motion before may take to end, in seconds."""
REST_MOVE_LONGEST_S = 600.0

STOP_PATH, UPDATES_PATH = "/api/move/stop", "/api/move/ws/updates"
MOVE_ENDS = {"move_completed": "completed", "move_failed": "error", "move_cancelled": "stopped"}

ArrivalCheck = Callable[[], str]
"""Returns the reason why a finished move is not where it should be; empty when it is."""


@dataclass(eq=False)
class ReachyMotion:
    """One motion that runs, or the last one that ran.

    ``uuid`` is set for a move of the daemon only; ``brief`` marks a motion of a single frame.
    """

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

    def check(self) -> None:
        """Raise :class:`MotionRefused` once halted, locked or replaced."""
        if self.cancelled.is_set() or not self.permit.valid:
            raise MotionRefused(error(f"{self.name} was halted."))

    def facts(self) -> dict[str, str]:
        """Return name, state and detail."""
        return {"name": self.name, "state": self.state, "detail": self.detail}


class DaemonMoves:
    """Moves that the daemon plays, over the stop's own connection.

    A ``deadline`` is a moment of ``time.monotonic``; every method raises :class:`DaemonError`.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def running(self, deadline: float) -> frozenset[str]:
        """Return the uuids that run now."""
        return running_moves(self._connection.stop_rest.get(RUNNING_PATH, deadline - time.monotonic()))

    def stop(self, uuid: str, deadline: float) -> None:
        """Stop one; the daemon answers a move that has ended meanwhile with a bare 500."""
        try:
            self._connection.stop_rest.post(STOP_PATH, {"uuid": uuid}, deadline - time.monotonic())
        except DaemonFaultError:
            if uuid in self.running(deadline):
                raise

    def stop_all(self, own: str, deadline: float) -> object:
        """Stop the move ``own`` (may be empty), then every other one, and list again.

        Returns:
            None where no move ran, else an envelope: ``stopped`` is False where a move is known to run on, and None
            where the daemon does not say.
        """
        asked: set[str] = set()
        failed: dict[str, str] = {}
        doubt = ""

        def stop(uuid: str) -> None:
            asked.add(uuid)
            try:
                if time.monotonic() >= deadline:
                    raise DaemonUnreachableError("no time was left")
                self.stop(uuid, deadline)
            except (DaemonError, ValidationError) as exc:
                failed[uuid] = str(exc)

        def listed() -> frozenset[str]:
            nonlocal doubt
            try:
                return self.running(deadline)
            except (DaemonError, ValidationError) as exc:
                doubt = doubt or str(exc)
                return frozenset(failed)

        if own:
            stop(own)
        for uuid in listed() - asked:
            stop(uuid)
        if self._connection.alive:
            try:
                self._connection.link().stop_move()
            except DaemonError as exc:
                doubt = doubt or str(exc)
        left = listed() if asked else frozenset()
        if left:
            why = "; ".join(sorted({failed[uuid] for uuid in left if uuid in failed}))
            return error(f"the daemon still runs {', '.join(sorted(left))}{why and ': ' + why}", stopped=False)
        if doubt:
            return error(f"the daemon does not say whether a move runs: {doubt}", stopped=None)
        return success(f"stopped {len(asked)} moves", stopped=True, moves=sorted(asked)) if asked else None


@dataclass(frozen=True, slots=True)
class MoveEnd:
    """End of a move: completed, error, stopped or unknown, and the daemon's message."""

    state: str
    detail: str = ""


class MoveUpdates:
    """Subscription to the only place where the daemon reports how a move ended.

    It is opened before a move is asked for, so that not even a short one is missed.
    """

    def __init__(self, host: str, api_port: int) -> None:
        self._stack = contextlib.ExitStack()
        self._socket: Any = open_socket(self._stack, host, api_port, UPDATES_PATH)

    def wait(self, uuid: str, within_s: float) -> MoveEnd | None:
        """Return the end of that move, or None when it does not come in time.

        Raises:
            DaemonUnreachableError: the subscription broke.
        """
        deadline = time.monotonic() + within_s
        while (left := deadline - time.monotonic()) > 0:
            try:
                update = json_object(self._socket.recv(left), SMALL_BYTES)
            except TimeoutError:
                return None
            except Exception as exc:
                raise DaemonUnreachableError(f"The daemon's updates of moves broke: {exc}.") from exc
            end = MOVE_ENDS.get(str(update.get("type")))
            if update.get("uuid") == uuid and end is not None:
                return MoveEnd(end, str(update.get("details") or ""))
        return None

    def close(self) -> None:
        self._stack.close()


def round_s() -> float:
    """Return the seconds in which the daemon must have answered a stop."""
    return 0.85 * settings.number("STRANDS_HALT_DEADLINE_S")


class MotionController:
    """Motions of one robot: streamed frames, and moves that the daemon plays."""

    def __init__(self, connection: Connection, gate: MotionGate, robot: str, *, automatic_body_yaw: bool) -> None:
        self._connection, self._gate, self._robot = connection, gate, robot
        self._moves = DaemonMoves(connection)
        self._automatic_body_yaw = automatic_body_yaw
        self._turn = threading.Lock()
        self._write = threading.Lock()
        self._next_frame_at = 0.0
        self._current: ReachyMotion | None = None
        self._moved: ReachyMotion | None = None
        self._rounds: StopRounds[ReachyMotion | None] = StopRounds(self._stop_moves)
        self._sent = Target()
        self._sent_on = 0
        self._body_yaw_sent_on = 0
        self.observers = RolloutObservers()
        self.frames_sent = 0

    @property
    def current(self) -> ReachyMotion | None:
        """The running motion, else the last one, else None."""
        return self._current

    @property
    def sent_head(self) -> HeadPose | None:
        """The head pose that was last sent and still counts."""
        return self._sent.head if self._sent_on == self._connection.connects else None

    def present(self) -> Target:
        """Return the last target sent, or the measured position after any other move."""
        feed = self._connection.feed
        joints = feed.fresh_joints
        measured = Target(feed.pose(), joints.body_yaw if joints else None, (joints.antennas if joints else None))
        if self._sent_on != self._connection.connects:
            self._sent = Target()
        return self._sent.over(measured)

    def moving(self) -> bool:
        """Return True while a motion runs here or at the daemon (asked now)."""
        motion = self._current
        return (motion is not None and motion.running) or bool(self._moves.running(time.monotonic() + 1.0))

    def stream(self, target: Target, name: str, request: MotionRequest | None = None) -> Target:
        """Send one frame now, cut to one frame's way; return the target sent."""
        with self._started(name, request) as motion:
            start = self.present()
            steps = target.step_from(start)
            sent = start.toward(target, 1 / steps) if steps > 1 else target
            self._pace()
            self._send(motion, sent)
            self._end(motion, "completed")
            return sent

    def go(self, target: Target, name: str, request: MotionRequest | None = None) -> bool:
        """Go there by one frame now, or by a ramp that starts now; True for a ramp."""
        with self._started(name, request) as motion:
            start = self.present()
            ramped = target.step_from(start) > 1
            self._play(motion, ramp(start, target) if ramped else iter((target,)))
            return ramped

    def gesture(self, frames: Gesture, name: str, request: MotionRequest | None = None) -> None:
        """Play frames at 50 Hz; the first one is sent now."""
        with self._started(name, request) as motion:
            self._play(motion, frames(self.present()))

    def daemon_move(
        self,
        name: str,
        path: str,
        request: MotionRequest | None = None,
        *,
        arrived: ArrivalCheck,
        before: Callable[[], None] | None = None,
    ) -> str:
        """Let the daemon play a move and watch it end; returns its uuid at once.

        Args:
            name: of the motion, in events and answers.
            path: posted to the daemon.
            request: what it begins for; made now by default.
            arrived: checked at the end, because the daemon reports `completed` for a move that did not arrive.
            before: runs once earlier motions are stopped; with it the motors may be off.

        Raises:
            DaemonError: the daemon did not start it.
            MotionRefused: halted, locked, or the robot is not available.
        """
        with self._started(name, request, of_daemon=True, motors_may_be_off=before is not None) as motion:
            updates = None
            try:
                updates = MoveUpdates(self._connection.host, self._connection.port)
                motion.permit.wait()
                if before is not None:
                    before()
                    motion.permit.wait()
                motion.check()
                motion.permit.begin()  # an answer that is lost or unreadable may be that of a move
                motion.uuid = _uuid(path, self._connection.rest.post(path))
            except Exception as exc:
                if updates is not None:
                    updates.close()
                motion.posted.set()
                self._end(motion, "error", str(exc))
                raise
            motion.brief = False
            motion.posted.set()
            self.forget_sent()
            try:
                motion.check()
            except MotionRefused:
                updates.close()
                self._moves.stop(motion.uuid, time.monotonic() + 1.0)
                self._end(motion, "stopped")
                raise
            watch = threading.Thread(
                target=self._watch, args=(motion, updates, arrived), name="reachy-move", daemon=True
            )
            watch.start()
            return motion.uuid

    def torque(self, change: Callable[[], None], name: str, request: MotionRequest | None = None) -> None:
        """Run ``change``, a write of the motors' torque, after stopping every motion."""

        def change_now() -> None:
            motion.check()
            change()

        with self._started(name, request, motors_may_be_off=True) as motion:
            try:
                # Under the lock, so that a halt waits for it as for a frame.
                motion.permit.write(self._write, change_now)
            except Exception as exc:
                self._end(motion, "error", str(exc))
                raise
            self.forget_sent()
            self._end(motion, "completed")

    def halt_ordered(self) -> None:
        """Note what moves, void its permits, and send the stop to the daemon at once.

        The halt itself may wait behind an earlier one that waits for a daemon that hangs.
        """
        self._note_moved()
        self._rounds.order(self._moved, round_s())

    def halt(self, reason: str) -> StopVerdict:
        """Stop every motion, from any thread, without waiting for a motion's start."""
        self._note_moved()
        motion, self._moved = self._moved, None
        if motion is not None:
            motion.detail = motion.detail or reason
            motion.cancelled.set()
        stop = self._rounds.claim(motion, round_s())
        streamed = motion.name if motion is not None and not motion.of_daemon else "stream"
        return halt_each(
            {
                streamed: lambda: self._stop_frames(motion, stop.deadline),
                "moves of the daemon": lambda: self._answer_of(stop),
            }
        )

    def _note_moved(self) -> None:
        if self._current is not None and self._current.running:
            self._moved = self._current
        self._gate.revoke()

    @contextlib.contextmanager
    def _started(
        self,
        name: str,
        request: MotionRequest | None,
        *,
        of_daemon: bool = False,
        motors_may_be_off: bool = False,
    ) -> Iterator[ReachyMotion]:
        """Start a motion once nothing else moves, with other starts waiting.

        The permit is taken first, so that a stop voids a start that still waits.
        """
        permit = self._gate.permit(name, request)
        with self._turn:
            permit.check()
            refusal = self._connection.refusal()
            if refusal is not None:
                raise MotionRefused(error(f"{name} refused: {refusal}.", connected=self._connection.alive))
            if not motors_may_be_off and self._connection.motor_mode == "disabled":
                raise MotionRefused(error(f"{name} refused: the motors are disabled; first wakeUp or enableMotors."))
            self._replace(name)
            motion = self._current = ReachyMotion(name, permit, of_daemon)
            try:
                motion.check()
                self._send_body_yaw_mode()
            except (MotionRefused, DaemonUnreachableError) as exc:
                self._end(motion, "stopped" if isinstance(exc, MotionRefused) else "error", str(exc))
                raise
            yield motion

    def _send_body_yaw_mode(self) -> None:
        """Tell the daemon once for each connection whether the body turns along."""
        if self._body_yaw_sent_on != self._connection.connects:
            with self._write:
                self._connection.link().send_automatic_body_yaw(self._automatic_body_yaw)
            self._body_yaw_sent_on = self._connection.connects

    def _replace(self, name: str) -> None:
        """Stop our own motion, and the daemon's moves of other clients."""
        before = self._current
        running = before is not None and before.running
        if before is not None and running:
            before.detail = f"replaced by {name}"
            before.cancelled.set()
        moves = set(self._connection.moves)
        if before is not None and before.uuid:
            if running:
                moves.add(before.uuid)
            else:
                moves.discard(before.uuid)
        for uuid in moves:
            self._moves.stop(uuid, time.monotonic() + REPLACE_S)
            self.forget_sent()
        if before is not None and running and not before.done.wait(REPLACE_S):
            raise MotionRefused(error(f"{name} refused: {before.name} did not end.", running=before.name))

    def _end(self, motion: ReachyMotion, state: str, detail: str = "") -> None:
        if motion.done.is_set():
            return
        motion.state, motion.detail = state, detail or motion.detail
        motion.done.set()
        if motion.brief and state == "completed":
            return
        self.observers.notify(
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

    def _pace(self) -> None:
        """Keep frames 20 ms apart, less the share for jitter."""
        wait = self._next_frame_at - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        self._next_frame_at = max(self._next_frame_at + FRAME_S, time.monotonic() + JITTER_SHARE * FRAME_S)

    def _send(self, motion: ReachyMotion, target: Target) -> None:
        try:
            motion.permit.write(self._write, lambda: self._send_now(motion, target))
        except (DaemonUnreachableError, MotionRefused) as exc:
            self._end(motion, "stopped" if isinstance(exc, MotionRefused) else "error", str(exc))
            raise
        self.frames_sent += 1
        self._sent = target.over(self.present())
        self._sent_on = self._connection.connects

    def _send_now(self, motion: ReachyMotion, target: Target) -> None:
        motion.check()
        self._connection.link().send_target(target)
        motion.permit.begin()

    def _play(self, motion: ReachyMotion, frames: Frames) -> None:
        self._pace()
        self._send(motion, next(frames))
        second = next(frames, None)
        motion.brief = second is None
        if second is None:
            self._end(motion, "completed")
            return
        threading.Thread(target=self._run, args=(motion, second, frames), name="reachy-frames", daemon=True).start()

    def _run(self, motion: ReachyMotion, second: Target, frames: Frames) -> None:
        due = time.monotonic()
        try:
            for target in itertools.chain((second,), frames):
                due += FRAME_S
                if motion.cancelled.wait(max(0.0, due - time.monotonic())):
                    self._end(motion, "stopped")
                    return
                self._send(motion, target)
                # A delayed thread continues from now: several late frames at once would be a jump.
                due = max(due, time.monotonic() - FRAME_S)
            self._next_frame_at = time.monotonic() + JITTER_SHARE * FRAME_S
            self._end(motion, "completed")
        except MotionRefused:
            self._end(motion, "stopped")
        except DaemonUnreachableError as exc:
            logger.warning("%s: %s ended early: %s", self._robot, motion.name, exc)
        finally:
            self._end(motion, "error", "its frames ended with a fault; the log has it")

    def forget_sent(self) -> None:
        """Forget the last target, because something else moved the robot."""
        self._sent = Target()

    def _watch(self, motion: ReachyMotion, updates: MoveUpdates, arrived: ArrivalCheck) -> None:
        """Follow a move of the daemon to its end and check whether it arrived."""
        end: MoveEnd | None = None
        deadline = time.monotonic() + REST_MOVE_LONGEST_S
        try:
            while end is None and not motion.cancelled.is_set() and time.monotonic() < deadline:
                end = updates.wait(motion.uuid, POLL_S)
            if end is not None and end.state == "completed":
                # Joints come at 37 to 50 Hz: a tenth of a second later they show the end.
                motion.cancelled.wait(POLL_S)
                reason = arrived()
                end = MoveEnd("error", reason) if reason else end
        except (DaemonError, ValidationError) as exc:
            end = MoveEnd("unknown", str(exc))
        finally:
            updates.close()
        if motion.cancelled.is_set():
            self._end(motion, "stopped")
        elif end is None:
            self._end(motion, "unknown", f"no end was reported within {REST_MOVE_LONGEST_S:g} s")
        else:
            self._end(motion, end.state, end.detail or ("another client stopped it" if end.state == "stopped" else ""))

    def _stop_frames(self, motion: ReachyMotion | None, deadline: float) -> object:
        """Wait for the write in flight; no later frame of an earlier permit is sent.

        Returns None when nothing was streaming.
        """
        if not self._write.acquire(timeout=max(0.0, deadline - time.monotonic())):
            return error("a write to the daemon does not return", stopped=False)
        self._write.release()
        streaming = motion is not None and not motion.of_daemon
        return success("no frame is sent any more", stopped=True) if streaming else None

    def _stop_moves(self, motion: ReachyMotion | None, deadline: float) -> object:
        """Stop every running move and list again; None when there was none.

        On the thread of a round. The daemon is asked although it was never linked: other clients move it as well.
        """
        if motion is not None and motion.of_daemon:
            motion.posted.wait(max(0.0, deadline - time.monotonic()))
        answer = self._moves.stop_all(motion.uuid if motion is not None else "", deadline)
        if answer is not None:
            self.forget_sent()
        return answer

    def _answer_of(self, stop: StopRound[ReachyMotion | None]) -> object:
        """Return the daemon's answer; where it gives none, what is known without it."""
        motion = stop.about
        try:
            return stop.wait()
        except (TimeoutError, ImportError) as exc:
            if motion is not None and motion.of_daemon:
                return error(f"{motion.name} is not known to have ended: {exc}", stopped=False)
            return error(f"the daemon was not asked: {exc}" if isinstance(exc, ImportError) else str(exc), stopped=None)


def _uuid(path: str, answer: object) -> str:
    if not isinstance(answer, dict) or not isinstance(answer.get("uuid"), str):
        raise DaemonFaultError(f"POST {path}: the answer has no uuid.")
    return str(answer["uuid"])
