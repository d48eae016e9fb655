"""How many signatures that do not hold a source may have checked in a second, where checking costs somebody else."""

from __future__ import annotations

SOURCES_MAX = 256


class Budget:
    """Counts failures by source in windows of a second. Times come in, in monotonic seconds; nothing blocks.

    Past :data:`SOURCES_MAX` the oldest source is forgotten, so that invented names take no memory.
    """

    def __init__(self, per_s: int = 20) -> None:
        self._per_s = per_s
        self._spent: dict[str, tuple[float, int]] = {}

    def left(self, source: str, now: float) -> bool:
        """True while ``source`` may have one more checked."""
        since, count = self._spent.get(source, (now, 0))
        return count < self._per_s or now - since >= 1.0

    def spend(self, source: str, now: float) -> None:
        """One of ``source`` did not hold."""
        since, count = self._spent.pop(source, (now, 0))
        self._spent[source] = (since, count + 1) if now - since < 1.0 else (now, 1)
        while len(self._spent) > SOURCES_MAX:
            del self._spent[next(iter(self._spent))]
