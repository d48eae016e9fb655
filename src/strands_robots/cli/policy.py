"""``policy``: compare a profile with a robot, and measure its loop."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from strands_robots import settings
from strands_robots.cli.command import assignments, command
from strands_robots.cli.output import CliError, Screen, label, table
from strands_robots.policies.base import PolicyError
from strands_robots.policies.check import PolicyCheck, check_policy, statements_of
from strands_robots.policies.profiles import Profile, load_profiles
from strands_robots.utils import ValidationError, duration, number, shown

_STYLES = {"ok": "green", "confirmed": "green", "unverified": "yellow", "refused": "bold red"}

PoliciesFile = Annotated[
    Path | None, typer.Option("--policies", help="The file of policy profiles; STRANDS_POLICIES by default.")
]


def register(app: typer.Typer) -> None:
    """Add ``policy`` to the application."""
    group = typer.Typer(help="Look at trained policies before a robot moves by them.", no_args_is_help=True)
    command(group, "check")(check)
    command(group, "bench")(bench)
    app.add_typer(group, name="policy")


def check(
    screen: Screen,
    *,
    name: Annotated[str, typer.Argument(help="The profile.")],
    robot: Annotated[str, typer.Option("--robot", help="Such as so101, or an MJCF or URDF file.")],
    policies: PoliciesFile = None,
    mode: Annotated[str, typer.Option("--mode", help="sim or real.")] = "sim",
    options: Annotated[
        list[str] | None,
        typer.Option("--set", help="An option of the robot, such as port=/dev/ttyACM0.", metavar="KEY=VALUE"),
    ] = None,
) -> None:
    """Compare a policy with a robot that keeps still. Exits with 1 on a mismatch."""
    profile = _profile(name, policies)
    from strands_robots.robot import Robot  # noqa: PLC0415 - heavy, and needed by this command alone

    body = Robot(robot, mode=mode, **assignments(options or []))
    try:
        facts = body.policy_facts()
    finally:
        body.cleanup()
    found = check_policy(profile, statements_of(profile), facts)
    show(screen, found)
    if not found.passed:
        raise CliError(f"{name} may not move {facts.name}: {len(found.failures)} of {len(found.rows)} rows fail.")
    if found.unanswered:
        screen.say(
            f"{len(found.unanswered)} rows are unverified: no source states them. They keep nothing from moving."
        )


def bench(
    screen: Screen,
    *,
    name: Annotated[str, typer.Argument(help="The profile.")],
    policies: PoliciesFile = None,
    hz: Annotated[float, typer.Option("--hz", help="Control rate of the robot; the profile's rate by default.")] = 0.0,
    seconds: Annotated[float, typer.Option("--for", help="Seconds to run.")] = 10.0,
) -> None:
    """Run a policy's loop without a robot, and compare its figures with its budget."""
    profile = _profile(name, policies)
    span = duration("--for", seconds)
    rate = number("--hz", hz, above=0, high=2000) if hz else profile.rate or 50.0
    if policies is not None:
        settings.put("STRANDS_POLICIES", str(policies))
    from strands_robots.policies.bench import measure  # noqa: PLC0415 - needed by this command alone

    try:
        figures = measure(profile, rate, span)
    except PolicyError as failure:
        raise CliError(f"{name} failed: {failure}.") from failure
    screen.data({"kept": figures.kept, **asdict(figures)})
    rows: list[tuple[Any, ...]] = [
        (row.what, row.measured, row.budget, label("yes" if row.kept else "no", "green" if row.kept else "bold red"))
        for row in figures.rows
    ]
    screen.show(table("", ("what", "measured", "budget", "kept"), rows))
    if not figures.kept:
        raise CliError(f"{name} does not keep its budget at {rate:g} Hz.")


def _profile(name: str, policies: Path | None) -> Profile:
    path = policies or (Path(settings.raw("STRANDS_POLICIES")) if settings.raw("STRANDS_POLICIES") else None)
    if path is None:
        raise ValidationError("--policies must name the file of profiles; STRANDS_POLICIES is not set.")
    profiles = load_profiles(path.expanduser())
    if name not in profiles:
        raise ValidationError(f"NAME must be one of {', '.join(profiles) or 'no profiles'}, not {shown(name)}.")
    return profiles[name]


def show(screen: Screen, found: PolicyCheck) -> None:
    """Print the rows of a check."""
    screen.data({"passed": found.passed, "rows": [asdict(row) for row in found.rows]})
    rows: list[tuple[Any, ...]] = [
        (row.question, row.policy, row.robot, label(row.outcome, _STYLES[row.outcome]), row.change)
        for row in found.rows
    ]
    screen.show(table("", ("question", "policy", "robot", "result", "to do"), rows))
