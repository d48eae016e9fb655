"""``record DEVICE...``: their events into a file. ``replay FILE --to FOLLOWER``: its actions once more."""

from __future__ import annotations

import base64
import contextlib
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots.cli.command import command
from strands_robots.cli.fleet import reached
from strands_robots.cli.mesh import joined, own_id
from strands_robots.cli.network import Network
from strands_robots.cli.output import Exit, Failure, Screen
from strands_robots.cli.recorded import lossless, told
from strands_robots.cli.teleop import arm_options, drive, following, recording
from strands_robots.recording import STEP, Recorder
from strands_robots.utils import identifier, number

if TYPE_CHECKING:
    from strands_robots.mesh import Mesh

ANYBODY = "*"
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
    on_mesh: Annotated[
        bool, typer.Option("--mesh", help="Peers of the native mesh instead: states, steps, pictures, stops.")
    ] = False,
) -> None:
    """Write every event of some devices into an MCAP file until Ctrl-C: joints, actions, tasks, stops."""
    longest = None if seconds is None else number("--for", seconds, above=0, high=24 * 3600)
    recorder = Recorder(out)
    with contextlib.ExitStack() as stack:
        if on_mesh:
            mesh = stack.enter_context(joined(None, own_id("record"), "tool"))
        else:
            fleet = stack.enter_context(reached(network))
        stack.enter_context(recorder)
        for device in devices:
            if on_mesh:
                _hear_peer(mesh, device, recorder)
                continue
            heard = fleet.subscription(device, lambda event: recorder.take(event.device, event.name, event.payload))
            stack.enter_context(heard)
        screen.say(f"Recording {', '.join(devices)} into {out}. Ctrl-C ends it.")
        with contextlib.suppress(KeyboardInterrupt):
            _wait(screen, recorder, longest)
    if not recorder.counts:
        out.unlink()
        who = "anybody" if ANYBODY in devices else ", ".join(devices)
        raise Failure(f"Nothing was heard of {who}; nothing was recorded.", Exit.SILENT)
    told(screen, recorder)
    lossless(recorder)


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


def _hear_peer(mesh: Mesh, peer: str, recorder: Recorder) -> None:
    """Record what a peer of the mesh publishes; ``*`` is everybody."""
    who = peer if peer == ANYBODY else identifier("DEVICE", peer)

    def heard(key: str, body: dict[str, Any]) -> None:
        _, name, topic, *rest = key.split("/")
        if topic == "camera":
            # What is no picture is kept as it is.
            with contextlib.suppress(TypeError, ValueError):
                recorder.take_picture(name, rest[0], base64.b64decode(body.get("data", ""), validate=True))
                return
        recorder.take(name, STEP if topic == "stream" else "_".join([topic, *rest]), body)

    for part in ("state", "stream", "camera/*", "safety/event"):
        mesh.subscribe(f"strands/{who}/{part}", heard, name=f"record {who} {part}")
    for part in ("estop", "resume"):
        mesh.subscribe(f"strands/safety/{part}", partial(_fleet, recorder, part), name=f"record {part}")


def _fleet(recorder: Recorder, part: str, key: str, body: dict[str, Any]) -> None:
    """What concerns every peer, under the name of who said it."""
    recorder.take(str(body.get("peer_id") or "mesh"), "emergencyStop" if part == "estop" else part, body)


def _wait(screen: Screen, recorder: Recorder, seconds: float | None) -> None:
    """Until Ctrl-C or the end, with a bar where it is known when that is."""
    began = time.monotonic()
    live = not screen.machine and screen.out.is_terminal
    status = screen.out.status("Waiting for messages...") if live and seconds is None else contextlib.nullcontext()
    with following(screen, seconds, "recording") as moved, status as shown:
        while seconds is None or time.monotonic() - began < seconds:
            time.sleep(_LOOK_S)
            moved(time.monotonic() - began)
            if shown is not None:
                shown.update(f"{sum(recorder.counts.values())} messages in {time.monotonic() - began:.0f} s")
