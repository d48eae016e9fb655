"""``record DEVICE...``, and ``--record`` of the commands that move a robot."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots.cli.app import Seconds
from strands_robots.cli.network import Network, say_missing
from strands_robots.cli.output import CliError, Exit, Screen, progress_bar, table
from strands_robots.errors import RefusalError
from strands_robots.fleet.adapter import EVERY, Detail
from strands_robots.recording.cameras import chosen_frames
from strands_robots.recording.file import Recorder, RobotRecording
from strands_robots.utils import identifier, number

if TYPE_CHECKING:
    from strands_robots.fleet.adapter import NetworkAdapter, RobotEvent
    from strands_robots.fleet.networks import Networks

logger = logging.getLogger(__name__)

NO_CAMERAS = "none"
_POLL_S = 0.2


def record(
    screen: Screen,
    network: Network,
    *,
    devices: Annotated[list[str], typer.Argument(metavar="DEVICE...", help="Ids of the devices, or '*' for all.")],
    out: Annotated[Path, typer.Option("--out", help="A new .mcap file.")],
    seconds: Seconds = None,
) -> None:
    """Write every event of some devices into an MCAP file until Ctrl-C: joints, actions, tasks, stops."""
    longest = None if seconds is None else number("--for", seconds, above=0, high=24 * 3600)
    wanted = [each if each == EVERY else identifier("DEVICE", each) for each in devices]
    recorder = Recorder(out)
    with ExitStack() as stack:
        there = stack.enter_context(network.joined(stays=True))
        stack.enter_context(recorder)
        there.on_joined(lambda joined: _record_network(there, joined, wanted, recorder))
        there.settled()
        say_missing(screen, there)
        screen.say(f"Recording {', '.join(devices)} into {out}. Ctrl-C ends it.")
        with contextlib.suppress(KeyboardInterrupt):
            _wait(screen, recorder, longest)
    if not recorder.counts:
        out.unlink()
        who = "any device" if EVERY in devices else ", ".join(devices)
        raise CliError(f"No message of {who} arrived; nothing was recorded.", Exit.SILENT)
    _summarize(screen, recorder)
    _check_lossless(recorder)


@contextmanager
def record_robot(
    screen: Screen, robot: Any, device: str, file: Path | None, cameras: str | None = None
) -> Iterator[None]:
    """Record ``robot`` while the block runs, halts included, if there is a ``file``.

    Args:
        screen: where the summary is printed.
        robot: the robot that moves in this process.
        device: its name in the recording.
        file: a new ``.mcap`` file.
        cameras: names with commas between them, ``none``, or None for those of the robot itself.

    Raises:
        CliError: messages were lost.
        ValidationError: the file, or a camera, is refused.
    """
    if file is None:
        yield
        return
    names = None if cameras is None else [name for name in cameras.split(",") if name]
    frames = None if names == [NO_CAMERAS] else chosen_frames(robot, names)
    recorder = Recorder(file, joints_of_events=False)
    sampling = RobotRecording(robot, recorder, device, frames=frames)
    with ExitStack() as stack:
        # The summary comes after both have ended, also when Ctrl-C leaves the block.
        stack.callback(lambda: _summarize(screen, recorder))
        stack.enter_context(recorder)
        stack.enter_context(sampling)
        screen.say(f"Recording {device} into {file}.")
        yield
    _check_lossless(recorder)


def _record_network(there: Networks, network: NetworkAdapter, devices: Sequence[str], recorder: Recorder) -> None:
    """Record what devices publish, each on the first network that has it."""

    def take(event: RobotEvent) -> None:
        first, *_ = [*there.bearers(event.robot), network]
        if first is not network:
            return
        if event.picture is not None:
            recorder.take_picture(event.robot, event.part, event.picture)
        else:
            recorder.take(event.robot, event.name, event.payload)

    for device in devices:
        try:
            network.subscribe(device, take, Detail.ALL)
        except RefusalError as exc:
            logger.warning("%s is not recorded on %s: %s", device, network.name, exc)


def _wait(screen: Screen, recorder: Recorder, seconds: float | None) -> None:
    """Wait for the end or Ctrl-C, with a bar or, for an unknown end, a count."""
    began = time.monotonic()
    counting = screen.live and seconds is None
    with (
        progress_bar(screen, seconds, "recording") as moved,
        screen.out.status("Waiting for messages...") if counting else contextlib.nullcontext() as status,
    ):
        while seconds is None or time.monotonic() - began < seconds:
            time.sleep(_POLL_S)
            moved(time.monotonic() - began)
            if status is not None:
                status.update(f"{sum(recorder.counts.values())} messages in {time.monotonic() - began:.0f} s")


def _summarize(screen: Screen, recorder: Recorder) -> None:
    if not recorder.path.exists():
        return
    counts, size = dict(recorder.counts), recorder.path.stat().st_size
    screen.data({"event": "recorded", "file": str(recorder.path), "messages": counts, "lost": recorder.lost})
    shown_size = f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"
    screen.show(table(f"{recorder.path}, {shown_size}", ("channel", "messages"), sorted(counts.items())))


def _check_lossless(recorder: Recorder) -> None:
    if recorder.lost:
        raise CliError(f"{recorder.lost} messages were lost: the disk was too slow.")
