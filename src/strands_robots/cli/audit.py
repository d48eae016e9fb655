"""``audit tail|show|verify``: the safety record of this machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer

from strands_robots.audit import (
    NOT_ON_DISK,
    audit_directory,
    compare_with_witnesses,
    read_audit_log,
    verify_audit_integrity,
)
from strands_robots.audit.verification import FACTS_REPLACED, SIGNATURES
from strands_robots.cli.output import CliError, Screen, plain, readable, table
from strands_robots.safety.lockout import utc
from strands_robots.utils import number, whole

T = TypeVar("T")

FOLLOW_S = 0.3
NOT_INTACT = "The audit is not intact: records were changed, left out, cut off or rolled back."
NOT_VERIFIED = (
    "The audit was not verified: {} of {} records are signed, and STRANDS_MESH_AUDIT_PSK is not set here. "
    "Set the secret that they were signed with, and verify again."
)
REPLACED = "The audit is not complete: the facts of {} of {} records could not be written, and stand there as text."
NOT_WRITTEN = "The audit is not complete: records of this process are not on the disk yet."
GRAVE = ("bad", "missing", "gaps", "broken", "tampered")
NEVER_BEGUN = "There is no audit: nothing was recorded here with this secret yet, or all of it was deleted."
NOT_OURS = "{} lines of another writer, perhaps strands-robots 0.5: use a new STRANDS_MESH_AUDIT_DIR."
FIRST_FIELDS = ("stopped", "source", "who", "why", "reason", "estop_id", "epoch")
HIDDEN_FIELDS = ("device_id", "epochs", "issued", "pressed_at", "timing", "repeated", "late", "road", "persisted")


def tail(
    screen: Screen,
    *,
    count: Annotated[int, typer.Option("--count", "-n", help="How many.")] = 20,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Continue with new ones until Ctrl-C.")] = False,
) -> None:
    """Print the last records. With --json: one a line."""
    many = whole("--count", count, low=1, high=1_000_000)
    records = _records()
    if not records:
        screen.say(f"No record in {audit_directory()}.")
    _print(screen, records[-many:])
    seen = {_key(each) for each in records}
    while follow:
        time.sleep(FOLLOW_S)
        latest = max((_at(each) for each in records), default=0.0)
        # A clock that was set back must not hide a record.
        fresh = [each for each in _records(latest - 60.0) if _key(each) not in seen]
        seen |= {_key(each) for each in fresh}
        records = fresh or records
        _print(screen, fresh)


def show(
    screen: Screen,
    *,
    what: Annotated[str | None, typer.Argument(help="An emergency stop's id, a robot or an event.")] = None,
    since: Annotated[float | None, typer.Option("--last", help="Only the last that many seconds.")] = None,
) -> None:
    """Print every record that contains WHAT, without signatures; else all."""
    after = None if since is None else time.time() - number("--last", since, above=0, high=1e10)
    found = [each for each in _records(after) if what is None or _contains(each, what)]
    if not found:
        raise CliError(
            f"No record in {audit_directory()} contains {what}." if what else "There is no record.", records=[]
        )
    for each in found:
        screen.data(each)
        screen.say(f"{_when(each)}  {each['peer_id']}  {each.get('event')}  number {each['seq']}", "bold")
        payload = readable(each.get("payload"))
        for name, value in payload.items() if isinstance(payload, Mapping) else (("", payload),):
            screen.say(f"  {plain(name)}: {plain(value, 2000)}")


def verify(
    screen: Screen,
    *,
    witnesses: Annotated[
        list[Path] | None, typer.Option("--with", help="An audit file of another machine, such as a controller's.")
    ] = None,
) -> None:
    """Check the chain, the numbers and the signatures.

    Exits with 1 when the record was cut or changed, or could not be verified.
    """
    found = _readable(verify_audit_integrity)
    if witnesses:
        seen, gone = _readable(lambda: compare_with_witnesses(witnesses))
        found |= {"witnesses": seen, "breaks": [*found["breaks"], *gone], "ok": found["ok"] and not gone}
        screen.say(f"{seen} records of other machines are about this audit.")
    counts = ("total", "signed", "verified", "bad", "missing", "gaps", "broken", "torn", "tampered", "replaced")
    screen.say(str(audit_directory()))
    screen.show(table("", ("what", "count"), ((name, found[name]) for name in counts)))
    for each in found["breaks"]:
        screen.say(f"{each['where']}: {each['why']}", "red")
    if not found["ok"]:
        raise CliError(_verdict(found), **found)
    if found["torn"] and not found["total"]:
        raise CliError(NOT_OURS.format(found["torn"]), **found | {"ok": False})
    screen.data({"status": "success", **found})
    end = "" if found["head"] == "ok" else " A cut at its end cannot be excluded: its head is missing."
    screen.say(f"The audit is intact: {found['total']} records.{end}", "yellow" if end else "green")


def _verdict(found: Mapping[str, Any]) -> str:
    """Return the sentence on an audit that is not ok: on the gravest thing."""
    total, unverified = found["total"], found["signed"] - found["verified"] - found["bad"]
    lesser = [each for each in found["breaks"] if each["why"] in {FACTS_REPLACED, NOT_ON_DISK}]
    lesser += [each for each in found["breaks"] if each["where"].endswith(SIGNATURES)]
    if found["head"] == "missing" and not total:
        return f"{NOT_OURS.format(found['torn'])} {NEVER_BEGUN}" if found["torn"] else NEVER_BEGUN
    if len(lesser) < len(found["breaks"]) or any(found[name] for name in GRAVE) or found["head"] in ("cut", "older"):
        return NOT_INTACT
    if unverified:
        return NOT_VERIFIED.format(unverified, total)
    return REPLACED.format(found["replaced"], total) if found["replaced"] else NOT_WRITTEN


def _records(since: float | None = None) -> list[dict[str, Any]]:
    return _readable(lambda: read_audit_log(since))


def _readable(read: Callable[[], T]) -> T:
    try:
        return read()
    except (OSError, ValueError) as exc:
        raise CliError(f"The audit in {audit_directory()} cannot be read: {exc}") from exc


def _print(screen: Screen, records: Iterable[dict[str, Any]]) -> None:
    for each in records:
        screen.data(each)
        screen.say(_line(each))


def _line(record: Mapping[str, Any]) -> str:
    """Return a record as one line, without the technical fields of ``show``."""
    payload = readable(record.get("payload"))
    facts = dict(payload) if isinstance(payload, Mapping) else {"payload": payload}
    first = [name for name in FIRST_FIELDS if name in facts]
    last = [name for name in facts if name not in FIRST_FIELDS and name not in HIDDEN_FIELDS]
    fields = [
        f"{plain(name)}={plain(facts[name], 60)}" for name in (*first, *last) if facts[name] not in ("", None, [], {})
    ]
    return " ".join([_when(record), plain(record.get("peer_id", "")), plain(record.get("event", "")), *fields])


def _contains(value: object, what: str) -> bool:
    """Return True when ``what`` is a text, key or item anywhere in the record."""
    if isinstance(value, Mapping):
        return any(key == what or _contains(each, what) for key, each in value.items())
    if isinstance(value, list):
        return any(_contains(each, what) for each in value)
    return value == what


def _key(record: Mapping[str, Any]) -> tuple[object, object]:
    return record.get("peer_id"), record.get("seq")


def _at(record: Mapping[str, Any]) -> float:
    at = record.get("ts")
    return float(at) if isinstance(at, int | float) else 0.0


def _when(record: Mapping[str, Any]) -> str:
    return utc(_at(record))
