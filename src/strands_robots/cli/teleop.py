"""``teleop LEADER FOLLOWER``: one leads, the other follows, on this machine. ``calibrate``: an arm's ends, by hand."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots.cli.command import command
from strands_robots.cli.far import MESH, known_to, lead_far, leads
from strands_robots.cli.mesh import own_id
from strands_robots.cli.output import Failure, Screen, table
from strands_robots.cli.published import NOBODY, NoBody, follow_far, publish_far
from strands_robots.cli.recorded import recorded
from strands_robots.envelope import is_error, text_of
from strands_robots.safety.stopping import StopVerdict
from strands_robots.teleoperators.leader import FULL_RANGES_PER_S
from strands_robots.utils import ValidationError, identifier

if TYPE_CHECKING:
    from strands_robots.hardware import LeaderArm
    from strands_robots.hardware.calibrating import Reach

_LOOK_S = 0.05
_NAME = "leader"
_METHODS = {"keyboard": "keyboard", "gamepad": "gamepad"}


def register(app: typer.Typer) -> None:
    """Add ``teleop`` and ``calibrate`` to the application."""
    command(app, "teleop")(teleop)
    command(app, "calibrate")(calibrate)


def teleop(
    screen: Screen,
    *,
    leader: Annotated[
        str,
        typer.Argument(help="keyboard, gamepad, a recording (.csv, .parquet, .mcap), or TYPE@PORT of a leader arm."),
    ],
    follower: Annotated[
        str, typer.Argument(help="TYPE@PORT of a real arm, a model in simulation, mesh:PEER, or none to --publish.")
    ],
    leader_id: Annotated[str | None, typer.Option("--leader-id", help="Whose calibration the leader has.")] = None,
    follower_id: Annotated[str | None, typer.Option("--id", help="Whose calibration the follower has.")] = None,
    leader_calibration: Annotated[
        Path | None, typer.Option("--leader-calibration", help="A calibration file of the leader.")
    ] = None,
    calibration: Annotated[Path | None, typer.Option("--calibration", help="The same of the follower.")] = None,
    seconds: Annotated[float | None, typer.Option("--for", help="End after that many seconds.")] = None,
    hz: Annotated[float, typer.Option("--hz", help="Frames a second, 1 to 1000.")] = 50.0,
    max_speed: Annotated[
        float, typer.Option("--max-speed", help="Whole joint ranges a second that the follower may cross.")
    ] = FULL_RANGES_PER_S,
    publish: Annotated[
        str | None, typer.Option("--publish", help="Also let others follow, on the mesh as this PEER.", metavar="PEER")
    ] = None,
    record: Annotated[Path | None, typer.Option("--record", help="Also record the follower: a new .mcap.")] = None,
) -> None:
    """Let a leader drive a follower until it ends or Ctrl-C, which stops the follower first."""
    if leader.startswith(MESH):
        if follower.startswith(MESH) or publish is not None:
            raise ValidationError("a leader of the mesh leads a follower of this machine, and publishes itself.")
        peer = identifier("leader", leader.removeprefix(MESH))
        options = arm_options("", follower_id, calibration)
        _follow(screen, peer, follower, options=options, seconds=seconds, max_speed=max_speed, record=record)
        return
    drive(
        screen,
        leader,
        follower,
        lambda robot: _led(leader, robot, arm_options("", leader_id, leader_calibration)),
        options=arm_options("", follower_id, calibration),
        method=_METHODS.get(leader, "arm"),
        seconds=seconds,
        hz=hz,
        max_speed=max_speed,
        publish=publish,
        record=record,
    )


def drive(
    screen: Screen,
    leader: str,
    follower: str,
    led: Callable[[Any], AbstractContextManager[Any]],
    *,
    options: dict[str, Any],
    method: str = "arm",
    seconds: float | None = None,
    hz: float = 50.0,
    max_speed: float = FULL_RANGES_PER_S,
    publish: str | None = None,
    record: Path | None = None,
) -> None:
    """Make the follower, let the leader that ``led`` gives for it drive it to the end, and stop it whatever happens.

    Raises:
        Failure: it was refused, it failed, or the follower did not confirm its stop.
    """
    if follower.startswith(MESH):
        if publish is not None or record is not None:
            raise ValidationError("--publish and --record are for a follower of this machine, not of the mesh.")
        peer = identifier("follower", follower.removeprefix(MESH))
        waits = partial(_until, screen)
        lead_far(screen, leader, peer, led, waits, method=method, seconds=seconds, hz=hz, max_speed=max_speed)
        return
    if follower == NOBODY:
        if publish is None or record is not None:
            raise ValidationError(f"the follower {NOBODY} goes with --publish PEER, and has nothing to --record.")
        peer, waits = identifier("--publish", publish), partial(_until, screen)
        with led(NoBody()) as source:
            publish_far(screen, leader, peer, source, waits, method=method, seconds=seconds, hz=hz)
        return
    place = {} if publish is None else {"peer_id": identifier("--publish", publish), "mesh": True}
    robot = _made(follower, options, **place)
    try:
        with recorded(screen, robot, publish or robot.tool_name_str, record), led(robot) as source:
            known_to(follower, source, robot.body().bounds)
            for answer in (
                robot.attach_teleop(source, _NAME, method=method, max_speed=max_speed),
                robot.teleoperate(_NAME, duration=seconds, hz=hz, publish=publish is not None),
            ):
                if is_error(answer):
                    raise Failure(text_of(answer))
            leads(screen, leader, follower, source)
            if publish is not None:
                screen.say(f"Others may follow {publish}/{_NAME} on the mesh.")
            row, verdict = _followed(screen, robot, source)
    finally:
        robot.halt("teleop ended")
        robot.cleanup()
    screen.data({"event": "ended", **row, "stopped": verdict.stopped})
    if row["state"] == "error":
        raise Failure(f"The teleoperation failed: {row['error']}", **row)
    screen.say(f"{row['state'].capitalize()} after {row['step']} frames, {row['errors']} of them unusable.", "green")
    if not verdict.stopped:
        raise Failure(f"The follower did not confirm its stop: {text_of(verdict.envelope())}")


def _follow(
    screen: Screen,
    peer: str,
    follower: str,
    *,
    options: dict[str, Any],
    seconds: float | None,
    max_speed: float,
    record: Path | None,
) -> None:
    """Let a leader that a peer of the mesh publishes drive a follower of this machine."""
    robot = _made(follower, options, mesh=True, peer_id=own_id("follow"))
    try:
        with recorded(screen, robot, robot.tool_name_str, record):
            why, stats = follow_far(screen, peer, robot, partial(_until, screen), seconds=seconds, max_speed=max_speed)
            verdict = _stopped(screen, robot)
    finally:
        robot.halt("teleop ended")
        robot.cleanup()
    row = {key: stats[key] for key in ("frames_received", "errors", "rejected", "slew_rejected", "rate_dropped")}
    screen.data({"event": "ended", **row, "why": why, "stopped": verdict.stopped})
    if not verdict.stopped:
        raise Failure(f"The follower did not confirm its stop: {text_of(verdict.envelope())}")
    left_out = row["errors"] + row["rejected"] + row["slew_rejected"] + row["rate_dropped"]
    screen.say(f"{why} {row['frames_received']} frames came, {left_out} of them were not applied.", "green")


def _made(follower: str, options: dict[str, Any], **more: Any) -> Any:
    """The follower of this machine: ``TYPE@PORT``, or a model in simulation."""
    from strands_robots.robot import NO_SUCH_MODEL, Robot  # noqa: PLC0415 - heavy, and needed by these commands alone

    kind, at, port = follower.partition("@")
    try:
        return Robot(kind, mode="real" if at else "sim", **more, **({**options, "port": port} if at else {}))
    except ValidationError as exc:
        if exc.code != NO_SUCH_MODEL or "/" in kind or "." in kind:
            raise
        far = "A device of Device Connect takes no frames; serve its robot on the mesh too, and name it mesh:PEER."
        raise ValidationError(f"{exc} {far}") from exc


def _stopped(screen: Screen, robot: Any) -> StopVerdict:
    screen.say("Stopping the follower...")
    verdict: StopVerdict = robot.halt("teleop ended")
    if verdict.stopped:
        screen.say("The follower stands still.", "green")
    return verdict


def calibrate(
    screen: Screen,
    *,
    arm: Annotated[str, typer.Argument(help="Such as so101.")],
    port: Annotated[str, typer.Option("--port", help="Its serial port, such as /dev/ttyACM0.")],
    device: Annotated[str | None, typer.Option("--id", help="Under which the calibration is kept.")] = None,
    leader: Annotated[bool, typer.Option("--leader", help="It is a leader arm.")] = False,
) -> None:
    """Measure an arm's middle and the ends of its joints, moved by hand. Its torque goes off: hold it."""
    from strands_robots.hardware.calibrating import Calibrating  # noqa: PLC0415 - real arms only
    from strands_robots.hardware.lerobot_device import make_device  # noqa: PLC0415

    made = make_device(arm, arm_options(port, device, None), "leader" if leader else "follower", calibrated=False)
    steps = Calibrating(made)
    try:
        steps.begin()
        screen.say("The torque is off. Move every joint to the middle of its motion, then press Enter.")
        _line()
        steps.centre()
        screen.say("Now move every joint from one end to the other, then press Enter.")
        steps.watch(_enter().is_set, lambda reaches: _show(screen, reaches))
        path = steps.finish()
    finally:
        steps.close()
    screen.data({"status": "success", "file": str(path)})
    screen.say(f"Calibrated; kept in {path}.", "green")


@contextmanager
def _led(leader: str, robot: Any, options: dict[str, Any]) -> Iterator[Any]:
    """The leader of that name, ready to lead ``robot``."""
    if leader in _METHODS:
        from strands_robots.teleoperators.manual import GamepadLeader, KeyboardLeader  # noqa: PLC0415 - as above

        body = robot.body()
        present = body.get_joints()
        start = {key: present[key] for key in body.bounds if key in present}
        made = KeyboardLeader if leader == "keyboard" else GamepadLeader
        with made(start, body.bounds) as led:
            yield led
        return
    kind, at, port = leader.partition("@")
    if not at:
        yield recording(Path(leader))
        return
    from strands_robots.hardware import LeaderArm  # noqa: PLC0415 - real arms only
    from strands_robots.hardware.lerobot_device import make_device  # noqa: PLC0415

    with arm_connected(leader, LeaderArm(make_device(kind, {**options, "port": port}, "leader"))) as arm:
        yield arm


@contextmanager
def arm_connected(name: str, arm: LeaderArm) -> Iterator[LeaderArm]:
    """The leader arm while it is connected; one sentence where it cannot be."""
    with ExitStack() as stack:
        try:
            stack.enter_context(arm)
        except Exception as exc:
            raise ConnectionError(f"{name} could not be connected: {' '.join(str(exc).split())}") from exc
        yield arm


def recording(path: Path, device: str | None = None, speed: float = 1.0) -> Any:
    """A recording as a leader: ``.csv``, a LeRobot ``.parquet``, or ``.mcap`` of one device.

    Args:
        path: the file.
        device: whose actions, where an ``.mcap`` has those of several; the episode of a ``.parquet``.
        speed: times as fast.

    Raises:
        ValidationError: it cannot be read, or it has no actions of that device.
        MissingExtraError: what reads it is not installed.
    """
    from strands_robots.recording import recorded_actions  # noqa: PLC0415
    from strands_robots.teleoperators.recorded import RecordedLeader, read_episode, read_frames  # noqa: PLC0415 - as above

    if path.suffix == ".mcap":
        frames = recorded_actions(path, device)
    else:
        frames = read_episode(path, device) if path.suffix == ".parquet" else read_frames(path)
    return RecordedLeader(frames, speed)


def _followed(screen: Screen, robot: Any, source: Any) -> tuple[dict[str, Any], StopVerdict]:
    """Wait for the end, with a bar where the leader knows how long it leads, and stop: its row, the verdict."""

    def over() -> str:
        return "" if _NAME in robot.teleoperating() else "It has ended."

    _until(screen, over, getattr(source, "duration", None) or 0.0)
    verdict = _stopped(screen, robot)
    row: dict[str, Any] = robot.teleop_status()["leaders"][_NAME]
    return row, verdict


def _until(screen: Screen, over: Callable[[], str], duration: float) -> str:
    """Wait until ``over`` says why, with a bar where the leader knows how long it leads."""
    began = time.monotonic()
    with following(screen, duration or None) as moved:
        try:
            while not (why := over()):
                moved(time.monotonic() - began)
                time.sleep(_LOOK_S)
        except KeyboardInterrupt:
            return "Ctrl-C."
    return why


@contextmanager
def following(screen: Screen, seconds: float | None, what: str = "playing") -> Iterator[Callable[[float], None]]:
    """A bar over so many seconds, where somebody looks; moved by the seconds that are over."""
    if seconds is None or screen.machine or not screen.out.is_terminal:
        yield lambda _: None
        return
    from rich.progress import Progress  # noqa: PLC0415 - Rich is loaded when something is shown

    with Progress(console=screen.out, transient=True) as progress:
        task = progress.add_task(what, total=seconds)
        yield lambda done: progress.update(task, completed=done)


def arm_options(port: str, device: str | None, calibration: Path | None) -> dict[str, Any]:
    """What was given of a real arm's options."""
    given = {"port": port or None, "id": device, "calibration": calibration}
    return {key: value for key, value in given.items() if value is not None}


def _line() -> None:
    if not sys.stdin.readline():
        raise ValidationError("calibrate needs somebody at the keyboard; standard input has ended.")


def _enter() -> threading.Event:
    """Set when Enter is pressed."""
    pressed = threading.Event()

    def read() -> None:
        sys.stdin.readline()
        pressed.set()

    threading.Thread(target=read, name="enter", daemon=True).start()
    return pressed


def _show(screen: Screen, reaches: dict[str, Reach]) -> None:
    if screen.out.is_terminal and not screen.machine:
        rows = [(motor, each.low, each.present, each.high) for motor, each in reaches.items()]
        screen.out.control(_home(len(rows)))
        screen.show(table("", ("joint", "lowest", "now", "highest"), rows))
    time.sleep(_LOOK_S)


def _home(rows: int) -> Any:
    from rich.control import Control  # noqa: PLC0415 - Rich is loaded when something is shown

    return Control.move(0, -(rows + 3)) if rows else Control()
