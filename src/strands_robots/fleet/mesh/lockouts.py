"""Lockouts of peers on the mesh, asked for and cleared."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from strands_robots.fleet.adapter import TOO_MANY, LockoutReport, Resumed
from strands_robots.fleet.shared_id import Keys
from strands_robots.safety.lockout import OVERFLOW, Lockout
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.resume import sign
from strands_robots.safety.statements import enrolled_key, enrolled_peers, lockout_distrust, resume_distrust
from strands_robots.utils import shown

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh

PARALLEL_REQUESTS = 64
"""Peers that are asked at a time: so many silent ones keep no other one waiting."""

RELAYED_S = 1.0
"""Seconds in which a resume reaches all robots from the first one, before each is asked by itself."""


def lockable_peers(mesh: Mesh) -> list[str]:
    """Return the peers in reach that have a robot, without a world's children."""
    rows = {row["peer_id"]: row for row in mesh.peers if row["reachable"]}
    return [
        name
        for name, row in rows.items()
        if ("locked" in row or "tool_name" in row) and name.rpartition("__")[0] not in rows
    ]


def ask_peers(mesh: Mesh, names: Iterable[str], seconds: float) -> list[LockoutReport]:
    """Ask each peer for its status, in parallel.

    An enrolled robot whose answer is not its own has a ``problem``.
    """
    wanted, keys = list(dict.fromkeys(names)), enrolled_peers()
    with ThreadPoolExecutor(PARALLEL_REQUESTS) as pool:
        return list(pool.map(lambda name: ask_peer(mesh, name, seconds, keys), wanted))


def ask_peer(mesh: Mesh, name: str, seconds: float, keys: Keys) -> LockoutReport:
    """Ask one peer for its status.

    Args:
        mesh: the peer that asks.
        name: the peer that is asked.
        seconds: in which it has to answer.
        keys: enrolled ones; without any no answer counts.
    """
    began = time.monotonic()
    nonce = new_epoch() if keys and enrolled_key(name, keys) else ""
    reply = mesh.send(name, {"action": "status", **({"nonce": nonce} if nonce else {})}, seconds)
    took_ms = (time.monotonic() - began) * 1000
    result = reply.get("result")
    if reply.get("type") != "response" or not isinstance(result, Mapping):
        return LockoutReport(name, problem=shown(reply["error"]) if reply.get("error") else "no answer")
    rows = result.get("lockout")
    if not isinstance(rows, list):
        return LockoutReport(name, problem="it does not report lockouts", facts=result, round_trip_ms=took_ms)
    lockouts = tuple(Lockout.of(each) for each in rows if isinstance(each, Mapping))
    distrusted = lockout_distrust(name, result, [each.epoch for each in lockouts], keys, nonce)
    problem = distrusted or str(result.get("estop_unheard", ""))
    return LockoutReport(name, () if distrusted else lockouts, problem, result, took_ms)


def resume_peers(mesh: Mesh, found: Sequence[LockoutReport], signer: Any, seconds: float) -> dict[str, Resumed]:
    """Resume every epoch of these peers; return each one's outcome.

    A resume is sent to one of its targets, which relays it. A robot that is still locked then gets a resume of its own.
    """
    locked = {each.name: each.lockouts for each in found if not each.problem}
    names: dict[str, list[str]] = {}
    for name, lockouts in locked.items():
        for each in lockouts:
            names.setdefault(each.epoch, []).append(name)
    said: dict[str, str] = {}
    for epoch in names.keys() - {OVERFLOW}:
        for assertion in sign(signer, epoch, names[epoch]):
            first = assertion["targets"][0]
            said[first] = _send(mesh, first, assertion, seconds)
    left = _still_locked(mesh, locked, RELAYED_S)
    for name, lockouts in left.items():
        for each in lockouts:
            for assertion in sign(signer, each.epoch, [name]) if each.epoch != OVERFLOW else ():
                said[name] = _send(mesh, name, assertion, seconds)
    left = _still_locked(mesh, left, seconds) if left else left
    return {
        name: (name not in left, _outcome(lockouts, left.get(name), said.get(name, "")))
        for name, lockouts in locked.items()
    } | {each.name: (False, each.problem) for each in found if each.problem}


def _still_locked(
    mesh: Mesh, locked: Mapping[str, tuple[Lockout, ...]], within: float
) -> dict[str, tuple[Lockout, ...]]:
    """Ask until all are free, at most ``within`` seconds; return those that are not."""
    left = {name: lockouts for name, lockouts in locked.items() if lockouts}
    deadline = time.monotonic() + within
    while left:
        answers = ask_peers(mesh, left, within)
        left = {each.name: each.lockouts or left[each.name] for each in answers if each.lockouts or each.problem}
        if time.monotonic() >= deadline:
            break
        time.sleep(0.05)
    return left


def _outcome(before: tuple[Lockout, ...], left: tuple[Lockout, ...] | None, said: str) -> str:
    if left is None:
        return "free to move when told to" if before else "was not locked"
    if any(each.epoch == OVERFLOW for each in left):
        return TOO_MANY
    return f"{said or 'it did not confirm'}: its own audit says why"


def _send(mesh: Mesh, name: str, assertion: Mapping[str, Any], seconds: float) -> str:
    reply = mesh.send(name, {"action": "resume", "assertion": assertion}, seconds)
    result = reply.get("result")
    if not isinstance(result, Mapping):
        return str(reply.get("error") or "no answer")
    return resume_distrust(name, assertion, result, enrolled_peers()) or str(result.get("error", ""))
