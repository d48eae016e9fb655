"""``policy``: compare a profile with a robot, and measure its loop."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots import settings
from strands_robots.cli.app import assignments
from strands_robots.cli.output import CliError, Screen, label, table
from strands_robots.policies.base import PolicyError
from strands_robots.policies.check import CheckRow, PolicyCheck, check_policy, statements_of
from strands_robots.policies.profiles import Profile, load_profiles
from strands_robots.utils import ValidationError, duration, missing_extra, number, shown, whole

if TYPE_CHECKING:
    from strands_robots.evaluation import Episode

_STYLES = {"ok": "green", "confirmed": "green", "unverified": "yellow", "refused": "bold red"}

PoliciesFile = Annotated[
    Path | None, typer.Option("--policies", help="The file of policy profiles; STRANDS_POLICIES by default.")
]


def check(
    screen: Screen,
    *,
    name: Annotated[str, typer.Argument(help="The profile.")],
    robot: Annotated[str | None, typer.Option("--robot", help="Such as so101, or an MJCF or URDF file.")] = None,
    dataset: Annotated[
        Path | None, typer.Option("--dataset", help="Also, or alone, against a dataset.", metavar="DIR")
    ] = None,
    policies: PoliciesFile = None,
    mode: Annotated[str, typer.Option("--mode", help="sim or real.")] = "sim",
    options: Annotated[
        list[str] | None,
        typer.Option("--set", help="An option of the robot, such as port=/dev/ttyACM0.", metavar="KEY=VALUE"),
    ] = None,
) -> None:
    """Compare a policy with a still robot, or a dataset. Exits with 1 on a mismatch."""
    if robot is None and dataset is None:
        raise ValidationError("give --robot, --dataset, or both: what the policy is compared with.")
    profile, rows, others = _profile(name, policies), list[CheckRow](), list[str]()
    if robot is not None:
        from strands_robots.robot import Robot  # noqa: PLC0415 - heavy, and needed by this command alone

        body = Robot(robot, mode=mode, **assignments(options or []))
        try:
            facts = body.policy_facts()
        finally:
            body.cleanup()
        rows += check_policy(profile, statements_of(profile), facts).rows
        others.append(f"may not move {facts.name}")
    if dataset is not None:
        from strands_robots.datasets.fit import profile_rows  # noqa: PLC0415 - an extra
        from strands_robots.datasets.layout import read_info  # noqa: PLC0415 - as above

        rows += profile_rows(profile, read_info(dataset))
        others.append(f"does not fit {dataset}")
    found = PolicyCheck(name, tuple(rows))
    show(screen, found)
    if not found.passed:
        what = " or ".join(others)
        raise CliError(f"{name} {what}: {len(found.failures)} of {len(found.rows)} rows fail.")
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


EPISODES_MAX = 10_000


def evaluate(
    screen: Screen,
    *,
    policy: Annotated[
        list[str], typer.Option("--policy", help="A profile, mock, or expert:TASK; several are compared.")
    ],
    task: Annotated[str, typer.Option("--task", help="reach, push_cube or pick_place.")],
    episodes: Annotated[int, typer.Option("--episodes", help="Episodes of each policy.")] = 20,
    robot: Annotated[str, typer.Option("--robot", help="so100 or so101.")] = "so100",
    seed: Annotated[int, typer.Option("--seed", help="Seed of the first episode.")] = 0,
    hz: Annotated[float, typer.Option("--hz", help="Control rate.")] = 50.0,
    latency: Annotated[float, typer.Option("--latency", help="Simulated seconds that each answer takes.")] = 0.0,
    output: Annotated[
        Path | None, typer.Option("--output", help="A new folder for recordings and plot; evaluation-TIME by default.")
    ] = None,
    policies: PoliciesFile = None,
) -> None:
    """Let policies try a task in simulation, recorded, and print success rates."""
    count = whole("--episodes", episodes, low=1, high=EPISODES_MAX)
    first = whole("--seed", seed, low=0, high=2**31)
    rate = number("--hz", hz, low=5, high=250)
    delay = number("--latency", latency, low=0, high=10)
    try:
        import mujoco  # noqa: F401, PLC0415 - a simulation is needed by this command alone
    except ModuleNotFoundError as exc:
        raise missing_extra("An evaluation", "sim") from exc
    from strands_robots.evaluation import HEADINGS, rows_of, run_episode, write_plot  # noqa: PLC0415 - MuJoCo

    if policies is not None:
        settings.put("STRANDS_POLICIES", str(policies))
    folder = output or Path(f"evaluation-{time.strftime('%Y%m%d-%H%M%S')}")
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise ValidationError(f"--output must be a new folder; {folder} is there already.") from None
    found: dict[str, list[Episode]] = {}
    for name in policy:
        kept = folder / name.replace(":", "-")
        kept.mkdir()
        found[name] = []
        for index in range(count):
            episode = run_episode(
                name,
                task,
                first + index,
                robot=robot,
                hz=rate,
                latency_s=delay,
                recording=kept / f"{index:04}.mcap",
            )
            found[name].append(episode)
            screen.data({"policy": name, **asdict(episode)})
    plot = folder / "success.svg"
    write_plot(plot, f"{task} on {robot}, {count} episodes", found)
    screen.show(table("", HEADINGS, rows_of(found)))
    screen.say(f"Recordings and plot: {folder}/")
    failed = {name: error for name, each in found.items() if (error := next((e.error for e in each if e.error), ""))}
    if failed:
        raise CliError("; ".join(f"{name} failed: {error}" for name, error in failed.items()))
