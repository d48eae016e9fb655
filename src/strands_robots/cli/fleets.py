"""``fleets``: list the connection profiles of this user."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import typer

from strands_robots import settings
from strands_robots.cli.command import command
from strands_robots.cli.output import Screen, label, table
from strands_robots.fleet.callers import SOURCE
from strands_robots.fleet.link_flags import as_flag, described
from strands_robots.fleet.profiles import profile_names, profiles_folder, read_profile
from strands_robots.utils import MissingExtraError, ValidationError


def register(app: typer.Typer) -> None:
    """Add ``fleets`` to the application."""
    command(app, "fleets")(fleets)


def fleets(screen: Screen) -> None:
    """List the connection profiles that --fleet takes, and their networks."""
    default, names = settings.raw("STRANDS_FLEET"), profile_names()
    found = [_facts(name) for name in names]
    unfit = _problem(default) if default and default not in names else ""
    screen.data(
        {
            "status": "success",
            "folder": str(profiles_folder()),
            "default": default or None,
            "default_problem": unfit,
            "fleets": found,
        },
    )
    if unfit:
        screen.say(f"STRANDS_FLEET names none that can be used. {unfit}")
    if not found:
        screen.say(f"No connection profile is in {profiles_folder()}; docs/python.md says what one has.")
        return
    rows = (
        (
            f"{each['name']} (default)" if each["name"] == default else each["name"],
            label(each["problem"], "bold red") if each["problem"] else each["network"] or "none",
            each["tenant"] or "",
            each["caller"] or "",
            "" if each["mesh"] is None else each["mesh_network"] or "none",
        )
        for each in found
    )
    screen.show(table(str(profiles_folder()), ("fleet", "Device Connect", "tenant", "caller", "mesh"), rows))


def _facts(name: str) -> dict[str, Any]:
    """Return a profile in words; ``problem`` says why it cannot be used."""
    absent = ("network", "tenant", "caller", "mesh", "mesh_network")
    facts: dict[str, Any] = {"name": name, **dict.fromkeys(absent)}
    try:
        profile = read_profile(name)
        facts["file"] = str(profile.file)
        if profile.reaches_devices({}):
            link = profile.flags({}).link(as_flag)
            facts |= {"network": described(link), "tenant": link.tenant}
        stated = profile.mesh
        facts |= {"caller": profile.name or SOURCE, "mesh": stated is not None}
        facts["mesh_network"] = None if stated is None else _mesh_in_words(stated)
    except (ValidationError, MissingExtraError) as exc:
        return {**facts, "problem": str(exc)}
    return {**facts, "problem": ""}


def _problem(wanted: str) -> str:
    try:
        read_profile(wanted).check()
    except ValidationError as exc:
        return str(exc)
    return ""


def _mesh_in_words(stated: Mapping[str, str]) -> str:
    """Describe in one sentence where the peers of a profile's mesh meet."""
    ends = {"connects to": stated["STRANDS_MESH_CONNECT"], "listens on": stated["STRANDS_MESH_LISTEN"]}
    ways = [f"{how} {', '.join(each.split(','))}" for how, each in ends.items() if each != settings.NO_ENDPOINT]
    hub = [] if ways else [f"meets at 127.0.0.1:{stated['STRANDS_MESH_PORT']}"]
    multicast = ["finds peers by multicast"] if stated["STRANDS_MESH_MULTICAST"] == "true" else []
    text = "; ".join((*hub, *ways, *multicast))
    return f"{text[0].upper()}{text[1:]}."
