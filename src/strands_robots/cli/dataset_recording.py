"""Recording of episodes: a led robot, and a person who judges each attempt."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

from strands_robots.cli.attempt_progress import AttemptProgress
from strands_robots.cli.led_robot import NotBegunError
from strands_robots.cli.output import CliError, Screen, wait_until
from strands_robots.cli.recording_state import RecordingState, RecordingStoppedError, Said, Stage, Words
from strands_robots.datasets.recorded import ATTEMPT_ENDED, HALTED
from strands_robots.recording.file import Pictures, Recorder
from strands_robots.safety.stopping import StopVerdict

if TYPE_CHECKING:
    from strands_robots.datasets.encoder import CameraEncoder
    from strands_robots.datasets.session import RecordingSession

FIRST_PICTURE_S = 10.0
"""Longest wait for the cameras before an attempt: the first picture of a simulation may take seconds."""


KEYS = "Enter keeps it as a success, f Enter as a failure, r Enter redoes it, q Enter drops it and ends."

KEYBOARD = "Enter keeps it as a success, x as a failure, z redoes it, c drops it and ends."
"""The same where single keys lead the robot, which takes the others."""

# The terminal mode of Python 3.12.0 and 3.12.1 leaves Enter the carriage return that it is.
_KEYBOARD = {"\n": Said.SUCCESS, "\r": Said.SUCCESS, "x": Said.FAILURE, "z": Said.REDO, "c": Said.END}


class Keys(Words):
    """Words of the person at the terminal, by lines, or by the keys of a leader.

    Args:
        fd: of the terminal; standard input by default.
    """

    begins = "Enter begins, q Enter ends."

    def __init__(self, fd: int | None = None) -> None:
        super().__init__()
        self.leading = False
        """True while a keyboard leads: its keys come by :meth:`pressed`, and no line is read."""
        self._fd = sys.stdin.fileno() if fd is None else fd
        self.turn: Callable[[], None] = lambda: None
        """Takes the robot over from its policy, or gives it back, by the key ``t`` Enter, or ``v`` of a keyboard."""
        self._line = b""

    @property
    def judges(self) -> str:
        """Words that judge an attempt, for the screen."""
        return KEYBOARD if self.leading else KEYS

    def pressed(self, key: str) -> None:
        """Note a key of the leader."""
        if key.lower() == "v":
            self.turn()
        if (word := _KEYBOARD.get(key.lower())) is not None:
            self.take(word)

    def said(self) -> Said | None:
        """Return the next word of the person; None while there is none."""
        if not self.leading:
            self._read()
        return super().said()

    def forget(self) -> None:
        """Forget what was typed until now, also without an Enter."""
        if os.isatty(self._fd):
            termios.tcflush(self._fd, termios.TCIFLUSH)
        super().forget()
        self._line = b""

    def _read(self) -> None:
        while select.select([self._fd], [], [], 0)[0]:
            data = os.read(self._fd, 4096)
            if not data:
                self.take(Said.END)
                return
            *lines, self._line = (self._line + data).split(b"\n")
            for line in lines:
                said = line.decode("utf-8", "replace").strip().lower()
                if said == "t":
                    self.turn()
                for each in Said:
                    if each.value == said:
                        self.take(each)


@dataclass(frozen=True, slots=True)
class Attempts:
    """Number of attempts, and the end of each.

    Args:
        count: of episodes to save.
        begin: lets the leader lead; returns its task.
        fps: frames a second, and pictures that are asked of each camera.
        seconds: longest time of one; None for as long as the person likes.
        pause_s: between two, where nobody is asked.
        success: of an attempt that ends by its time.
        asked: a person begins each; else time does.
        state: told to the network, with the person's words.
    """

    count: int
    begin: Callable[[], Any]
    fps: int
    seconds: float | None
    pause_s: float
    success: bool
    asked: bool = False
    state: RecordingState = field(default_factory=RecordingState)

    def tell(self, screen: Screen, text: str, style: str) -> None:
        """Say what became of an attempt, here and to who asks over the network."""
        self.state.note(text)
        screen.say(text, style)


class AttemptRobot(Protocol):
    """A robot whose attempts are recorded, of this process or another."""

    @property
    def name(self) -> str:
        """Its name in the recording."""

    @property
    def stopped(self) -> bool:
        """True where others stopped it in this attempt."""

    @property
    def stopped_by(self) -> str:
        """The reason of the stop, with its caller."""

    @property
    def locked(self) -> str:
        """By whom a robot of this process is locked; empty for any other."""

    @property
    def has_cameras(self) -> bool:
        """True where pictures are recorded."""

    @property
    def cameras(self) -> Collection[str]:
        """Names of its cameras in the recording, of which each has to deliver."""

    def recorded(self, recorder: Recorder, fps: int, pictures: Pictures | None) -> AbstractContextManager[object]:
        """Record it in the block, and hand the pictures of its cameras over."""

    def halt(self, reason: str) -> StopVerdict:
        """Halt it, and return the verdict."""

    def hold(self, screen: Screen) -> object:
        """Tell who stopped it, and keep it on the network."""


def record_attempts(screen: Screen, led: AttemptRobot, session: RecordingSession, attempts: Attempts) -> None:
    """Record attempts until all are saved or the person ends it.

    Args:
        screen: where it is told.
        led: the robot.
        session: takes what is kept.
        attempts: how many, and their ends.

    Raises:
        CliError: the robot was stopped by others, its leader failed, or its stop was not confirmed.
    """
    from strands_robots.datasets.encoder import CameraEncoder  # noqa: PLC0415 - an extra

    with CameraEncoder(attempts.fps) if led.has_cameras else nullcontext() as encoder:
        try:
            _record(screen, led, session, attempts, encoder)
        except RecordingStoppedError as stopped:
            attempts.state.note(stopped.reason)
            attempts.state.enter(Stage.STOPPED)
            if attempts.state.halting:
                # A stop of all reaches the robot a moment later, which is resumed on its network.
                wait_until(screen, lambda: attempts.state.halted)
            if led.locked:
                led.hold(screen)
            raise
        finally:
            attempts.state.enter(Stage.OVER)


def _record(
    screen: Screen, led: AttemptRobot, session: RecordingSession, attempts: Attempts, encoder: CameraEncoder | None
) -> None:
    saved, pause_s, state = 0, 0.0, attempts.state
    while saved < attempts.count:
        state.count(attempts.count, saved)
        if not _ready(screen, attempts, saved, pause_s):
            if state.halting:
                raise RecordingStoppedError(f"Nothing more is recorded: {state.halting}.")
            return
        pause_s = attempts.pause_s
        try:
            ended = _attempt(screen, led, session, attempts, encoder)
        except (NotBegunError, RecordingStoppedError):
            # Nothing was led: what was recorded is no attempt.
            session.discard()
            raise
        if ended.stopped_by:
            try:
                _save(screen, session, attempts, success=False)
            finally:
                # Whether it is locked as well may be known by now.
                why = f"Stopped from the network: {led.stopped_by or ended.stopped_by}"
                state.note(why)
                state.enter(Stage.STOPPED)
                # Also where the disk is full: a locked robot is resumed on its network.
                led.hold(screen)
            raise CliError(why)
        if ended.verdict is None or not ended.verdict.stopped:
            raise CliError("The follower did not confirm its stop; the attempt is saved at the next start.")
        if ended.said in (Said.REDO, Said.END):
            session.discard()
            attempts.tell(screen, "Dropped.", "yellow")
        else:
            lacking = _save(screen, session, attempts, success=ended.said is Said.SUCCESS)
            if lacking and not attempts.asked:
                failed = f"The attempt failed: {ended.failed.rstrip('.')}. " if ended.failed else ""
                raise CliError(f"{failed}{lacking} Nothing more is recorded.")
            saved += not lacking
        if ended.failed:
            raise CliError(f"The attempt failed: {ended.failed}")
        if ended.last:
            return


@dataclass(frozen=True, slots=True)
class _Ended:
    """End of one attempt: its word, who stopped it, its failure; is it the last."""

    said: Said
    stopped_by: str
    failed: str
    last: bool
    verdict: StopVerdict | None


def _ready(screen: Screen, attempts: Attempts, saved: int, pause_s: float) -> bool:
    """Wait until the next attempt may begin; False where none shall."""
    words, begins_at = attempts.state.words, None if attempts.asked else time.monotonic() + pause_s
    attempts.state.wait_for_begin(begins_at)
    if attempts.asked:
        screen.say(f"Attempt {saved + 1} of {attempts.count}: {words.begins}", "bold")
    said, told, state = list[Said](), list[str](), attempts.state

    def over() -> str:
        said.extend(words.spoken())
        if Said.END in said or state.halted:
            return "ended"
        due = bool(said) or (begins_at is not None and time.monotonic() >= begins_at)
        if due and (why := state.refusal):
            if said or why not in told:
                told.append(why)
                attempts.tell(screen, f"No attempt begins: {why}", "bold red")
            if said:
                said.clear()
                state.wait_for_begin(begins_at)
            return ""
        return "begins" if due else ""

    why = wait_until(screen, over)
    state.enter(Stage.STARTING)
    # What came with the begin judges no attempt.
    said.extend(words.spoken())
    return why == "begins" and Said.END not in said


@contextmanager
def _recording(screen: Screen, led: AttemptRobot, session: RecordingSession) -> Iterator[Recorder]:
    """Yield the recorder of an attempt.

    Raises:
        CliError: it could not be written to its end; the text says what is saved and where the attempt is.
    """
    recorder = Recorder(session.recording, joints_of_events=False)
    try:
        with recorder:
            yield recorder
    except OSError as problem:
        if not recorder.failed:
            raise
        if led.stopped:
            led.hold(screen)
        raise _unwritten(session, f"{session.folder} cannot be written: {problem.strerror}") from problem


def _unwritten(session: RecordingSession, why: str) -> CliError:
    kept_in = f"The attempt is in {session.recording}; the next start makes an episode of it."
    return CliError(f"{why.rstrip('.')}. Episodes that are saved: {session.episodes}. {kept_in}")


def _attempt(
    screen: Screen, led: AttemptRobot, session: RecordingSession, attempts: Attempts, encoder: CameraEncoder | None
) -> _Ended:
    """Lead and record one attempt, and halt the robot."""
    said, halts, state = list[Said](), list[str](), attempts.state
    ends = list[tuple[str, StopVerdict | None]]()
    with ExitStack() as recorded:
        recorder = recorded.enter_context(_recording(screen, led, session))
        if encoder is not None:
            recorded.enter_context(encoder.attempt(recorder.path))
        progress = AttemptProgress(recorder, attempts.fps, encoder)
        pictures = None if encoder is None else progress.take_picture
        recorded.enter_context(led.recorded(recorder, attempts.fps, pictures))
        if encoder is not None and (silent := encoder.wait_for_pictures(led.cameras, FIRST_PICTURE_S)):
            # The first attempt decides which cameras the dataset has.
            raise CliError(
                f"No picture of {', '.join(silent)} came within {FIRST_PICTURE_S:g} s; --cameras names those to "
                "record, or none."
            )
        state.check()
        task, began = attempts.begin(), time.monotonic()
        state.enter(Stage.RECORDING, progress.row)
        if attempts.asked:
            screen.say(state.words.judges)

        def over() -> str:
            if halted := state.halted:
                halts.append(halted)
                return "halted"
            said.extend(() if state.halting else state.words.spoken())
            if said:
                return "said"
            if attempts.seconds is not None and time.monotonic() - began >= attempts.seconds:
                return "time"
            if task.voided:
                return "voided"
            if recorder.failed or (encoder is not None and encoder.failed):
                return "failed"
            return "" if task.running else "ended"

        def end() -> None:
            state.enter(Stage.ENDING)
            if led.stopped:
                if halts:
                    # Both were stopped; that of the robot may not be recorded yet.
                    recorder.take(led.name, HALTED, {})
                ends.append((led.stopped_by, None))
                return
            # What ends an attempt here is no stop of it, but for a stop of the recording.
            recorder.take(led.name, HALTED if halts else ATTEMPT_ENDED, {})
            ends.append(("", led.halt("attempt ended")))

        with progress.shown(screen):
            why = wait_until(screen, over, at_end=end)
            state.enter(Stage.SAVING)
    # Some of it may have been said before the end was seen.
    said.extend(state.words.spoken())
    stopped_by, verdict = ends[0]
    done = attempts.success and why in ("time", "ended") and not task.error
    judged = said[0] if said and why in ("said", "time", "ended") else None
    word = judged or (Said.SUCCESS if done else Said.FAILURE)
    last = Said.END in said or why == "Ctrl-C."
    ended = _Ended(word, stopped_by, task.error or "".join(halts), last, verdict)
    return ended if encoder is None else _with_pictures(screen, encoder, ended)


def _with_pictures(screen: Screen, encoder: CameraEncoder, ended: _Ended) -> _Ended:
    """Tell which pictures an attempt lacks, and return its end."""
    for camera, count in sorted(encoder.dropped.items()):
        screen.data({"event": "dropped", "camera": camera, "pictures": count})
        screen.say(f"Camera {camera}: pictures dropped: {count}.", "yellow")
    if not encoder.failed:
        return ended
    # Its end is not in it.
    word = Said.FAILURE if ended.said is Said.SUCCESS else ended.said
    return replace(ended, said=word, failed=ended.failed or encoder.failed)


def _save(screen: Screen, session: RecordingSession, attempts: Attempts, *, success: bool) -> str:
    """Save the attempt; return why it is none, else nothing.

    Raises:
        CliError: it cannot be written; the text says what is saved and where the attempt is.
    """
    from strands_robots.datasets.layout import DatasetError  # noqa: PLC0415 - an extra
    from strands_robots.datasets.session import NoPictureError  # noqa: PLC0415 - as above

    try:
        kept = session.keep(success=success)
    except NoPictureError as problem:
        kept, lacking = None, f"No episode: {problem}."
    except DatasetError as problem:
        raise _unwritten(session, str(problem)) from problem
    else:
        lacking = "The robot made no step: there is nothing to save."
    if kept is None:
        attempts.tell(screen, lacking, "yellow")
        return lacking
    index, frames = kept
    row: Mapping[str, Any] = {"event": "saved", "episode": index, "frames": frames, "success": success}
    screen.data(dict(row))
    worth = "a success" if success else "no success"
    attempts.tell(screen, f"episode {index} is saved: {frames} frames, {worth}.", "green")
    return ""
