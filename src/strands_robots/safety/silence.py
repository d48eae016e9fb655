"""Reasons why a robot gave no answer to a stop, where they can be known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from strands_robots.safety.network_key import MESH, NetworkKey
from strands_robots.safety.roster import RosterRow

UNTOLD = "Zenoh does not tell a sender whether access rules drop a stop."
"""Said beside silent robots where the network cannot name that reason."""


@dataclass(frozen=True, slots=True)
class Sending:
    """Facts of the sending of a stop.

    Attributes:
        left: it left this machine.
        signed: with ``--key``.
        denied: what the broker said to refuse it, or "".
        tells: the network tells a sender what it refuses.
    """

    left: bool = True
    signed: bool = False
    denied: str = ""
    tells: bool = False


def reason_of(
    row: RosterRow, sending: Sending, *, found: bool, elsewhere: Mapping[str, tuple[NetworkKey, float]]
) -> str:
    """Return why a robot of the roster may be silent: only what is known.

    Args:
        row: the robot.
        sending: how the stop was sent.
        found: it was heard on this network since the press.
        elsewhere: the network where a robot of this name was heard last, and seconds since.
    """
    if not sending.left:
        return "the stop did not leave this machine: the link is down"
    if sending.denied:
        return f"the broker refuses this sender's stops: {sending.denied}"
    if row.alive is not None:
        return _process(row)
    if row.signed_only and not sending.signed:
        return "it acts on signed stops alone: estop --key FILE"
    if row.departed:
        return "it said that it leaves the network; that was not signed"
    if found or (row.age_s is not None and row.age_s < 0):
        return "it is on this network and does not answer"
    where, ago = elsewhere.get(row.name, (None, 0.0))
    if where is not None and (row.age_s is None or ago < row.age_s):
        return f"it was heard {seconds(ago)} ago on another network: {described(where)}"
    if row.reported_by:
        return f"this machine has not heard it; {row.reported_by} has, and misses it too"
    if row.age_s is None:
        return "no route to it: it was not heard in the last ten minutes"
    return f"no route to it: it was last heard {seconds(row.age_s)} before"


def described(network: NetworkKey) -> str:
    """Return a network in words."""
    where = ", ".join(network.where[:2])
    return f"the native mesh at {where}" if network.kind == MESH else f"tenant {network.tenant} at {where}"


def seconds(age_s: float) -> str:
    """Return an age for a sentence, such as ``42 s``."""
    return f"{age_s:.0f} s" if age_s < 600 else f"{age_s / 60:.0f} min"


def cannot_answer(row: RosterRow) -> bool:
    """Return True where its process on this machine has ended, or is stopped."""
    return row.alive is not None and (not row.alive or process_state(row.pid) in ("Z", "X", "T", "t"))


def _process(row: RosterRow) -> str:
    state = process_state(row.pid) if row.alive and row.pid else ""
    if not row.alive or state in ("Z", "X"):
        return "its process on this machine has ended"
    if state in ("T", "t"):
        how = "SIGSTOP" if state == "T" else "a debugger"
        return f"its process {row.pid} on this machine is stopped ({how})"
    return f"its process {row.pid} on this machine is there and does not answer"


def process_state(pid: int | None) -> str:
    """Return the letter of a process's state in /proc, such as T, or ""."""
    try:
        status = Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return ""
    return status.rpartition(b")")[2].split()[:1][0].decode("ascii", "replace") if b")" in status else ""
