"""``peers --mesh`` and ``call --mesh``: the peers of the native mesh."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from rich.text import Text

from strands_robots.cli.network import mesh_peer, temporary_mesh_id
from strands_robots.cli.output import CliError, Exit, Screen, label, plain, table, with_tags
from strands_robots.envelope import Envelope
from strands_robots.safety.peer_answers import enrolled_peers, lockout_distrust
from strands_robots.safety.statements import ALARM
from strands_robots.tags import read_tags
from strands_robots.tools import networks

if TYPE_CHECKING:
    from strands_robots.serving.advertised import AdvertisedVerb


def list_peers(screen: Screen, timeout: float) -> None:
    """List the mesh peers that announce themselves within ``timeout`` seconds."""
    with mesh_peer(None, temporary_mesh_id("console"), "tool") as mesh:
        time.sleep(timeout)
        rows, keys = [row for row in mesh.peers if row["reachable"]], enrolled_peers()
    for row in rows:
        row["tags"] = list(read_tags(row.get("tags")))
        if "locked" in row and (why := lockout_distrust(row["peer_id"], row, row.get("epochs") or [], keys)):
            row["distrusted"] = why
    if not rows:
        raise CliError("No peer is on the mesh of this machine.", Exit.SILENT, peers=[])
    screen.data({"status": "success", "peers": rows})
    cells = [(r["peer_id"], r["type"], r["hostname"], _status(r), f"{r['age']:.1f} s") for r in rows]
    heads = ("peer", "type", "host", "status", "last heard")
    screen.show(table("", *with_tags(heads, cells, [row["tags"] for row in rows])))


def call_peer(
    device: str,
    command: Mapping[str, Any],
    seconds: Callable[[AdvertisedVerb | None], float],
    fit: Callable[[AdvertisedVerb], Mapping[str, Any]],
) -> Envelope:
    """Have a peer carry an action out, as :func:`networks.ask` does.

    Raises:
        CliError: no such peer, no answer or no network (exit code 3).
        ValidationError: an argument does not fit.
    """
    from strands_robots.mesh.transport import TransportError  # noqa: PLC0415 - loaded when a network is used

    with mesh_peer(None, temporary_mesh_id(networks.SOURCE), "tool") as mesh:
        try:
            return networks.ask(mesh, device, command, seconds, fit)
        except (networks.NoPeerError, networks.SilentPeerError, TransportError) as exc:
            raise CliError(plain(str(exc), 2000), Exit.SILENT) from exc


def _status(row: Mapping[str, Any]) -> str | Text:
    """Return the task's state, or the lockout, or that emergency stops do not arrive."""
    if row.get("estop_unheard"):
        return label("CANNOT RECEIVE STOPS", "bold red")
    if why := str(row.get("distrusted", "")):
        return label(why, "bold red" if why.startswith(ALARM) else "yellow")
    return label("LOCKED", "bold red") if row.get("locked") is True else str(row.get("task_status", ""))
