"""``fleets``: list the connection profiles of this user."""

from __future__ import annotations

from typing import Any

import typer

from strands_robots import settings
from strands_robots.cli.command import command
from strands_robots.cli.network import SOURCE
from strands_robots.cli.output import Screen, label, table
from strands_robots.fleet.link_flags import as_flag, described
from strands_robots.fleet.profiles import profile_names, profiles_folder, read_profile
from strands_robots.utils import MissingExtraError, ValidationError


def register(app: typer.Typer) -> None:
    """Add ``fleets`` to the application."""
    command(app, "fleets")(fleets)


def fleets(screen: Screen) -> None:
    """List the connection profiles that --fleet takes, and their networks."""
    default = settings.raw("STRANDS_FLEET")
    found = [_facts(name) for name in profile_names()]
    screen.data(
        {"status": "success", "folder": str(profiles_folder()), "default": default or None, "fleets": found},
    )
    if not found:
        screen.say(f"No connection profile is in {profiles_folder()}; docs/python.md says what one has.")
        return
    rows = (
        (
            f"{each['name']} (default)" if each["name"] == default else each["name"],
            label(each["problem"], "bold red") if each["problem"] else each["network"],
            each["tenant"] or "",
            each["caller"] or "",
            "" if each["mesh"] is None else "yes" if each["mesh"] else "no",
        )
        for each in found
    )
    screen.show(table(str(profiles_folder()), ("fleet", "network", "tenant", "caller", "mesh"), rows))


def _facts(name: str) -> dict[str, Any]:
    """Return a profile in words; ``problem`` says why it cannot be used."""
    facts: dict[str, Any] = {"name": name, "network": None, "tenant": None, "caller": None, "mesh": None}
    try:
        profile = read_profile(name)
        link = profile.flags({}).link(as_flag)
        facts |= {"network": described(link), "tenant": link.tenant, "file": str(profile.file)}
        facts |= {"caller": profile.name or SOURCE, "mesh": profile.mesh is not None}
    except (ValidationError, MissingExtraError) as exc:
        return {**facts, "problem": str(exc)}
    return {**facts, "problem": ""}
