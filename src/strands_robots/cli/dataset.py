"""``dataset``: episodes for training, from recordings, and their check."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from strands_robots.cli.output import CliError, Screen
from strands_robots.utils import ValidationError, number, text, whole


def from_mcap(
    screen: Screen,
    *,
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Recordings of one robot (.mcap).")],
    out: Annotated[Path, typer.Option("--out", help="The dataset: a new folder, or one of the same robot.")],
    fps: Annotated[int, typer.Option("--fps", help="Frames a second.")] = 30,
    task: Annotated[str, typer.Option("--task", help="In words, of all episodes; by default what each was told.")] = "",
    robot: Annotated[
        str | None, typer.Option("--robot", help="Whose, where several were recorded; WORLD/ROBOT of a world.")
    ] = None,
    robot_type: Annotated[str, typer.Option("--robot-type", help="Its kind, such as so101.")] = "unknown",
    success: Annotated[
        bool, typer.Option("--success", help="The attempts succeeded: next.success is true at each end.")
    ] = False,
) -> None:
    """Write the tasks of recordings as episodes of a LeRobot dataset (v3.0)."""
    from strands_robots.datasets.episodes import Dataset  # noqa: PLC0415 - an extra
    from strands_robots.datasets.recorded import attempts_of, info_of, save_attempt  # noqa: PLC0415 - as above

    whole("--fps", fps, low=1, high=1000)
    text("--task", task, longest=1000, empty=True)
    text("--robot-type", robot_type, longest=100)
    attempts = [(path, attempt) for path in files for attempt in attempts_of(path, robot)]
    with Dataset(out, info_of([attempt for _, attempt in attempts], fps, robot_type)) as dataset:
        for said in dataset.mended:
            screen.say(said, "yellow")
        for path, attempt in attempts:
            index = save_attempt(dataset, attempt, task, success=success)
            steps = len(attempt.steps)
            screen.data({"event": "saved", "episode": index, "file": str(path), "steps": steps})
            screen.say(f"episode {index}: {steps} steps of {path.name}")
        info = dataset.info
    screen.data({"event": "dataset", "folder": str(out), "episodes": info.episodes, "frames": info.frames})
    screen.say(f"{out} has {info.episodes} episodes, {info.frames} frames at {info.fps} a second.", "bold")


def check(
    screen: Screen,
    *,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The dataset.")],
    oldest_ms: Annotated[
        float, typer.Option("--stale-ms", help="Age of a reading from which it is told.", metavar="MS")
    ] = 500.0,
) -> None:
    """Check a dataset against itself. Exits with 1 when something is wrong."""
    from strands_robots.datasets.check import check_dataset  # noqa: PLC0415 - an extra

    if not folder.is_dir():
        raise ValidationError(f"DIR must be a folder with a dataset: {folder} is none.")
    info, found = check_dataset(folder, oldest_ms=number("--stale-ms", oldest_ms, above=0, high=60_000))
    for each in found:
        screen.data({"event": "finding", **asdict(each)})
        screen.say(
            f"{'wrong' if each.wrong else 'look':>5}  {each.where}: {each.said}", "red" if each.wrong else "yellow"
        )
    wrong = sum(each.wrong for each in found)
    facts = {"episodes": info.episodes, "frames": info.frames, "fps": info.fps}
    screen.data({"event": "checked", **facts, "wrong": wrong, "look": len(found) - wrong})
    screen.say(f"{info.episodes} episodes, {info.frames} frames at {info.fps} a second; {len(info.videos)} cameras.")
    if wrong:
        raise CliError(f"{folder}: {wrong} things are wrong.")
