"""``record DEVICE...``: their events into a file. ``replay FILE --to FOLLOWER``: its actions once more."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from strands_robots.cli.command import command
from strands_robots.cli.fleet import reached
from strands_robots.cli.network import Network
from strands_robots.cli.output import Failure, Screen
from strands_robots.cli.recorded import lossless, told
from strands_robots.cli.teleop import arm_options, drive, recording
from strands_robots.recording import Recorder
from strands_robots.utils import number

_LOOK_S = 0.2


def register(app: typer.Typer) -> None:
    """Add ``record`` and ``replay`` to the application."""
    command(app, "record", network=True)(record)
    command(app, "replay")(replay)


def record(
    screen: Screen,
    network: Network,
    *,
    devices: Annotated[list[str], typer.Argument(metavar="DEVICE...", help="Ids of the devices, or '*' for all.")],
    out: Annotated[Path, typer.Option("--out", help="A new .mcap file.")],
    seconds: Annotated[float | None, typer.Option("--for", help="End after that many seconds.")] = None,
) -> None:
    """Write every event of some devices into an MCAP file until Ctrl-C: joints, actions, tasks, stops."""
    longest = None if seconds is None else number("--for", seconds, above=0, high=24 * 3600)
    recorder = Recorder(out)
    with reached(network) as fleet, contextlib.ExitStack() as stack:
        stack.enter_context(recorder)
        for device in devices:
            heard = fleet.subscription(device, lambda event: recorder.take(event.device, event.name, event.payload))
            stack.enter_context(heard)
        screen.say(f"Recording {', '.join(devices)} into {out}. Ctrl-C ends it.")
        with contextlib.suppress(KeyboardInterrupt):
            _wait(screen, recorder, longest)
    told(screen, recorder)
    lossless(recorder)
    if not recorder.counts:
        raise Failure(f"Nothing was heard of {', '.join(devices)}; {out} is empty.")


def replay(
    screen: Screen,
    *,
    file: Annotated[Path, typer.Argument(help="A recording: .mcap, .csv or .parquet.")],
    to: Annotated[str, typer.Option("--to", help="TYPE@PORT of a real arm, a model, or mesh:PEER.")],
    device: Annotated[str | None, typer.Option("--device", help="Whose actions, where several are recorded.")] = None,
    follower_id: Annotated[str | None, typer.Option("--id", help="Whose calibration the follower has.")] = None,
    calibration: Annotated[Path | None, typer.Option("--calibration", help="A calibration file.")] = None,
    speed: Annotated[float, typer.Option("--speed", help="Times as fast, at most 10.")] = 1.0,
) -> None:
    """Play the recorded actions of a device to a follower, here or on the mesh, and stop it at the end."""
    leader = recording(file, device, speed)

    def led(robot: Any) -> contextlib.AbstractContextManager[Any]:
        return contextlib.nullcontext(leader)

    drive(screen, file.name, to, led, options=arm_options("", follower_id, calibration))


def _wait(screen: Screen, recorder: Recorder, seconds: float | None) -> None:
    began = time.monotonic()
    live = not screen.machine and screen.out.is_terminal
    status = screen.out.status("Waiting for events...") if live else contextlib.nullcontext()
    with status as shown:
        while seconds is None or time.monotonic() - began < seconds:
            time.sleep(_LOOK_S)
            if shown is not None:
                shown.update(f"{sum(recorder.counts.values())} events in {time.monotonic() - began:.0f} s")
