"""A row of a benchmark table, and how a table is shown."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Row:
    """One measured claim.

    ``ours`` and ``against`` are the figures with their unit, as text; ``ratio`` is ours over against, None where
    nothing is compared; ``must`` is the bound in words and ``ok`` whether this run kept it.
    """

    what: str
    ours: str
    against: str
    ratio: float | None
    must: str
    ok: bool


def markdown(rows: Iterable[Row]) -> str:
    """The rows as a Markdown table."""
    lines = ["| what | ours | against | ratio | must | kept |", "|---|---|---|---|---|---|"]
    for row in rows:
        ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
        kept = "yes" if row.ok else "**no**"
        lines.append(f"| {row.what} | {row.ours} | {row.against} | {ratio} | {row.must} | {kept} |")
    return "\n".join(lines)
