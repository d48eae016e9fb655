"""``audit tail|show|verify``: the safety record of this machine."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

import typer

from strands_robots.audit import audit_directory, read_audit_log, verify_audit_integrity
from strands_robots.cli.command import command
from strands_robots.cli.output import Failure, Screen, plain, table
from strands_robots.safety.lockout import utc
from strands_robots.utils import number, whole

FOLLOW_S = 0.3
FIRST = ("stopped", "source", "who", "why", "reason", "estop_id", "epoch")
SELDOM = ("device_id", "epochs", "issued", "timing", "repeated", "late", "road", "persisted")


def register(app: typer.Typer) -> None:
    """Add ``audit`` to the application."""
    audit = typer.Typer(no_args_is_help=True, help="The safety record of this machine.")
    command(audit, "tail")(tail)
    command(audit, "show")(show)
    command(audit, "verify")(verify)
    app.add_typer(audit, name="audit")


def tail(
    screen: Screen,
    *,
    count: Annotated[int, typer.Option("--count", "-n", help="How many.")] = 20,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on with new ones until Ctrl-C.")] = False,
) -> None:
    """The last records. With --json: one a line."""
    many = whole("--count", count, low=1, high=1_000_000)
    records = _records()
    _listed(screen, records[-many:])
    seen = {_mark(each) for each in records}
    while follow:
        time.sleep(FOLLOW_S)
        latest = max((_at(each) for each in records), default=0.0)
        # A clock that was set back must not hide a record.
        fresh = [each for each in _records(latest - 60.0) if _mark(each) not in seen]
        seen |= {_mark(each) for each in fresh}
        records = fresh or records
        for each in fresh:
            screen.data(each)
            screen.say(_line(each))


def show(
    screen: Screen,
    *,
    what: Annotated[str | None, typer.Argument(help="An emergency stop's id, a robot or an event.")] = None,
    since: Annotated[float | None, typer.Option("--last", help="Only the last that many seconds.")] = None,
) -> None:
    """Every record in full that names WHAT; without it every record."""
    after = None if since is None else time.time() - number("--last", since, above=0, high=1e10)
    found = [each for each in _records(after) if what is None or _names(each, what)]
    if not found:
        raise Failure(f"No record in {audit_directory()} names {what}." if what else "There is no record.", records=[])
    for each in found:
        screen.data(each)
        screen.say(f"{_when(each)}  {each['peer_id']}  {each.get('event')}  number {each['seq']}", "bold")
        payload = each.get("payload")
        for name, value in payload.items() if isinstance(payload, Mapping) else (("", payload),):
            screen.say(f"  {plain(name)}: {plain(value, 2000)}")


def verify(screen: Screen) -> None:
    """Check the chain, the numbers and the signatures. Exits with 1 when the record was cut or changed."""
    try:
        found = verify_audit_integrity()
    except (OSError, ValueError) as exc:
        raise Failure(f"The audit in {audit_directory()} cannot be read: {exc}") from exc
    counts = ("total", "signed", "verified", "bad", "missing", "gaps", "broken", "torn")
    screen.say(str(audit_directory()))
    screen.show(table("", ("what", "count"), ((name, found[name]) for name in counts)))
    for each in found["breaks"]:
        screen.say(f"{each['where']}: {each['why']}", "red")
    if not found["ok"]:
        raise Failure("The audit does not hold together: records were changed, left out or cut off.", **found)
    screen.data({"status": "success", **found})
    end = "" if found["head"] == "ok" else " A cut at its end cannot be excluded: its head is missing."
    screen.say(f"The audit holds together: {found['total']} records.{end}", "yellow" if end else "green")


def _records(since: float | None = None) -> list[dict[str, Any]]:
    try:
        return read_audit_log(since)
    except (OSError, ValueError) as exc:
        raise Failure(f"The audit in {audit_directory()} cannot be read: {exc}") from exc


def _listed(screen: Screen, records: Iterable[dict[str, Any]]) -> None:
    empty = True
    for each in records:
        empty = False
        screen.data(each)
        screen.say(_line(each))
    if empty:
        screen.say(f"No record in {audit_directory()}.")


def _line(record: Mapping[str, Any]) -> str:
    """A record in one line: what tells most of it comes first, what seldom does is left to ``show``."""
    payload = record.get("payload")
    facts = dict(payload) if isinstance(payload, Mapping) else {"payload": payload}
    first = [name for name in FIRST if name in facts]
    last = [name for name in facts if name not in FIRST and name not in SELDOM]
    told = [
        f"{plain(name)}={plain(facts[name], 60)}" for name in (*first, *last) if facts[name] not in ("", None, [], {})
    ]
    who, what = plain(record.get("peer_id", "")), plain(record.get("event", ""))
    return f"{_when(record)} {who} {what} {' '.join(told)}"


def _names(value: object, what: str) -> bool:
    """True when ``what`` is a text, a key or a list's item anywhere in the record."""
    if isinstance(value, Mapping):
        return any(key == what or _names(each, what) for key, each in value.items())
    if isinstance(value, list):
        return any(_names(each, what) for each in value)
    return value == what


def _mark(record: Mapping[str, Any]) -> tuple[object, object]:
    return record.get("peer_id"), record.get("seq")


def _at(record: Mapping[str, Any]) -> float:
    at = record.get("ts")
    return float(at) if isinstance(at, int | float) else 0.0


def _when(record: Mapping[str, Any]) -> str:
    return utc(_at(record))
