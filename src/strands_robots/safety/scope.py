"""Scope of an emergency stop: every robot, some by name, or one cell.

A scope only ever takes robots out of a stop. What cannot be read, or is not proven where stops are signed, therefore
counts as *every robot*.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from strands_robots import settings
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, identifier

logger = stop_logger(__name__)

SCOPE, SCOPE_SIGNATURE = "scope", "scope_sig"
"""Fields of an emergency stop: its scope, and the signature over it."""

ONLY_MAX = 64
"""Robots that one scope names; a longer list means every robot."""


@dataclass(frozen=True, slots=True)
class Scope:
    """The robots that a stop is for.

    Attributes:
        only: their names on the network; empty for no choice by name.
        cell: the cell whose robots it is for, besides every robot without a cell; empty for no choice by cell.
        everything: a stop of every robot.
    """

    only: frozenset[str] = frozenset()
    cell: str = ""
    everything: bool = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "everything", not (self.only or self.cell))

    @classmethod
    def named(cls, names: Iterable[str]) -> Scope:
        """Return the scope of these robots; of every robot where the names are unfit."""
        return cls.read({"only": list(names)})

    @classmethod
    def read(cls, value: object) -> Scope:
        """Return the scope on a wire or in a file; every robot where it is none.

        A scope is ``{"only": [names]}`` with 1 to 64 names, or ``{"cell": name}``, and nothing else.
        """
        if not isinstance(value, Mapping) or len(value) != 1:
            return EVERY_ROBOT
        only, cell = value.get("only"), value.get("cell")
        try:
            if isinstance(only, list) and 1 <= len(only) <= ONLY_MAX:
                return cls(frozenset(identifier("only", each) for each in only))
            return EVERY_ROBOT if cell is None else cls(cell=identifier("cell", cell))
        except ValidationError:
            return EVERY_ROBOT

    def covers(self, name: str, cells: Collection[str]) -> bool:
        """Return True for a robot that has to stop.

        Args:
            name: its name on the network.
            cells: those that it is in; none of them puts it into each.
        """
        if self.only:
            return name in self.only
        return not (self.cell and cells) or self.cell in cells

    def names(self, name: str, cell: object) -> bool:
        """Return True for a robot that was meant: named, or in that very cell."""
        return name in self.only if self.only else not self.cell or cell == self.cell

    def value(self) -> dict[str, Any]:
        """Return the scope as the wire has it; empty for every robot."""
        if self.only:
            return {"only": sorted(self.only)}
        return {"cell": self.cell} if self.cell else {}

    def field(self) -> dict[str, Any]:
        """Return the field ``scope`` of a message or a record; nothing for every robot."""
        return {} if self.everything else {SCOPE: self.value()}

    @property
    def meant(self) -> str:
        """The robots that :meth:`names` looks for, in words."""
        if self.only:
            return f"robot named {' or '.join(sorted(self.only))}"
        return f"robot of cell {self.cell}" if self.cell else "robot"

    def __str__(self) -> str:
        if self.only:
            return f"{', '.join(sorted(self.only))} only"
        return f"cell {self.cell} and robots without a cell" if self.cell else "every robot"


EVERY_ROBOT = Scope()

WIDEN_S = 0.2
"""Seconds after which a stop of some robots becomes one of every robot, where none of them answered or is known.

Robots that are not read from the disk by then are not known: where it is not sure, every robot stops.
"""

Remembers = Callable[[Scope], bool]
"""Says whether this machine knows a robot that a scope means; it may read the disk."""


def none_known(scope: Scope) -> bool:
    """Return False: no robot is known."""
    return False


class KnownRobots:
    """Search on a thread for a robot in a scope that this machine knows.

    Make it once the stop has left: a disk that hangs delays no stop, and counts as *none is known*.

    Attributes:
        known: a robot in the scope was found.
    """

    def __init__(self, scope: Scope, remembers: Remembers) -> None:
        self.known = False
        self._scope, self._remembers = scope, remembers
        threading.Thread(target=self._ask, name="stop scope", daemon=True).start()

    def _ask(self) -> None:
        try:
            self.known = self._remembers(self._scope)
        except Exception:
            logger.critical("The robots known here cannot be read, so none counts as known.", exc_info=True)

    @property
    def widens_after_s(self) -> float:
        """Seconds from the stop to its widening; infinite where a robot is known."""
        return math.inf if self.known else WIDEN_S


def report_widened(epoch: str, scope: Scope) -> None:
    """Log that a stop of some robots has become one of every robot."""
    logger.critical(
        "Emergency stop %s was for %s. No %s has answered or is known here: EVERY ROBOT IS STOPPED.",
        epoch,
        scope,
        scope.meant,
    )


def own_cell(cell: str | None) -> str:
    """Return the cell of a robot of this process, empty for none.

    Args:
        cell: as given; None asks ``STRANDS_CELL``.

    Raises:
        ValidationError: it is no identifier.
    """
    stated = settings.raw("STRANDS_CELL") if cell is None else cell
    return identifier("cell", stated) if stated else ""
