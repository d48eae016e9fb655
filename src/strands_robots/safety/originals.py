"""Emergency stops as they arrived, kept while they lock a robot of this process."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from strands_robots.safety import ed25519
from strands_robots.state_files import boot, uptime

STOPS_MAX = 64
"""Originals kept, and told in one answer."""

ORIGINAL_MAX_BYTES = 8 * 2**10
"""A longer stop locks as any other one and is not passed on."""

STORED_MAX_BYTES = 56 * 2**10
"""Bytes of originals in the lockout file of one robot, as many as an answer holds."""


@dataclass(frozen=True, slots=True)
class Original:
    """One emergency stop as it arrived.

    Attributes:
        epoch: its id, stated by itself.
        source: who stops, as declared.
        payload: the message.
        network: where it was received; it is passed on nowhere else.
        received: seconds since boot of its first receipt, see :func:`~strands_robots.state_files.uptime`.
        learnt: that moment is one that an answer to this process stated.
    """

    epoch: str
    source: str
    payload: bytes
    network: str
    received: float
    learnt: bool = False

    def record(self) -> dict[str, Any]:
        """Return the original as it stands in a file."""
        event = ed25519.encode(self.payload)
        stated = {"epoch": self.epoch, "source": self.source, "event": event, "network": self.network}
        return {**stated, **moment(self.received), **({"learnt": True} if self.learnt else {})}

    @classmethod
    def of(cls, record: Mapping[str, Any]) -> Original:
        """Read an original of a file.

        Raises:
            KeyError, TypeError, ValueError: it is none.
        """
        payload = ed25519.decode_up_to(record["event"], ORIGINAL_MAX_BYTES)
        texts = [record[name] for name in ("epoch", "source", "network")]
        if payload is None or not all(isinstance(each, str) for each in texts):
            raise ValueError("an original without its bytes or its names")
        return cls(texts[0], texts[1], payload, texts[2], since_boot(record), record.get("learnt") is True)


def moment(up: float) -> dict[str, Any]:
    """Return a moment in seconds since boot as it stands in a file."""
    return {"boot": boot(), "up": up, "wall": time.time() - (uptime() - up)}


def since_boot(record: Mapping[str, Any]) -> float:
    """Return a recorded moment in seconds since boot, below 0 if of an earlier one.

    Within a boot no clock that can be set counts.
    """
    if record["boot"] == boot():
        return float(record["up"])
    return uptime() - max(0.0, time.time() - float(record["wall"]))


def newest_within(originals: Sequence[Original], longest: int, length: Callable[[Original], int]) -> list[Original]:
    """Return the newest originals whose lengths sum up to ``longest``, oldest first.

    Sources take turns, so that many stops of one displace no other one's latest.
    """
    waiting: dict[str, list[Original]] = {}
    for each in sorted(originals, key=lambda each: each.received):
        waiting.setdefault(each.source, []).append(each)
    taken: list[Original] = []
    while waiting and len(taken) < STOPS_MAX:
        for source in list(waiting):
            each = waiting[source].pop()
            if not waiting[source]:
                del waiting[source]
            if length(each) <= longest and len(taken) < STOPS_MAX:
                longest -= length(each)
                taken.append(each)
    return sorted(taken, key=lambda each: each.received)


class Originals:
    """Originals of a process. :meth:`add` takes no lock; any thread may call."""

    def __init__(self) -> None:
        self._new: deque[Original] = deque(maxlen=2 * STOPS_MAX)
        self._stored: dict[tuple[str, str], tuple[Original, ...]] = {}
        self._lock = threading.Lock()

    def add(self, original: Original) -> None:
        """Keep an original; of several of one stop the first and the latest count.

        The latest may be for more robots than the first.
        """
        self._new.append(original)

    def younger(self, network: str, epoch: str, payload: bytes, received: float) -> None:
        """Correct the moment of an original that was learnt, if it was received later.

        Whoever states too high an age must not have others take a stop for one from before their time.
        """
        with self._lock:
            self._sort_in()
            rows = self._stored.get((network, epoch), ())
            if any(each.learnt and each.payload == payload and each.received < received for each in rows):
                self._stored[network, epoch] = tuple(
                    replace(each, received=received) if each.learnt and each.payload == payload else each
                    for each in rows
                )

    def has(self, epoch: str, network: str) -> bool:
        """Return True where this stop is kept, or is about to be."""
        try:
            new = tuple(self._new)
        except RuntimeError:
            # A collection of garbage let other threads run during the copy. To add one twice is no harm.
            new = ()
        return (network, epoch) in self._stored or any((each.network, each.epoch) == (network, epoch) for each in new)

    def of(self, epochs: Collection[str], network: str | None = None) -> list[Original]:
        """Return those of these epochs, oldest first."""
        with self._lock:
            self._sort_in()
            rows = [each for rows in self._stored.values() for each in rows]
        return [each for each in rows if each.epoch in epochs and network in (None, each.network)]

    def keep(self, epochs: Collection[str]) -> None:
        """Forget the originals of other epochs, and beyond :data:`STOPS_MAX` the oldest."""
        with self._lock:
            self._sort_in()
            held = [each for rows in self._stored.values() for each in rows if each.epoch in epochs]
            kept = newest_within(held, STOPS_MAX * ORIGINAL_MAX_BYTES, lambda each: len(each.payload))
            self._stored = {}
            self._take(kept)

    def _sort_in(self) -> None:
        new = [self._new.popleft() for _ in range(len(self._new))]
        self._take(new)

    def _take(self, originals: Iterable[Original]) -> None:
        for each in originals:
            key = (each.network, each.epoch)
            known = self._stored.get(key, ())
            if each not in known:
                self._stored[key] = (*known[:1], each)
