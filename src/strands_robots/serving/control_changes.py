"""Changes of a robot's holder, and those who are told of them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)


@dataclass(frozen=True, slots=True)
class ControlChange:
    """A change of the holder, as observers are told.

    Attributes:
        event: ``acquired``, ``released``, ``expired`` or ``taken``.
        reason: the one that a human gave for taking control.
    """

    event: str
    robot: str
    holder: str
    kind: str
    epoch: int
    reason: str = ""


OnChange = Callable[[ControlChange], None]


class Observers:
    """Observers of a holder's changes; thread-safe, and one that fails alone."""

    def __init__(self) -> None:
        self._changing = threading.Lock()
        self._observers: tuple[OnChange, ...] = ()

    def add(self, observer: OnChange) -> Callable[[], None]:
        """Tell ``observer`` of every change; return what ends that."""
        with self._changing:
            self._observers = (*self._observers, observer)

        def end() -> None:
            with self._changing:
                self._observers = tuple(each for each in self._observers if each is not observer)

        return end

    def tell(self, change: ControlChange) -> None:
        """Hand a change to every observer."""
        for observer in self._observers:
            try:
                observer(change)
            except Exception:
                logger.exception("An observer of the control lease failed.")
