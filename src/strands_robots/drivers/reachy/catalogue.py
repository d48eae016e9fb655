"""Recorded moves, kept on a hub that may be out of reach.

A daemon that asks a hub which accepts and does not answer freezes as a whole, stop included (measured: over 120 s).
So a data set that is not known to be in the daemon's cache is asked for only while nothing moves, over a connection
of its own.
"""

from __future__ import annotations

from strands_robots.drivers.reachy.connection import Connection
from strands_robots.drivers.reachy.motion import Motions
from strands_robots.drivers.reachy.rest import DaemonError
from strands_robots.envelope import Envelope, error, success
from strands_robots.utils import ValidationError, choice, identifier

LIBRARIES = {
    "emotions": "pollen-robotics/reachy-mini-emotions-library",
    "dances": "pollen-robotics/reachy-mini-dances-library",
}


class Library:
    """The recorded moves of one robot's daemon."""

    def __init__(self, connection: Connection, motions: Motions) -> None:
        self._connection, self._motions = connection, motions
        self._known: dict[str, tuple[int, tuple[str, ...]]] = {}

    def names(self, library: str) -> Envelope:
        """``moves`` of a library, or an error that says that they are unknown."""
        checked = choice("library", library, tuple(LIBRARIES))
        refusal = self._fetch(checked)
        if refusal is not None:
            return refusal
        moves = list(self._known[checked][1])
        return success(f"{len(moves)} recorded moves in {checked}.", library=checked, moves=moves)

    def play(self, move_name: str, library: str) -> Envelope:
        """Start a recorded move; its end is told by event and status."""
        name = identifier("move_name", move_name)
        checked = choice("library", library, tuple(LIBRARIES))
        reason = self._connection.refusal()
        if reason is not None:
            return error(f"playMove refused: {reason}.")
        refusal = self._fetch(checked)
        if refusal is not None:
            return refusal
        if name not in self._known[checked][1]:
            return error(f"{checked} has no move {name!r}; listMoves has the names.")
        path = f"/api/move/play/recorded-move-dataset/{LIBRARIES[checked]}/{name}"
        uuid = self._motions.daemon_move(name, path, reached=str)
        return success(f"Playing {name}.", move=name, library=checked, uuid=uuid)

    def _fetch(self, library: str) -> Envelope | None:
        """Make sure that the names are known, and with them that the daemon has the data set; else why not."""
        known = self._known.get(library)
        if known is not None and known[0] == self._connection.connects:
            return None
        unknown = f"The catalogue of {library} is unknown"
        try:
            if self._motions.moving():
                return error(f"{unknown}, and asking while the robot moves could freeze its daemon; stop it first.")
            answer = self._connection.hub_rest.get(f"/api/move/recorded-move-datasets/list/{LIBRARIES[library]}")
        except (DaemonError, ValidationError) as exc:
            return error(f"{unknown}: {exc}")
        if not isinstance(answer, list) or not all(isinstance(name, str) for name in answer):
            return error(f"{unknown}: the daemon's answer is no list of names.")
        self._known[library] = (self._connection.connects, tuple(answer))
        return None
