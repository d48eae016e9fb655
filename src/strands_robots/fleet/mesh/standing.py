"""Roster of a stop on the native mesh, and the reports of standing controllers."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Collection, Mapping
from itertools import count
from typing import TYPE_CHECKING, Any

from strands_robots.bounded_json import json_object
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.orders import PARSED_MAX_BYTES
from strands_robots.safety.roster import Roster, RosterInbox, RosterRow
from strands_robots.safety.standing_roster import StandingRoster, controllers_identity
from strands_robots.safety.statements import enrolled_peers, lockout_distrust
from strands_robots.safety.stop_link import ESTOP

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh
    from strands_robots.mesh.transport import Sample

REPORTS, STOPS = "missed rosters", "stops of others"
"""Names of the subscriptions."""

_subscriptions = count()


def mesh_network() -> NetworkKey:
    """Return the key of the mesh that this process joins."""
    from strands_robots.mesh.session import network  # noqa: PLC0415 - the network is loaded when it is used

    return network()


class MeshReports:
    """Reports of standing controllers about the stops of one peer.

    Args:
        mesh: the peer.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._mesh, self.inbox = mesh, RosterInbox(_fields)
        # Of two with one name the later would end the earlier one's.
        self._name = f"{REPORTS} {next(_subscriptions)}"

    def begin(self) -> None:
        """Receive reports from now on."""
        from strands_robots.mesh import topics  # noqa: PLC0415 - the network is loaded when it is used

        self._mesh.listen(topics.missed_roster("*"), self._take, self._name)

    def close(self) -> None:
        """Receive none any more."""
        self._mesh.unsubscribe(self._name)
        self.inbox.end()

    def _take(self, sample: Sample) -> None:
        self.inbox.put(sample.key.split("/")[1], sample.payload)


def stand_on_mesh(mesh: Mesh, signing_key: Any, also: Callable[[], Collection[str]] = tuple) -> StandingRoster:
    """Have a peer without a robot report whom it misses after a stop of another one.

    Args:
        mesh: the peer.
        signing_key: of its e-stops, or None.
        also: returns names that it shows besides its roster.
    """
    from strands_robots.mesh import topics  # noqa: PLC0415 - the network is loaded when it is used
    from strands_robots.mesh.transport import TransportError  # noqa: PLC0415 - as above
    from strands_robots.mesh.wire import WireError  # noqa: PLC0415 - as above

    where = mesh_network()

    def publish(fields: Mapping[str, Any]) -> None:
        with contextlib.suppress(TransportError, WireError):  # a link that is down carries no report
            mesh.publish(topics.missed_roster(mesh.peer_id), dict(fields))

    def unlocked(estop_id: str, rows: Mapping[str, RosterRow]) -> list[str]:
        peers, keys = mesh.peers_by_id, enrolled_peers()
        return [name for name in rows if not _locked(name, peers.get(name, {}), estop_id, keys)]

    standing = StandingRoster(
        mesh.peer_id,
        publish,
        roster=lambda: Roster.of(where),
        keys=dict,
        identity=functools.cache(lambda: controllers_identity(mesh.peer_id, signing_key)),
        also=also,
        read=_stop,
        unanswered=unlocked,
    )
    mesh.listen(topics.estop(), lambda sample: standing.hear(ESTOP, str(sample.session), sample.payload), STOPS)
    return standing


def _fields(payload: bytes) -> Mapping[str, Any]:
    return json_object(payload, PARSED_MAX_BYTES)


def _stop(sender: str, payload: bytes) -> tuple[str, Mapping[str, Any]]:
    body = json_object(payload, PARSED_MAX_BYTES)
    return str(body.get("peer_id", ""))[:128], body


def _locked(name: str, row: Mapping[str, Any], estop_id: str, keys: Mapping[str, bytes] | None) -> bool:
    """Return True for a peer that announces this lockout."""
    epochs = row.get("epochs")
    if not isinstance(epochs, list) or estop_id not in epochs or row.get("reachable") is not True:
        return False
    return not lockout_distrust(name, row, epochs, keys)
