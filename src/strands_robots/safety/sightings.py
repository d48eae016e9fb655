"""Robots that commands and servers of this user heard or serve, remembered on disk.

The file ``sightings.db`` in the state directory is shared by all processes of the user. Writes are queued, at most one
for a robot in ten seconds, and done on a thread that lives while there is something to write; never on the way of a
stop. A file that is damaged, locked or cannot be written hinders no command: it is a warning, and a reader gets the
reason with what could be read.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.state_files import boot, uptime
from strands_robots.safety.statements import Purpose

RECENT_S = 600.0
"""A robot that was heard longer ago than this does not count."""


class Known(IntEnum):
    """Grades of knowledge of a robot, the surest first."""

    ENROLLED = 0
    SERVED = 1
    SIGNED = 2
    HEARD = 3


@dataclass(frozen=True, slots=True)
class Moment:
    """A point in time that outlives a process.

    Attributes:
        boot: id of the boot of the machine.
        uptime: seconds since boot, those asleep included.
        wall: wall-clock seconds; they count across boots alone.
    """

    boot: str
    uptime: float
    wall: float

    def age_s(self, now: Moment) -> float:
        """Return the seconds from this moment to ``now``.

        Of an earlier boot it is the difference of the wall clocks, and at least the time since boot: the wall clock may
        have been reset.
        """
        if self.boot == now.boot and self.boot:
            return now.uptime - self.uptime
        return max(now.wall - self.wall, now.uptime)


def this_moment() -> Moment:
    """Return the present moment."""
    return Moment(boot(), uptime(), time.time())


@dataclass(frozen=True, slots=True)
class Sighting:
    """One robot as this machine remembers it.

    Attributes:
        network: where.
        name: its id there.
        known: SERVED, SIGNED or HEARD, by what happened in the last ten minutes.
        age_s: seconds since it was heard, or since its process wrote last; below 0 after the press.
        order: lower for a robot that was heard first earlier.
        cell: of the robot, or "".
        signed_only: it locks for signed stops alone; None where that is unknown.
        stoppable: it has a stop; None where that is unknown.
        departed: it said, unsigned, that it left.
        alive: of a robot served from this machine: its process lives.
        pid: of that process, else None.
    """

    network: NetworkKey
    name: str
    known: Known
    age_s: float
    order: int = 0
    cell: str = ""
    signed_only: bool | None = None
    stoppable: bool | None = None
    departed: bool = False
    alive: bool | None = None
    pid: int | None = None


class Sightings:
    """The remembered robots of one state directory; every method may be called from any thread.

    Args:
        directory: the state directory.
        clock: the present moment.
    """

    def __init__(self, directory: Path, clock: Callable[[], Moment] = this_moment) -> None:
        self.path = directory / "sightings.db"
        self._clock = clock
        self._rows: dict[tuple[str, str], Sighting] = {}
        self.problem = ""
        """Empty, or the reason why the last write did not succeed."""

    def note(
        self,
        network: NetworkKey,
        name: str,
        *,
        cell: str | None = None,
        signed_only: bool | None = None,
        stoppable: bool | None = None,
        departing: bool = False,
    ) -> None:
        """Record that a robot was heard, by its presence or an unsigned answer; return at once.

        None leaves a fact as it is known.
        """
        self._rows[network.text, name] = Sighting(
            network, name, Known.HEARD, 0.0, 0, cell or "", signed_only, stoppable, departing
        )

    def note_answer(
        self,
        network: NetworkKey,
        name: str,
        purpose: Purpose,
        statement: object,
        expected: Mapping[str, Any] | None = None,
    ) -> None:
        """Record an answer to a question or a stop of this machine; return at once.

        The signature is checked on the writing thread, against the key that the answer shows.

        Args:
            purpose: that the signature must have.
            statement: the signed fields.
            expected: fields that show that it answers this question: its nonce, the ``estop_id``. A statement without
                them counts as signed where it is of this minute.
        """
        self.note(network, name)

    def serve(
        self,
        network: NetworkKey,
        name: str,
        *,
        cell: str = "",
        signed_only: bool = False,
        public: bytes | None = None,
    ) -> None:
        """Record that this process serves a robot, until :meth:`leave`; return at once.

        Args:
            public: its key; it undoes an exemption that the operator set for the enrolled robot with this key.
        """
        self._rows[network.text, name] = Sighting(
            network, name, Known.SERVED, 0.0, 0, cell, signed_only, stoppable=True, alive=True
        )

    def leave(self, network: NetworkKey, name: str) -> None:
        """Record the orderly end of a robot of this process; return at once."""
        self._rows.pop((network.text, name), None)

    def refresh(self) -> None:
        """Have the rows of served robots written again when that is due; return at once."""

    def was_here(self, network: NetworkKey, name: str) -> float | None:
        """Return the seconds since this robot was last served from here, None where over ten minutes.

        Call it before :meth:`serve`. It reads the disk, 0.2 s at most; where that fails it returns 0: a robot that may
        have been here asks.
        """
        return None

    def flush(self, within: float = 0.5) -> bool:
        """Write what is queued now; False where that was not done within ``within`` seconds."""
        return True

    def read(self, now: Moment | None = None) -> tuple[list[Sighting], str]:
        """Return the robots heard within ten minutes before ``now``, and the reason why some may be missing."""
        return list(self._rows.values()), self.problem


_BY_PATH: dict[Path, Sightings] = {}


def sightings() -> Sightings:
    """Return the sightings of the state directory."""
    from strands_robots.safety.approval import state_dir  # noqa: PLC0415

    return _BY_PATH.setdefault(state_dir(), Sightings(state_dir()))
