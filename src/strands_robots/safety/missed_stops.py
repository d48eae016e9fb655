"""Missed stops: the question of a process that was away, and its answers.

A process with a robot that is locked by a stop answers with the original, verbatim, and the asker judges it as if it
had come directly. An answer can therefore lock nothing that its original would not lock, and hides nothing: the asker
unites all answers.
Everything here happens on a thread of its own; a link's thread only hands over.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import random
import secrets
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from strands_robots.audit import queue_safety_event
from strands_robots.safety import ed25519
from strands_robots.safety.identity import SigningIdentity
from strands_robots.safety.lockout import is_epoch
from strands_robots.safety.orders import seconds_of
from strands_robots.safety.persistence import ORIGINAL_MAX_BYTES, STOPS_MAX, Original, newest_within
from strands_robots.safety.statements import Purpose, own_key, signed
from strands_robots.safety.stop_link import ANSWER, JSON_RPC, QUESTION, FairQueue
from strands_robots.state_files import StateFileError, make_private, require_private, state_dir, uptime
from strands_robots.stop_log import stop_logger
from strands_robots.threads import WokenThread
from strands_robots.utils import shown

logger = stop_logger(__name__)

STARTED, BACK = "the process started", "its link is back"
PEER_BACK = "a peer is linked again, while others stayed"

UNITE_S = 0.3
"""Seconds from the question for which motions hold, while the answers come in."""

HOLD_EVERY_S, HOLD_EVERY_MAX_S = 5.0, 60.0
"""Seconds from one hold because of a link to the next: twice as many each time while the link goes on coming back."""

LISTEN_S = 1.9
"""Seconds from the question in which an answer counts; a busy machine answers late."""

ASK_EVERY_S = 1.0
LOCKED_EVERY_S = 5.0
"""The same, while every robot of the process is locked: a fleet that stands still does not crowd a busy machine."""

LOCKED_WAIT_S = 2.0
"""Longest wait of such a process before it asks; drawn anew each time."""

SETTLE_S = 0.15
"""Wait of a question because one peer, or a link, is back: others follow, and the next question is a second off."""

LOST_EVERY_S = 5.0
"""Least time between two questions that do not wait for that second.

One that left just before a link was back may have gone over the link that was lost, and reached nobody.
"""

ASK_AGAIN_S = 2.0
ASKS_MAX = 5
"""Questions after one reason: two, and more only while answers had to be dropped."""

WAIT_MAX_S = 0.2
"""Longest wait of an answerer, drawn so that few of many answer early."""

STEEPNESS = 6.0
"""Exponent of that distribution: of 400 answerers three are due in its first quarter."""

ANSWERS_ENOUGH = 3
ANSWER_EVERY_S = 0.1
"""Seconds between two answers of a process; one answer serves every question before it."""

DEVICES_MAX = 64
QUESTION_MAX_BYTES = 8 * 2**10
QUESTIONS_MAX = 16
"""Questions that wait for one answer."""

ANSWER_MAX_BYTES = 60 * 2**10
"""Bound of an encoded answer. Every stop link reads 64 KiB; a NATS server carries 1 MiB and Zenoh more."""

STOPS_MAX_BYTES = ANSWER_MAX_BYTES - 4 * 2**10

BUCKETS = 32
BUCKET_CAPACITY = 2
"""Answers of the sources that share a bucket: 4 MiB in all at their bound, whoever sends how many."""

REFUSED_MAX = 16
"""Stops of one answer that do not count, after which the rest of it is not read unless a known key signed it."""

RETRY_S = 0.1
"""Wait after a step that failed."""

JUDGED_MAX = 4096
AUDIT_EVERY_S = 10.0


class MissedStopsPort(ABC):
    """A process as asker and answerer; one without robots only answers.

    No method blocks on the network, and none raises for its state.
    """

    def was_here(self) -> bool:
        """Return True where a robot was served from here before its start."""
        return False

    def locked(self) -> bool:
        """Return True while every robot of the process is locked."""
        return False

    def devices(self) -> Sequence[str]:
        """Return the names of the robots that ask; none, and nothing is asked."""
        return ()

    @abstractmethod
    def publish(self, event: str, source: str, fields: Mapping[str, Any]) -> bool:
        """Send a question or an answer as ``source``; False when the link is down."""

    @abstractmethod
    def signer(self) -> tuple[str, SigningIdentity | None]:
        """Return the name that answers and what signs, None where there is no key."""

    @abstractmethod
    def originals(self) -> Sequence[Original]:
        """Return the stops to answer with, as of now."""

    def learn(self, source: str, payload: bytes, age_s: float, answerer: str) -> bool:
        """Judge a stop and lock by it; False when it does not count.

        Args:
            age_s: seconds since it was first received, as ``answerer`` says.
        """
        return False

    @abstractmethod
    def knows_key(self, source: str, key: bytes) -> bool:
        """Return True where ``key`` is known to be that of ``source``."""

    @abstractmethod
    def hold(self, seconds: float) -> None:
        """Hold the motions of the robots for so long; return at once."""


class Asker:
    """Times of the questions, in monotonic s."""

    def __init__(self) -> None:
        self._due = self._asked = self._lost = float("-inf")
        self._asks = 0
        self.listens_until = float("-inf")

    @property
    def due(self) -> float:
        """The moment of the next question; infinite where none is wanted."""
        return self._due if self._asks else float("inf")

    def want(self, now: float, later_s: float = 0.0, *, link_back: bool = False) -> None:
        """Ask, at once or as soon as a second has passed since the last question.

        Args:
            later_s: seconds that a process whose robots are all locked waits; it does so at most every five seconds.
            link_back: a link is back, so a question of the last second may be lost and is soon asked again.
        """
        if not later_s:
            soonest = max(now, self._asked + ASK_EVERY_S)
            if link_back and now < soonest and now - self._lost >= LOST_EVERY_S:
                self._lost = now
                soonest = now + SETTLE_S
            self._due = min(self._due, soonest) if self._asks else soonest
        elif not self._asks:
            self._due = max(now + later_s, self._asked + LOCKED_EVERY_S)
        self._asks = ASKS_MAX

    def asked(self, now: float) -> None:
        """Note that a question leaves, and plan the next one."""
        self._asked, self._due, self._asks = now, now + ASK_AGAIN_S, self._asks - 1
        self.listens_until = now + LISTEN_S

    def not_asked(self) -> None:
        """Note that none can leave; the link's return is a new reason."""
        self._asks = 0

    def settle(self, now: float, *, dropped: bool) -> None:
        """End the questions after the second one, unless answers were dropped."""
        if self._asks <= ASKS_MAX - 2 and now > self.listens_until and not dropped:
            self._asks = 0

    def listens(self, now: float) -> bool:
        """Return True while answers count."""
        return now <= self.listens_until


class HoldPace:
    """Limit of the holds that the returns of a link cause."""

    def __init__(self) -> None:
        self._gap = HOLD_EVERY_S
        self._next = self._back = float("-inf")

    def take(self, now: float) -> bool:
        """Return True where a link that is back at ``now``, monotonic s, may hold."""
        quiet, self._back = now - self._back, now
        if now < self._next:
            return False
        if quiet >= self._gap:
            self._gap = HOLD_EVERY_S
        self._next = now + self._gap
        self._gap = min(2 * self._gap, HOLD_EVERY_MAX_S)
        return True


class Answerer:
    """Questions that wait for an answer; times are monotonic s.

    Args:
        chance: returns a number from 0 to 1.
    """

    def __init__(self, chance: Callable[[], float] = random.random) -> None:
        self._chance = chance
        self._questions: dict[str, dict[str, set[str]]] = {}
        self._due, self._answered = float("inf"), float("-inf")

    @property
    def due(self) -> float:
        """The moment of the next answer; infinite where no question waits."""
        return self._due

    @property
    def waits(self) -> bool:
        """True while a question is not answered."""
        return bool(self._questions)

    @property
    def nonces(self) -> tuple[str, ...]:
        """The questions that wait."""
        return tuple(self._questions)

    @property
    def full(self) -> bool:
        """True while no further question is taken; the next answer serves its asker too."""
        return len(self._questions) >= QUESTIONS_MAX

    def ask(self, nonce: str, now: float) -> None:
        """Take a question; one that comes again changes nothing."""
        if nonce in self._questions or self.full:
            return
        if not self._questions:
            self._due = max(now + waiting_s(self._chance()), self._answered + ANSWER_EVERY_S)
        self._questions[nonce] = {}

    def given(self, nonce: str, answerer: str, epochs: Iterable[str]) -> None:
        """Note an answer that is proven; it serves every question that waits here."""
        if nonce in self._questions:
            named = tuple(epochs)
            for given in self._questions.values():
                for epoch in named:
                    given.setdefault(epoch, set()).add(answerer)

    def take(self, originals: Iterable[Original], now: float) -> list[Original]:
        """Return the stops that one of the questions is still to be told; end all."""
        questions, self._questions, self._due = self._questions, {}, float("inf")
        rest = [
            each
            for each in originals
            if any(len(given.get(each.epoch, ())) < ANSWERS_ENOUGH for given in questions.values())
        ]
        if rest:
            self._answered = now
        return rest


def waiting_s(chance: float) -> float:
    """Return how long to wait: few of many answerers wait shortly, most long."""
    return WAIT_MAX_S * math.log1p(chance * math.expm1(STEEPNESS)) / STEEPNESS


@dataclass(frozen=True, slots=True)
class _Row:
    """One stop of an answer."""

    source: str
    payload: bytes
    age_s: float


def answer_fields(nonce: str, originals: Sequence[Original]) -> dict[str, Any]:
    """Return an answer: its stops, newest last, and the number of those left out."""
    fitting = newest_within(originals, STOPS_MAX_BYTES, encoded_length)
    now = uptime()
    rows = [
        {"source": each.source, "event": ed25519.encode(each.payload), "age_s": round(max(0.0, now - each.received), 3)}
        for each in fitting
    ]
    return {"nonce": nonce, "stops": rows, "more": len(originals) - len(fitting)}


def encoded_length(original: Original) -> int:
    """Return an upper bound of the bytes of a stop within an answer."""
    return 4 * (len(original.payload) // 3 + 1) + 12 * len(original.source) + 64


def rows_of(fields: Mapping[str, Any]) -> list[_Row]:
    """Return the stops of an answer, leaving out what is none."""
    stops = fields.get("stops")
    found = []
    for each in stops[:STOPS_MAX] if isinstance(stops, list) else ():
        if not isinstance(each, Mapping):
            continue
        source, event, age_s = each.get("source"), each.get("event"), each.get("age_s")
        payload = ed25519.decode_up_to(event, ORIGINAL_MAX_BYTES)
        age = seconds_of(age_s)
        if isinstance(source, str) and source and payload and age is not None and age >= 0:
            found.append(_Row(source, payload, age))
    return found


class MissedStops:
    """Asker and answerer of one process on one network.

    Args:
        port: the process on this network.
        parse: returns the fields of a message.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        port: MissedStopsPort,
        parse: Callable[[bytes | int | None], Mapping[str, Any]] = JSON_RPC.fields,
        clock: Callable[[], float] = time.monotonic,
        chance: Callable[[], float] = random.random,
    ) -> None:
        self._port, self._parse, self._clock = port, parse, clock
        self._chance, self._slots = chance, AnswerSlots()
        self._asker, self._answerer = Asker(), Answerer(chance)
        self._reasons: deque[str] = deque(maxlen=8)
        self._questions: deque[tuple[str, bytes]] = deque(maxlen=QUESTIONS_MAX)
        self._answers = FairQueue(BUCKETS, BUCKET_CAPACITY)
        # The smallest age that a stop was judged with; -inf: no age makes it count.
        self._judged: dict[bytes, float] = {}
        self._own = ""
        self._linked, self._up = False, False
        self._back, self._pace = False, HoldPace()
        self._audited = float("-inf")
        self._worker = WokenThread("missed-stops", self._step_safely, self._due_in)

    def ask(self, reason: str) -> None:
        """Hold the motions and ask; return at once.

        Args:
            reason: why this process may have missed a stop, for the log.
        """
        self._port.hold(UNITE_S)
        self._reasons.append(reason)
        self._worker.wake()

    def back(self, reason: str = BACK) -> None:
        """Ask because of a link; return at once.

        Where the reason is :data:`BACK`, motions hold as the question leaves, as often as :class:`HoldPace` allows.
        """
        self._reasons.append(reason)
        self._worker.wake()

    def link_up(self) -> None:
        """Ask because the link is back, or at its first time :meth:`started`.

        Where it was up already, a peer is back while others stayed linked, and nothing is held.
        """
        stayed, self._up = self._up, True
        if self._linked:
            self.back(PEER_BACK if stayed else BACK)
        else:
            self._linked = True
            self.started()

    def link_down(self) -> None:
        """Note that the link is lost; its return is a reason to ask."""
        self._up = False

    def started(self) -> None:
        """Ask because a robot is served from now on, unless it is a newcomer."""
        if self._port.was_here():  # a newcomer needs no thread for this
            self._reasons.append(STARTED)
            self._worker.wake()

    def receive(self, event: str, source: str, payload: bytes | int) -> None:
        """Take a question or an answer from a link's thread; return at once."""
        if isinstance(payload, int) or len(payload) > (QUESTION_MAX_BYTES if event == QUESTION else ANSWER_MAX_BYTES):
            return
        if event == QUESTION:
            if len(self._questions) < QUESTIONS_MAX and not self._answerer.full:
                self._questions.append((source, payload))
                self._worker.wake()
        elif self._asker.listens(self._clock()) or self._answerer.waits or self._questions:
            self._answers.put(ANSWER, source, payload)
            self._worker.wake()

    def close(self) -> None:
        """End the thread. Safe to call twice."""
        self._worker.close()

    def _due_in(self) -> float:
        return min(self._asker.due, self._answerer.due) - self._clock()

    def _step_safely(self) -> None:
        try:
            self.step()
        except Exception:
            logger.critical("A question for missed stops failed.", exc_info=True)
            # What could not be answered is not due for ever; our own question is tried again.
            self._questions.clear()
            self._answerer.take((), self._clock())
            time.sleep(RETRY_S)

    def step(self) -> None:
        """Do what is due now; the thread does so whenever something is."""
        while self._reasons:
            reason = self._reasons.popleft()
            if reason == STARTED:
                self._port.hold(UNITE_S)
            self._back = self._back or reason == BACK
            logger.info("Asking for the stops missed: %s.", reason)
            settle = SETTLE_S if reason == PEER_BACK else 0.0
            later_s = self._chance() * LOCKED_WAIT_S if self._port.locked() else 0.0
            self._asker.want(self._clock() + settle, later_s, link_back=reason in (BACK, PEER_BACK))
        self._take_questions()
        if self._asker.listens(self._clock()):
            self._take_answers()
        now = self._clock()
        if now >= self._asker.due:
            self._ask()
        if now >= self._answerer.due:
            self._answer()

    def _ask(self) -> None:
        now = self._clock()
        back, self._back = self._back, False
        self._asker.settle(now, dropped=self._answers.displaced)
        devices = self._port.devices() if self._asker.due <= now else ()
        if not devices:
            self._asker.not_asked()
            return
        self._answers.clear()
        self._judged.clear()
        # Before it leaves: the first answer may be back before this thread runs again.
        self._asker.asked(now)
        self._own = secrets.token_hex(16)
        fields = {"nonce": self._own, "devices": list(devices[:DEVICES_MAX]), "t": time.time()}
        if not self._port.publish(QUESTION, devices[0], fields):
            self._asker.not_asked()
        elif back and self._pace.take(now):
            self._port.hold(UNITE_S)

    def _take_questions(self) -> None:
        answers = bool(self._questions) and bool(self._port.originals())
        while self._questions:
            _, payload = self._questions.popleft()
            if answers:
                nonce = self._parse(payload).get("nonce")
                if is_epoch(nonce) and nonce != self._own:
                    self._answerer.ask(str(nonce), self._clock())

    def _take_answers(self) -> None:
        while (answer := self._answers.take()) is not None:
            source, fields = answer.source, self._parse(answer.payload)
            rows = rows_of(fields)
            if self._answerer.waits:
                self._note_given(source, fields, rows)
            if self._asker.listens(self._clock()):
                self._learn(source, rows, fields)

    def _proven(self, source: str, fields: Mapping[str, Any]) -> bool:
        """Return True for an answer that a known key signed."""
        key = ed25519.decode(fields.get("key"), 32)
        known = key is not None and self._port.knows_key(source, key)
        return known and own_key(Purpose.MISSED_STOPS, source, fields) == key

    def _note_given(self, source: str, fields: Mapping[str, Any], rows: Sequence[_Row]) -> None:
        """Count an answer that another process gave, if a known key signed it."""
        nonce = fields.get("nonce")
        if isinstance(nonce, str) and self._proven(source, fields):
            told = {(each.source, each.payload) for each in rows}
            epochs = [each.epoch for each in self._port.originals() if (each.source, each.payload) in told]
            self._answerer.given(nonce, source, epochs)

    def _learn(self, answerer: str, rows: Collection[_Row], fields: Mapping[str, Any]) -> None:
        refused = 0
        for each in rows:
            digest = hashlib.sha256(each.source.encode("utf-8", "replace") + b"\0" + each.payload).digest()
            # Whoever passes on a stop states its age: a false one must not hide the true one.
            if each.age_s >= self._judged.get(digest, float("inf")):
                continue
            counts = self._port.learn(each.source, each.payload, each.age_s, answerer)
            if digest in self._judged or len(self._judged) < JUDGED_MAX:
                self._judged[digest] = each.age_s if counts else float("-inf")
            if not counts:
                refused += 1
                if refused == REFUSED_MAX and not self._proven(answerer, fields):
                    logger.info("An answer of %s is not read on: its stops do not count.", shown(answerer))
                    return

    def _answer(self) -> None:
        originals = self._port.originals()
        questions = self._slots.take(self._answerer.nonces, [each.epoch for each in originals]) if originals else []
        if questions:
            # What others answered is checked now: most processes get no slot and need not.
            self._take_answers()
        else:
            originals = ()
        now = self._clock()
        rest = self._answerer.take(originals, now)
        if not self._asker.listens(now):
            self._answers.clear()
        if not rest:
            return
        name, identity = self._port.signer()
        fields = answer_fields(questions[0], rest)
        self._port.publish(ANSWER, name, signed(identity, Purpose.MISSED_STOPS, name, fields))
        if now - self._audited >= AUDIT_EVERY_S:
            self._audited = now
            epochs = [each.epoch for each in rest]
            queue_safety_event("missed_stops_answered", name, {"epochs": epochs, "more": fields["more"]})


SLOTS = 3
OLD_S = 5.0
"""Age in s from which a slot is removed: its question was answered or is asked anew, under another id."""

SWEPT_ABOVE = 64
"""Slots in the directory from which old ones are looked for."""


class AnswerSlots:
    """Slots of a question, by which the processes of one machine share its answers.

    On a machine with hundreds of processes an answer is heard by all of them only after as many have given one. So a
    process first takes one of three slots of a question: a file in ``answers`` that only its first maker makes.

    Args:
        state: in place of the state directory.
    """

    def __init__(self, state: Path | None = None) -> None:
        self._state = state

    def take(self, nonces: Sequence[str], epochs: Iterable[str]) -> list[str]:
        """Take a free slot of each of these questions; return those that had one.

        All, where the directory cannot be used: answers too many are better than none.

        Args:
            nonces: ids of questions, 32 hex digits.
            epochs: of the stops that would be answered; processes with other stops do not share a slot.
        """
        root = self._state or state_dir()
        folder = root / "answers"
        stops = hashlib.sha256(",".join(sorted(epochs)).encode("utf-8", "replace")).hexdigest()[:8]
        try:
            if not folder.exists():
                make_private(folder)
            require_private(folder, root)
            taken = frozenset(each.name for each in folder.iterdir())
            if len(taken) > SWEPT_ABOVE:
                _sweep(folder)
            return [nonce for nonce in nonces if _made(folder, f"{nonce}-{stops}", taken)]
        except (OSError, StateFileError) as exc:
            logger.warning("The processes of this machine cannot share their answers: %s", exc)
            return list(nonces)


def _made(folder: Path, name: str, taken: frozenset[str]) -> bool:
    for number in range(SLOTS):
        if f"{name}-{number}" in taken:
            continue
        with contextlib.suppress(FileExistsError):
            os.close(os.open(folder / f"{name}-{number}", os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
            return True
    return False


def _sweep(folder: Path) -> None:
    for path in folder.iterdir():
        with contextlib.suppress(OSError):  # another process removed it
            if abs(time.time() - path.lstat().st_mtime) > OLD_S:
                path.unlink()
