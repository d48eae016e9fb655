"""``eval``: success rates of policies on a task, in simulation."""

from __future__ import annotations

import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from strands_robots import settings
from strands_robots.cli.command import command
from strands_robots.cli.output import CliError, Screen, table
from strands_robots.cli.policy import PoliciesFile
from strands_robots.utils import ValidationError, missing_extra, number, whole

if TYPE_CHECKING:  # numpy and MuJoCo are loaded with the first episode
    from strands_robots.evaluation.episode import Episode

EPISODES_MAX = 10_000


def register(app: typer.Typer) -> None:
    """Add ``eval`` to the application."""
    command(app, "eval")(evaluate)


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
    from strands_robots.evaluation.episode import HEADINGS, rows_of, run_episode, write_plot  # noqa: PLC0415 - MuJoCo

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
