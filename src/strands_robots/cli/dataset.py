"""``dataset``: episodes for training, from recordings, and their check."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots import settings
from strands_robots.cli.far_hand import HandLeader
from strands_robots.cli.leading import arm_options, is_own, made_follower
from strands_robots.cli.led_robot import Serving, halted_first
from strands_robots.cli.network import Network, answering, reached
from strands_robots.cli.output import CliError, Screen
from strands_robots.cli.policy import PoliciesFile
from strands_robots.cli.record import NO_CAMERAS
from strands_robots.cli.teleop import MESH_PREFIX, Calibration, FollowerId, NoNetwork, PeerId
from strands_robots.policies import resolve_provider
from strands_robots.utils import ValidationError, identifier, number, text, whole

if TYPE_CHECKING:
    from strands_robots.cli.dataset_recording import Attempts
    from strands_robots.cli.far_recording import FarRobot
    from strands_robots.datasets.fit import RobotJoints

PAGE = "page"
"""Leader of a served robot that others move: the page, or an agent."""


def record(
    screen: Screen,
    network: Network,
    *,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The dataset: a new folder, or one of the same robot.")],
    robot: Annotated[
        str,
        typer.Option(
            "--robot", help="TYPE@PORT of a real arm, a simulated robot's name, or the id of one that is served."
        ),
    ],
    task: Annotated[str, typer.Option("--task", help="What is to be done, in words.")],
    leader: Annotated[
        str | None,
        typer.Option(
            "--leader",
            help="TYPE@PORT of a leader arm, keyboard, gamepad, a recording, or page: whoever moves a served robot. "
            "With --policy it takes over from it.",
        ),
    ] = None,
    policy: Annotated[
        str | None,
        typer.Option(
            "--policy",
            help="A policy or a profile of one, which this command runs, or else the served robot.",
            metavar="NAME",
        ),
    ] = None,
    policies: PoliciesFile = None,
    episodes: Annotated[int, typer.Option("--episodes", help="How many to save.")] = 50,
    fps: Annotated[int, typer.Option("--fps", help="Frames a second.")] = 30,
    episode_s: Annotated[
        float | None,
        typer.Option(
            "--episode-s",
            help="Longest time of one; without it, and a terminal, the page's buttons end it.",
            metavar="S",
        ),
    ] = None,
    pause_s: Annotated[
        float, typer.Option("--pause-s", help="Between two, to put things back, without a terminal.", metavar="S")
    ] = 5.0,
    success: Annotated[bool, typer.Option("--success", help="An attempt that ends by its time has succeeded.")] = False,
    cameras: Annotated[
        str | None, typer.Option("--cameras", help="Names with commas, or none; by default all.", metavar="LIST")
    ] = None,
    follower_id: FollowerId = None,
    calibration: Calibration = None,
    leader_id: Annotated[str | None, typer.Option("--leader-id", help="Calibration id of the leader.")] = None,
    leader_calibration: Annotated[
        Path | None, typer.Option("--leader-calibration", help="Calibration file of the leader.")
    ] = None,
    peer_id: PeerId = None,
    no_network: NoNetwork = False,
) -> None:
    """Record episodes of a robot that is led. What is saved outlives a kill."""
    from strands_robots.cli.dataset_recording import Attempts, Keys, record_attempts  # noqa: PLC0415 - an extra
    from strands_robots.cli.local_recording import LocalAttempts, leader_drives, policy_drives, turns_drive  # noqa: PLC0415 - as above
    from strands_robots.cli.recorder_device import recorder_served  # noqa: PLC0415 - as above
    from strands_robots.cli.recording_state import RecordingState  # noqa: PLC0415 - as above
    from strands_robots.datasets.session import RecordingSession  # noqa: PLC0415 - as above
    from strands_robots.recording.cameras import chosen_frames  # noqa: PLC0415 - as above

    whole("--episodes", episodes, low=1, high=10_000)
    number("--pause-s", pause_s, low=0, high=3600)
    longest = None if episode_s is None else number("--episode-s", episode_s, above=0, high=3600)
    _check_drivers(robot, leader, policy)
    keys = Keys() if screen.live and sys.stdin.isatty() else None
    if keys is None and longest is None and no_network:
        raise ValidationError("--episode-s is needed without a terminal and a network: nobody ends an attempt.")
    asked, state = keys is not None or longest is None, RecordingState(keys)
    buttons = partial(recorder_served, screen, network, needed=asked and keys is None)
    names = None if cameras is None else [name for name in cameras.split(",") if name]
    of_leader = arm_options("", leader_id, leader_calibration)
    if policies is not None and not (policy and is_own(robot)):
        raise ValidationError("--policies goes with --policy and a robot of this command; a served one has its own.")
    if leader in (None, PAGE) and of_leader:
        raise ValidationError("--leader-id and --leader-calibration go with a leader arm.")
    hand = HandLeader(screen, leader or "", of_leader, keys)
    if leader == PAGE or not (no_network or is_own(robot)):
        if no_network or any(each is not None for each in (follower_id, calibration, peer_id)):
            raise ValidationError(
                f"--robot must be the id of a served robot, without options of one of this command, not {robot}."
            )
        led_from_here = None if leader in (None, PAGE) else hand
        with served_robot(screen, network, robot, policy or "", task, names, led_from_here) as far:
            begin = partial(far.begin, longest, state.check)
            attempts = Attempts(episodes, begin, fps, longest, pause_s, success, asked, state)
            _record_served(screen, folder, far, task, attempts, buttons)
        return
    how = Serving.of(network, peer_id, None, alone=no_network)
    if policies is not None:
        settings.put("STRANDS_POLICIES", str(policies))
    if policy is not None:
        resolve_provider(policy)
    kind, arm = robot.partition("@")[0], arm_options("", follower_id, calibration)
    if policy and leader:
        drives = partial(turns_drive, screen, policy, task, longest, hand, state.check)
    elif policy:
        drives = partial(policy_drives, screen, policy, task, longest, state.check)
    else:
        drives = partial(leader_drives, screen, hand, robot)
    with (
        RecordingSession(folder, fps, task, kind, lambda said: screen.say(said, "yellow")) as session,
        made_follower(screen, robot, arm, None, how) as led,
        nullcontext() if no_network else buttons(led.peer_id, state, task, on_mesh=network.mesh),
        drives(led) as driver,
        halted_first(led.robot),
    ):
        frames = None if names == [NO_CAMERAS] else chosen_frames(led.robot, names)
        attempts = Attempts(episodes, driver.begin, fps, longest, pause_s, success, asked, state)
        record_attempts(screen, LocalAttempts(led, frames, driver, names), session, attempts)
        count = session.episodes
    _tell_dataset(screen, folder, count)


def _check_drivers(robot: str, leader: str | None, policy: str | None) -> None:
    """Refuse what cannot drive a robot that is recorded.

    Raises:
        ValidationError: naming the flag.
    """
    if leader is None and policy is None:
        raise ValidationError("give --leader, --policy, or both: the leader then takes over from the policy.")
    if leader == PAGE and policy is not None:
        raise ValidationError(f"--policy goes with a leader of this machine, not with {PAGE}.")
    if (leader or "").startswith(MESH_PREFIX) or robot.startswith(MESH_PREFIX):
        raise ValidationError("--leader must be of this machine, and --robot one of this command or a served one's id.")


def _record_served(  # noqa: PLR0917 - one robot, and what is done with it
    screen: Screen,
    folder: Path,
    far: FarRobot,
    task: str,
    attempts: Attempts,
    buttons: Callable[..., AbstractContextManager[None]],
) -> None:
    """Record attempts of a robot that another process serves."""
    from strands_robots.cli.dataset_recording import record_attempts  # noqa: PLC0415 - an extra
    from strands_robots.datasets.session import RecordingSession  # noqa: PLC0415 - as above

    with (
        RecordingSession(folder, attempts.fps, task, far.kind, lambda said: screen.say(said, "yellow")) as session,
        answering(far.networks, far.name, ""),
        buttons(far.remote.id, attempts.state, task, on_mesh=far.on_mesh),
        # A robot that another caller holds is not halted.
        far.held(),
        halted_first(far),
    ):
        record_attempts(screen, far, session, attempts)
        count = session.episodes
    _tell_dataset(screen, folder, count)


def _tell_dataset(screen: Screen, folder: Path, count: int) -> None:
    screen.data({"event": "dataset", "folder": str(folder), "episodes": count})
    screen.say(f"{folder}: episodes: {count}.", "bold")


@contextmanager
def served_robot(  # noqa: PLR0917 - one robot, and what is asked of it
    screen: Screen,
    network: Network,
    robot: str,
    policy: str,
    task: str,
    cameras: list[str] | None,
    hand: HandLeader | None,
) -> Iterator[FarRobot]:
    """Join the networks, and yield the served robot ``ID`` or ``WORLD/ROBOT``.

    Raises:
        CliError: there is no such robot, or it does not answer.
        ValidationError: no id, or a camera that it does not have.
    """
    from strands_robots.cli.far_recording import FarRobot  # noqa: PLC0415 - loaded when a network is used

    peer, part = _served_name(robot)
    with reached(screen, network, peer) as (there, world):
        with answering(there, peer, ""):
            far = FarRobot(world, there, part, policy, task, cameras, hand)
        with nullcontext() if hand is None else hand.connected():
            yield far


def _served_name(robot: str) -> tuple[str, str]:
    """Split ``ID`` or ``WORLD/ROBOT``."""
    peer, _, part = robot.partition("/")
    return identifier("--robot", peer), part


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
    screen.say(f"{out}: episodes: {info.episodes}, frames: {info.frames} at {info.fps} a second.", "bold")


def check(
    screen: Screen,
    network: Network,
    *,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The dataset.")],
    robot: Annotated[
        str | None,
        typer.Option("--robot", help="Also against a robot: a simulated one's name, or the id of one that is served."),
    ] = None,
    oldest_ms: Annotated[
        float, typer.Option("--stale-ms", help="Age of a reading from which it is told.", metavar="MS")
    ] = 500.0,
) -> None:
    """Check a dataset, also against a robot. Exits with 1 where it is wrong."""
    from strands_robots.datasets.check import check_dataset  # noqa: PLC0415 - an extra
    from strands_robots.datasets.fit import robot_findings  # noqa: PLC0415 - as above

    if not folder.is_dir():
        raise ValidationError(f"DIR must be a folder with a dataset: {folder} is none.")
    oldest = number("--stale-ms", oldest_ms, above=0, high=60_000)
    joints = None if robot is None else _joints_of(network, robot)
    info, found = check_dataset(folder, oldest_ms=oldest)
    if joints is not None and info.episodes:
        found += robot_findings(folder, info, joints)
    for each in found:
        screen.data({"event": "finding", **asdict(each)})
        screen.say(
            f"{'wrong' if each.wrong else 'look':>5}  {each.where}: {each.said}", "red" if each.wrong else "yellow"
        )
    wrong = sum(each.wrong for each in found)
    facts = {"episodes": info.episodes, "frames": info.frames, "fps": info.fps}
    screen.data({"event": "checked", **facts, "wrong": wrong, "look": len(found) - wrong})
    cameras = f"cameras: {', '.join(sorted(info.videos)) or 'none'}"
    screen.say(f"Episodes: {info.episodes}, frames: {info.frames} at {info.fps} a second, {cameras}.")
    if wrong:
        raise CliError(f"{folder}: {wrong} things are wrong.")


def _joints_of(network: Network, robot: str) -> RobotJoints:
    """Return what a simulated robot, else one that is served, states of its joints.

    Raises:
        CliError: it is no model, and no robot of that id is in reach.
        ValidationError: it states none.
    """
    from strands_robots.datasets.fit import RobotJoints  # noqa: PLC0415 - an extra
    from strands_robots.fleet import Fleet  # noqa: PLC0415 - loaded when a network is used
    from strands_robots.robot import NO_SUCH_MODEL, Robot  # noqa: PLC0415 - heavy

    if "@" in robot:
        raise ValidationError("--robot must be a model's name or the id of a served robot, not TYPE@PORT.")
    try:
        made: Any = Robot(robot, mode="sim", mesh=False)
    except ValidationError as exc:
        if exc.code != NO_SUCH_MODEL:
            raise
    else:
        try:
            return RobotJoints.of(robot, made.get_features())
        finally:
            made.cleanup()
    peer, part = _served_name(robot)
    with network.joined() as there, answering(there, peer, ""):
        return RobotJoints.of(robot, Fleet(there)[peer].features(), part)


def show(
    screen: Screen,
    *,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The dataset.")],
    out: Annotated[Path | None, typer.Option("--out", help="The page; DIR.html by default.", metavar="FILE")] = None,
    episode: Annotated[
        list[int] | None, typer.Option("--episode", help="One to draw (repeat); by default the first 50.")
    ] = None,
) -> None:
    """Write a page of a dataset: episodes, plots, pictures, stops. One HTML file."""
    from strands_robots.datasets.page import dataset_page  # noqa: PLC0415 - an extra

    if not folder.is_dir():
        raise ValidationError(f"DIR must be a folder with a dataset: {folder} is none.")
    name = folder.resolve().name
    if out is None and not name:
        raise ValidationError(f"--out must be given: {folder} has no name.")
    file = folder.resolve().with_name(f"{name}.html") if out is None else out
    page = dataset_page(folder, episode).encode("utf-8", "replace")
    try:
        file.write_bytes(page)
    except OSError as problem:
        raise CliError(f"{file} cannot be written: {problem.strerror}.") from problem
    screen.data({"event": "shown", "file": str(file), "bytes": len(page)})
    screen.say(f"{file} is written; open it in a browser.", "green")
