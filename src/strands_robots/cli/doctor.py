"""``doctor``: what is installed, which network would be used, what works here, and the remedy for what does not."""

from __future__ import annotations

import typer

from strands_robots.cli.checks import Finding, Mark, examine
from strands_robots.cli.command import command
from strands_robots.cli.network import Network
from strands_robots.cli.output import Failure, Screen, label, table

_STYLE = {Mark.OK: "green", Mark.NOTE: "cyan", Mark.WARN: "yellow", Mark.BROKEN: "bold red"}


def register(app: typer.Typer) -> None:
    """Add ``doctor`` to the application."""
    command(app, "doctor", network=True)(doctor)


def doctor(screen: Screen, network: Network) -> None:
    """Check what is installed and what works here; exit 1 when something required is broken."""
    findings = examine(network)
    broken = [found for found in findings if found.mark is Mark.BROKEN]
    report = {"status": "error" if broken else "success", "checks": [found.as_dict() for found in findings]}
    screen.show(table("", ("", "check", "found"), (_row(found) for found in findings)))
    remedies = [found for found in findings if found.remedy]
    if remedies:
        screen.say("Remedies", "bold")
    for found in remedies:
        screen.say(f"  {found.name}: {found.remedy}")
    if broken:
        names = ", ".join(found.name for found in broken)
        reason = f"Required and broken: {names}."
        raise Failure(reason, checks=report["checks"])
    screen.data(report)
    screen.say("Everything that is required works.", "green")


def _row(found: Finding) -> tuple[object, object, object]:
    return label(found.mark.value, _STYLE[found.mark]), found.name, found.said
