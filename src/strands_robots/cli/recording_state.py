"""State of a recording, and the words of a person that change it."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any

from strands_robots.cli.output import CliError
from strands_robots.envelope import Envelope, error, success


class Said(Enum):
    """Word of a person on an attempt, by the key before Enter."""

    SUCCESS = ""
    FAILURE = "f"
    REDO = "r"
    END = "q"


class Words:
    """Words of a person, in order; from any thread.

    Those of a terminal are read by a subclass.
    """

    begins = "Begin on the page begins, End ends."
    """Words that begin an attempt, for the screen."""

    def __init__(self) -> None:
        self._words: deque[Said] = deque()

    @property
    def judges(self) -> str:
        """Words that judge an attempt, for the screen."""
        return "The page's buttons keep it as a success or as a failure, redo it, or drop it and end."

    def take(self, word: Said) -> None:
        """Note a word."""
        self._words.append(word)

    def said(self) -> Said | None:
        """Return the next word; None while there is none."""
        return self._words.popleft() if self._words else None

    def spoken(self) -> list[Said]:
        """Return all words that are there, in order."""
        return list(iter(self.said, None))

    def forget(self) -> None:
        """Forget what was said until now."""
        self._words.clear()


class Stage(Enum):
    """Stage of a recording, in words for a person."""

    OPENING = "opening"
    WAITING = "waiting for Begin"
    STARTING = "starting"
    RECORDING = "recording"
    ENDING = "ending"
    SAVING = "saving"
    STOPPED = "stopped"
    OVER = "over"


BEGIN, KEEP, REDO, END = "beginEpisode", "keepEpisode", "redoEpisode", "endRecording"
"""Verbs of a recorder, each of which is a word."""

_LEADS = frozenset({Stage.STARTING, Stage.RECORDING, Stage.ENDING})
"""Stages in which the robot may be led."""

_AT = {Stage.WAITING: (BEGIN, END), Stage.RECORDING: (KEEP, REDO, END)}
"""Verbs that fit a stage."""


class RecordingStoppedError(CliError):
    """Failure of a recording that was stopped, or is locked, while no attempt ran."""


Progress = Callable[[], Mapping[str, Any]]


class RecordingState:
    """Stage of a recording; callable from any thread.

    A word from the network counts where it fits the stage, once: the loop that records takes it, as it takes a key's.
    A stop counts in every stage, and is never forgotten: no attempt begins after it.

    Args:
        words: of the person, which the loop reads.

    Attributes:
        locked: returns by whom its device is locked; empty while it is free, or where it has none.
    """

    def __init__(self, words: Words | None = None) -> None:
        self.words = words or Words()
        self.locked: Callable[[], str] = str
        self._lock = threading.Lock()
        self._stage = Stage.OPENING
        self._pressed = False
        self._progress: Progress = dict
        self._begins_at: float | None = None
        self._halt: tuple[float, str] | None = None
        self._said = ""
        self._counts = {"episode": 1, "episodes": 1, "saved": 0}

    def count(self, episodes: int, saved: int) -> None:
        """Note how many episodes are to be saved, and how many are."""
        with self._lock:
            self._counts = {"episode": min(saved + 1, episodes), "episodes": episodes, "saved": saved}

    def note(self, text: str) -> None:
        """Note what the screen says, for those who do not see it."""
        with self._lock:
            self._said = text

    def wait_for_begin(self, begins_at: float | None) -> None:
        """Wait for a beginning from now on.

        Args:
            begins_at: monotonic time at which the attempt begins by itself; None where a person begins it.
        """
        # What was said before is about the attempt before.
        self.words.forget()
        self.enter(Stage.WAITING)
        with self._lock:
            self._begins_at = begins_at

    def enter(self, stage: Stage, progress: Progress | None = None) -> None:
        """Enter a stage; ``progress`` returns the figures of its attempt."""
        with self._lock:
            self._stage, self._pressed, self._begins_at = stage, False, None
            self._progress = progress or (self._progress if stage in (Stage.ENDING, Stage.SAVING) else dict)

    def halt(self, reason: str, after_s: float = 0.0) -> None:
        """End the recording, and in so many seconds its attempt, as no success."""
        with self._lock:
            ends = time.monotonic() + after_s
            if self._halt is None or ends < self._halt[0]:
                self._halt = ends, reason

    @property
    def halting(self) -> str:
        """The reason of the stop; empty while there was none."""
        return "" if self._halt is None else self._halt[1]

    @property
    def halted(self) -> str:
        """The same once what runs has to end."""
        halt = self._halt
        return halt[1] if halt is not None and time.monotonic() >= halt[0] else ""

    @property
    def refusal(self) -> str:
        """The reason why no attempt may begin now; empty while one may."""
        return self.halting or self.locked()

    def check(self) -> None:
        """Raise :class:`RecordingStoppedError` where no attempt may begin now."""
        if why := self.refusal:
            raise RecordingStoppedError(f"Nothing began: {why.rstrip('.')}.")

    @property
    def runs(self) -> bool:
        """True while an attempt may lead its robot."""
        return self._stage in _LEADS

    @property
    def summary(self) -> str:
        """Its episode and stage; nothing of the attempt is asked."""
        counts = self._counts
        return f"episode {counts['episode']} of {counts['episodes']}, {self._stage.value}"

    def press(self, verb: str, word: Said) -> Envelope:
        """Take a word from the network; an error names the stage that it does not fit."""
        if verb == BEGIN and (why := self.refusal):
            return error(f"{verb} is refused: {why}", state=self._stage.name.lower())
        with self._lock:
            stage, fits = self._stage, _AT.get(self._stage, ())
            if verb not in fits:
                works = f" {' and '.join(fits)} work now." if fits else ""
                return error(f"{verb} is refused: the recording is {stage.value}.{works}", state=stage.name.lower())
            if self._pressed:
                return error(f"{verb} is refused: the word before it is being carried out.", state=stage.name.lower())
            self._pressed = True
            self.words.take(word)
        return success(f"{verb} is taken.", state=stage.name.lower())

    def facts(self) -> dict[str, Any]:
        """Return the stage, its figures, and the verbs that fit it now."""
        with self._lock:
            stage, progress, begins_at = self._stage, self._progress, self._begins_at
            fits = [] if self._pressed else list(_AT.get(stage, ()))
            told = {"state": stage.name.lower(), "stage": stage.value, **self._counts, "said": self._said, "can": fits}
        left = {} if begins_at is None else {"begins_in_s": round(max(0.0, begins_at - time.monotonic()), 1)}
        return {**told, **left, **progress()}
