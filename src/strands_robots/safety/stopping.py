"""The grader of every answer to a stop.

A robot that is asked to stop answers with a :class:`StopVerdict`, an envelope, a foreign robot's
dictionary, an exception, or nothing in time. :func:`grade` sorts them. An affirmative failure, an exception,
a timeout and an unknown shape are four different answers, and only an affirmative success is success.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal, TypeVar, cast

from strands_robots import settings
from strands_robots.envelope import Envelope, error, success
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, choice, plain_value, shown

logger = stop_logger(__name__)

StopLevel = Literal["hold", "limp", "settle"]
STOP_LEVELS = ("hold", "limp", "settle")

OLD_LEVELS = {"release": "limp"}
"""Earlier names of stop levels."""


class Outcome(Enum):
    """Meaning of an answer to a stop."""

    STOPPED = "stopped"
    REFUSED = "did not stop"
    RAISED = "raised"
    TIMED_OUT = "no answer"
    UNKNOWN = "unknown answer"

    @property
    def stopped(self) -> bool | None:
        """True or False where the answer settles it, None where it does not."""
        if self is Outcome.UNKNOWN:
            return None
        return self is Outcome.STOPPED


@dataclass(frozen=True, slots=True)
class StopVerdict:
    """Outcome of a robot's ``halt``.

    ``halted`` names every motion source that was moving and is still now, ``not_stopped`` and ``unknown`` map a
    source to the reason. A verdict with nothing in any of them is a robot that was standing still: stopped.
    ``settling``: it was frozen, and now goes to its rest pose at bounded speed, until it is limp or stopped again.
    """

    halted: tuple[str, ...] = ()
    not_stopped: Mapping[str, str] = field(default_factory=dict)
    unknown: Mapping[str, str] = field(default_factory=dict)
    elapsed_ms: float = 0.0
    settling: bool = False

    @property
    def stopped(self) -> bool | None:
        """True: nothing moves. False: something is known to. None: unknown."""
        if self.not_stopped:
            return False
        return None if self.unknown else True

    def envelope(self) -> Envelope:
        """The verdict as an answer; an error unless everything is known to be still."""
        fields = {
            "stopped": self.stopped,
            "halted": list(self.halted),
            "not_stopped": dict(self.not_stopped),
            "unknown": dict(self.unknown),
            "elapsed_ms": round(self.elapsed_ms, 3),
            **({"settling": True} if self.settling else {}),
        }
        if self.stopped:
            what = f"Stopped {', '.join(self.halted)}." if self.halted else "Nothing was moving."
            return success(f"{what} It settles to its rest pose." if self.settling else what, **fields)
        doubts = [f"{name} did not stop: {why}" for name, why in self.not_stopped.items()]
        doubts += [f"{name}: {why}" for name, why in self.unknown.items()]
        return error("; ".join(doubts), **fields)


READ_EVERY_S = 0.02
"""Seconds between two readings of a robot that still moves after a halt."""


class PendingVerdict(ABC):
    """Verdict of a halt that is over, where the robot has to be read for it.

    Reading a robot may hang, and the next stop must not wait for that: whoever halted returns this, and it is read on
    another thread. One reading serves all halts that were over when it began.

    Args:
        until: the moment, in monotonic s, from which a reading is the last one.
        pause_s: seconds between two readings.
    """

    def __init__(self, until: float, pause_s: float = READ_EVERY_S) -> None:
        self.until, self.pause_s = until, pause_s

    @abstractmethod
    def known(self) -> StopVerdict | None:
        """Return the verdict if the answer to the stop settles it without a reading."""

    @abstractmethod
    def read(self) -> object:
        """Read what the robot says now. May block."""

    @abstractmethod
    def judged(self, reading: object, *, last: bool) -> StopVerdict | None:
        """Return the verdict by a reading; None, unless it is the last, to read again."""

    @abstractmethod
    def unread(self, why: str) -> StopVerdict:
        """Return the verdict where no reading came in time. Must not block."""


def read_verdict(answer: StopVerdict | PendingVerdict) -> StopVerdict:
    """Return the verdict of a halt, read on this thread for as long as that takes."""
    if isinstance(answer, StopVerdict):
        return answer
    verdict = answer.known()
    while verdict is None:
        verdict = answer.judged(answer.read(), last=time.monotonic() >= answer.until)
        if verdict is None:
            time.sleep(answer.pause_s)
    return verdict


H = TypeVar("H", bound=Callable[..., StopVerdict])


def halts_in_parts(halt: H) -> H:
    """Mark a public ``halt`` whose parts the stop executor calls by itself.

    A subclass that overrides it loses the mark, and is halted by its own.
    """
    vars(halt)["halts_in_parts"] = True
    return halt


def stop_level() -> StopLevel:
    """Return what a halt leaves: ``hold``, ``limp``, or ``settle`` and then limp.

    ``STRANDS_ESTOP_TORQUE``; another value is ``hold``, with one line in the log.
    """
    level = settings.raw("STRANDS_ESTOP_TORQUE").lower()
    if level not in STOP_LEVELS:
        logger.warning("STRANDS_ESTOP_TORQUE=%s is none of %s; hold is used.", shown(level), ", ".join(STOP_LEVELS))
        return "hold"
    return cast(StopLevel, level)


def checked_level(level: object, rest_pose: object) -> StopLevel:
    """Return the level that a robot is made with; None asks for the configured one.

    Raises:
        ValidationError: no such level, or ``settle`` without a rest pose.
    """
    asked = stop_level() if level is None else level
    chosen = choice("stop_level", OLD_LEVELS.get(asked, asked) if isinstance(asked, str) else asked, STOP_LEVELS)
    if chosen == "settle" and rest_pose is None:
        raise ValidationError("stop_level (or STRANDS_ESTOP_TORQUE) settle needs a rest_pose.")
    return cast(StopLevel, chosen)


def grade(answer: object) -> Outcome:
    """Sort whatever a stop returned.

    A contradiction is a failure: an envelope that says success beside ``stopped: false``, a non-empty
    ``not_stopped`` or ``running: true`` did not stop.
    """
    if isinstance(answer, StopVerdict):
        return {True: Outcome.STOPPED, False: Outcome.REFUSED, None: Outcome.UNKNOWN}[answer.stopped]
    if isinstance(answer, TimeoutError):
        return Outcome.TIMED_OUT
    if isinstance(answer, BaseException):
        return Outcome.RAISED
    if not isinstance(answer, Mapping):
        return Outcome.UNKNOWN
    facts = [answer, *json_blocks(answer)]
    if any(_denies(fact) for fact in facts):
        return Outcome.REFUSED
    if any(fact.get("stopped", False) is None and "stopped" in fact for fact in facts):
        return Outcome.UNKNOWN
    if answer.get("status") == "success" or any(fact.get("ok") is True for fact in facts):
        return Outcome.STOPPED
    return Outcome.STOPPED if answer.get("stopped") is True and "status" not in answer else Outcome.UNKNOWN


def explain(answer: object) -> str:
    """Return the reason, for an operator, why :func:`grade` did not say stopped."""
    outcome = grade(answer)
    if outcome in (Outcome.RAISED, Outcome.TIMED_OUT):
        return f"{outcome.value}: {type(answer).__name__}: {answer}"
    if outcome in (Outcome.REFUSED, Outcome.UNKNOWN) and isinstance(answer, Mapping):
        for key in ("reason", "error", "message"):
            if isinstance(answer.get(key), str) and answer[key]:
                # A robot that graded a part of itself says so already.
                return f"{outcome.value}: {answer[key].removeprefix(f'{outcome.value}: ')}"
    return f"{outcome.value}: {shown(answer)}"


def graded(answer: object, name: str) -> StopVerdict:
    """Return whatever a stop of ``name`` answered or raised as a verdict."""
    if isinstance(answer, StopVerdict):
        return answer
    outcome = grade(answer)
    if outcome.stopped:
        return StopVerdict((name,))
    why = {name: explain(answer)}
    return StopVerdict(unknown=why) if outcome.stopped is None else StopVerdict(not_stopped=why)


class ForeignAnswer(PendingVerdict):
    """A robot's own answer to its halt, which runs its code when it is graded."""

    def __init__(self, answer: object, name: str) -> None:
        super().__init__(0.0)
        self._answer, self._name = answer, name

    def known(self) -> StopVerdict:
        return graded(self._answer, self._name)

    def read(self) -> object:
        return None

    def judged(self, reading: object, *, last: bool) -> StopVerdict:
        return self.known()

    def unread(self, why: str) -> StopVerdict:
        return StopVerdict(not_stopped={self._name: why})


def verdict_of(stop: Callable[[], object], name: str) -> StopVerdict:
    """Return what ``stop`` answers or raises as a verdict on ``name``."""
    try:
        return graded(stop(), name)
    except Exception as exc:  # noqa: BLE001 - a stop that raises is a robot that may be moving
        return graded(exc, name)


def halt_each(sources: Mapping[str, Callable[[], object]]) -> StopVerdict:
    """Ask every source to stop, in order, and grade each answer.

    A source whose callable returns None had nothing to halt and is not listed.
    """
    started = time.monotonic()
    halted: list[str] = []
    not_stopped: dict[str, str] = {}
    unknown: dict[str, str] = {}
    for name, stop in sources.items():
        try:
            answer = stop()
        except Exception as exc:  # noqa: BLE001 - whatever a stop raises is graded, and the next source still halts
            answer = exc
        if answer is None:
            continue
        outcome = grade(answer)
        if outcome.stopped:
            halted.append(name)
        elif outcome.stopped is None:
            unknown[name] = explain(answer)
        else:
            not_stopped[name] = explain(answer)
    return StopVerdict(tuple(halted), not_stopped, unknown, (time.monotonic() - started) * 1000)


def json_blocks(answer: Mapping[str, object]) -> list[Mapping[str, object]]:
    """Return the ``json`` blocks of an envelope's content."""
    content = answer.get("content")
    blocks = content if isinstance(content, list) else []
    return [b["json"] for b in blocks if isinstance(b, Mapping) and isinstance(b.get("json"), Mapping)]


def _denies(fact: Mapping[str, object]) -> bool:
    # An error whose own verdict is unknown stays unknown when it has travelled as an envelope.
    undecided = "stopped" in fact and fact["stopped"] is None
    ok, stopped, running = (plain_value(fact.get(name)) for name in ("ok", "stopped", "running"))
    return (
        (fact.get("status") == "error" and not undecided)
        or ok is False
        or stopped is False
        or running is True
        or bool(plain_value(fact.get("not_stopped")))
    )
