"""``teleop`` and ``replay``: lead a follower. ``calibrate``: measure an arm."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.control import Control

from strands_robots.cli.app import Seconds
from strands_robots.cli.led_robot import LedRobot, Serving, halted_first, served
from strands_robots.cli.network import Network, mesh_peer
from strands_robots.cli.output import POLL_S, CliError, Exit, Screen, table, wait_until
from strands_robots.cli.record import record_robot
from strands_robots.envelope import is_error, text_of
from strands_robots.errors import NoAnswerError, NoSuchRobotError, RefusalError
from strands_robots.policies.base import Ranges
from strands_robots.policies.rollout import STOP_JOIN_S
from strands_robots.safety.stopping import StopVerdict
from strands_robots.teleoperators import FULL_RANGES_PER_S, PLUG_INS, LeaderPolicy
from strands_robots.utils import ValidationError, identifier, number

if TYPE_CHECKING:
    from strands_robots.hardware.lerobot_device import JointReach

MESH_PREFIX = "mesh:"
"""Prefix of the name of a leader or follower on the mesh."""

NO_FOLLOWER = "none"
"""Follower of a leader that is only published."""

_NAME = "leader"
_MANUAL = ("keyboard", "gamepad")
FollowerId = Annotated[str | None, typer.Option("--id", help="Calibration id of the follower.")]
Calibration = Annotated[Path | None, typer.Option("--calibration", help="Calibration file of the follower.")]
PeerId = Annotated[str | None, typer.Option("--peer-id", help="Id of the follower on the network.")]
NoNetwork = Annotated[bool, typer.Option("--no-network", help="Lead it on no network: only Ctrl-C stops it.")]


@dataclass(frozen=True, slots=True)
class TeleopOptions:
    """Options of one teleoperation.

    Args:
        method: arm, gamepad or keyboard.
        seconds: end after so many; None for no limit.
        hz: frames a second.
        max_speed: whole joint ranges a second that the follower may cross.
    """

    method: str = "arm"
    seconds: float | None = None
    hz: float = 50.0
    max_speed: float = FULL_RANGES_PER_S

    def timed(self, over: Callable[[], str]) -> Callable[[], str]:
        """Return ``over``, or that the seconds are over."""
        began = time.monotonic()

        def timed_over() -> str:
            late = self.seconds is not None and time.monotonic() - began >= self.seconds
            return over() or (f"{self.seconds:g} s are over." if late else "")

        return timed_over


class NoFollower:
    """Stand-in for a robot where none follows here."""

    def body(self) -> NoFollower:
        """Raise :class:`ValidationError`."""
        raise ValidationError(
            f"FOLLOWER must be a robot for this leader, which starts from the robot's joints, not {NO_FOLLOWER}."
        )


def teleop(
    screen: Screen,
    network: Network,
    *,
    leader: Annotated[
        str,
        typer.Argument(
            help="keyboard, gamepad, a recording (.csv, .parquet, .mcap), TYPE@PORT of an arm, or another package's."
        ),
    ],
    follower: Annotated[
        str, typer.Argument(help="TYPE@PORT of a real arm, a model in simulation, mesh:PEER, or none to --publish.")
    ],
    leader_id: Annotated[str | None, typer.Option("--leader-id", help="Calibration id of the leader.")] = None,
    follower_id: FollowerId = None,
    leader_calibration: Annotated[
        Path | None, typer.Option("--leader-calibration", help="Calibration file of the leader.")
    ] = None,
    calibration: Annotated[Path | None, typer.Option("--calibration", help="Calibration file of the follower.")] = None,
    seconds: Seconds = None,
    hz: Annotated[float, typer.Option("--hz", help="Frames a second, 1 to 1000.")] = 50.0,
    max_speed: Annotated[
        float, typer.Option("--max-speed", help="Whole joint ranges a second that the follower may cross.")
    ] = FULL_RANGES_PER_S,
    publish: Annotated[
        str | None, typer.Option("--publish", help="Also let others follow, on the mesh as this PEER.", metavar="PEER")
    ] = None,
    record: Annotated[Path | None, typer.Option("--record", help="Also record the follower: a new .mcap.")] = None,
    peer_id: PeerId = None,
    no_network: NoNetwork = False,
) -> None:
    """Let a leader drive a follower, served meanwhile, until it ends or Ctrl-C."""
    arm = _arm_options("", follower_id, calibration)
    remote = "" if leader.startswith(MESH_PREFIX) else publish
    how = _how_served(network, follower, peer_id, remote, alone=no_network)
    options = TeleopOptions(leader if leader in _MANUAL else "arm", seconds, hz, max_speed)
    if leader.startswith(MESH_PREFIX):
        if follower.startswith(MESH_PREFIX) or publish is not None:
            raise ValidationError("a leader of the mesh leads a follower of this machine, and publishes itself.")
        peer = identifier("leader", leader.removeprefix(MESH_PREFIX))
        _follow(screen, peer, follower, arm, how=how, options=options, record=record)
        return

    def connected(robot: Any) -> AbstractContextManager[Any]:
        return _connected_leader(leader, robot, _arm_options("", leader_id, leader_calibration))

    _drive(screen, leader, follower, connected, arm, how=how, options=options, publish=publish, record=record)


def replay(
    screen: Screen,
    network: Network,
    *,
    file: Annotated[Path, typer.Argument(help="A recording: .mcap, .csv or .parquet.")],
    to: Annotated[str, typer.Option("--to", help="TYPE@PORT of a real arm, a model, or mesh:PEER.")],
    device: Annotated[str | None, typer.Option("--device", help="Device in a recording of several.")] = None,
    follower_id: FollowerId = None,
    calibration: Calibration = None,
    speed: Annotated[float, typer.Option("--speed", help="Times as fast, at most 10.")] = 1.0,
    peer_id: PeerId = None,
    no_network: NoNetwork = False,
) -> None:
    """Play the recorded actions of a device to a follower, here or on the mesh, and stop it at the end."""
    leader = _recorded_leader(file, device, speed)
    arm = _arm_options("", follower_id, calibration)
    how = _how_served(network, to, peer_id, None, alone=no_network)
    _drive(screen, file.name, to, lambda _: nullcontext(leader), arm, how=how, options=TeleopOptions())


def calibrate(
    screen: Screen,
    *,
    arm: Annotated[str, typer.Argument(help="Such as so101.")],
    port: Annotated[str, typer.Option("--port", help="Its serial port, such as /dev/ttyACM0.")],
    device: Annotated[str | None, typer.Option("--id", help="Id under which the calibration is stored.")] = None,
    leader: Annotated[bool, typer.Option("--leader", help="It is a leader arm.")] = False,
) -> None:
    """Measure an arm's middle and the ends of its joints, moved by hand. Its torque goes off: hold it."""
    from strands_robots.hardware.lerobot_device import Calibrator, make_device  # noqa: PLC0415 - a real arm only

    made = make_device(arm, _arm_options(port, device, None), "leader" if leader else "follower", calibrated=False)
    steps = Calibrator(made)
    try:
        steps.begin()
        screen.say("The torque is off. Move every joint to the middle of its motion, then press Enter.")
        _EnterKey().wait()
        steps.centre()
        screen.say("Now move every joint from one end to the other, then press Enter.")
        while True:
            enter = _EnterKey()
            steps.watch(enter.pressed, lambda reaches: _draw_reaches(screen, reaches))
            enter.wait()
            still = steps.unmoved()
            if not still:
                break
            screen.say(f"Not moved yet: {', '.join(still)}. Move each from one end to the other, then press Enter.")
        path = steps.finish()
    finally:
        steps.close()
    screen.data({"status": "success", "file": str(path)})
    screen.say(f"Calibrated; stored in {path}.", "green")


def _drive(
    screen: Screen,
    leader: str,
    follower: str,
    connected: Callable[[Any], AbstractContextManager[Any]],
    arm: dict[str, Any],
    *,
    how: Serving,
    options: TeleopOptions,
    publish: str | None = None,
    record: Path | None = None,
) -> None:
    """Let the leader that ``connected`` returns drive a follower, and stop it.

    Raises:
        CliError: it was refused, it failed, or the follower did not confirm its stop.
    """
    if follower.startswith(MESH_PREFIX):
        if publish is not None or record is not None:
            raise ValidationError("--publish and --record are for a follower of this machine, not of the mesh.")
        peer = identifier("follower", follower.removeprefix(MESH_PREFIX))
        with _refused():
            _lead_peer(screen, leader, peer, connected, options)
        return
    if follower == NO_FOLLOWER:
        if publish is None or record is not None:
            raise ValidationError(f"the follower {NO_FOLLOWER} goes with --publish PEER, and has nothing to --record.")
        peer = identifier("--publish", publish)
        with connected(NoFollower()) as source:
            _publish(screen, leader, peer, source, options)
        return
    with (
        _made_follower(screen, follower, arm, record, how) as led,
        connected(led.robot) as source,
        halted_first(led.robot),
    ):
        robot = led.robot
        _check_keys(follower, source, robot.body().bounds)
        _begin(screen, led, leader, source, options, publish=publish is not None)
        session = robot.tasks.by_leader[_NAME]
        _announce(screen, leader, follower, source)
        if publish is not None:
            screen.say(f"Others may follow {publish}/{_NAME} on the mesh.")
        ended = list[StopVerdict | None]()
        wait_until(
            screen,
            lambda: "" if session.running and not session.voided else "It has ended.",
            getattr(source, "duration", None) or 0.0,
            at_end=lambda: ended.append(_halted(led)),
        )
        verdict, why = _ended(screen, led, ended[0])
        session.join(STOP_JOIN_S)
        row: dict[str, Any] = robot.teleop_status()["leaders"][_NAME]
    screen.data({"event": "ended", **row, "stopped": verdict.stopped, **({"stopped_by": why} if why else {})})
    if row["state"] == "error":
        raise CliError(f"The teleoperation failed: {row['error']}", **row)
    screen.say(f"{row['state'].capitalize()} after {row['step']} frames, {row['errors']} of them unusable.", "green")
    _check_stopped(verdict, why)


def _begin(screen: Screen, led: LedRobot, leader: str, source: Any, options: TeleopOptions, *, publish: bool) -> None:
    """Let the leader lead from the robot's present position.

    Raises:
        CliError: it was refused. A locked robot stays on the network before, so that its resume reaches it.
    """
    robot = led.robot
    with led.held_by(leader if "@" in leader else Path(leader).name, lambda: _NAME in robot.teleoperating()):
        for answer in (
            robot.attach_teleop(source, _NAME, method=options.method, max_speed=options.max_speed),
            robot.teleoperate(_NAME, duration=options.seconds, hz=options.hz, publish=publish),
        ):
            if is_error(answer):
                if led.peer_id and led.locked:
                    led.hold(screen)
                raise CliError(text_of(answer))


def _halted(led: LedRobot) -> StopVerdict | None:
    """Halt the robot; return None where a caller of the network has stopped it."""
    return None if led.stopped else led.halt_last()


def _ended(screen: Screen, led: LedRobot, verdict: StopVerdict | None) -> tuple[StopVerdict, str]:
    """Tell the end; return the verdict on it, and who stopped the robot before.

    Args:
        verdict: of the halt at the end; None for a robot that was stopped from the network, and stays there until
            Ctrl-C.
    """
    if verdict is not None:
        _tell_stop(screen, led.robot, verdict)
        return verdict, ""
    why = led.stopped_by
    held = led.hold(screen)
    # Another caller may have moved it since.
    verdict = led.halt_last()
    return held if held is not None and not held.stopped else verdict, why


def _follow(
    screen: Screen,
    peer: str,
    follower: str,
    arm: dict[str, Any],
    *,
    how: Serving,
    options: TeleopOptions,
    record: Path | None,
) -> None:
    """Let a leader published on the mesh drive a follower of this machine."""
    from strands_robots.fleet.mesh.leading import DEVICE, FollowedPeer, followed  # noqa: PLC0415 - loaded when the network is used

    with _made_follower(screen, follower, arm, record, how) as led, halted_first(led.robot):
        robot, leaders, ended = led.robot, list[FollowedPeer](), list[StopVerdict | None]()
        with _refused(), ExitStack() as stack:
            with led.held_by(peer, lambda: bool(leaders)):
                leaders.append(stack.enter_context(followed(robot, peer, options.max_speed)))
            # The end of the stream waits for its last frame and for the network.
            stack.enter_context(halted_first(robot))
            leading = leaders[0]
            _announce(screen, f"{peer}/{DEVICE}", robot.tool_name_str, leading)
            why = wait_until(screen, options.timed(leading.over), at_end=lambda: ended.append(_halted(led)))
            stats = leading.stats
        verdict, by = _ended(screen, led, ended[0])
    row = {key: stats[key] for key in ("frames_received", "errors", "rejected", "slew_rejected", "rate_dropped")}
    screen.data({"event": "ended", **row, "why": why, "stopped": verdict.stopped, **({"stopped_by": by} if by else {})})
    _check_stopped(verdict, by)
    left_out = row["errors"] + row["rejected"] + row["slew_rejected"] + row["rate_dropped"]
    screen.say(f"{why} {row['frames_received']} frames arrived, {left_out} of them were not applied.", "green")


def _lead_peer(
    screen: Screen,
    leader: str,
    peer: str,
    connected: Callable[[Any], AbstractContextManager[Any]],
    options: TeleopOptions,
) -> None:
    """Let a leader drive a peer of the mesh until it ends, then stop the peer."""
    from strands_robots.fleet.mesh.leading import DEVICE, LedPeer, RemoteFollower, dialled, publisher  # noqa: PLC0415 - as above

    rate = number("hz", options.hz, low=1, high=1000)
    speed = number("max_speed", options.max_speed, above=0, high=20)
    with dialled("lead", peer) as mesh:
        follower = RemoteFollower(mesh, peer)
        with connected(follower) as source:
            _check_keys(peer, source, follower.bounds)
            policy = LeaderPolicy(source, device=DEVICE, method=options.method, max_speed=speed, period=1 / rate)
            led = LedPeer(follower, mesh.peer_id, policy)
            publishing = publisher(mesh, led.bounded, options.method, rate)
            standing = threading.Event()

            def stop() -> None:
                if not standing.is_set():
                    follower.stop()
                    standing.set()

            follower.open_stream(mesh.peer_id)
            try:
                publishing.start()
                _announce(screen, leader, peer, source)
                why = wait_until(screen, options.timed(led.over), getattr(source, "duration", None) or 0.0, at_end=stop)
            finally:
                # The follower is stopped first; publishing ends even when it does not answer.
                try:
                    stop()
                    screen.say(f"{peer} stands still.", "green")
                finally:
                    sent = publishing.stop()
    row = {"frames": sent["frames"], "errors": policy.errors, "applied": led.counters.get("frames_received", 0)}
    screen.data({"event": "ended", **row, "why": why, "stopped": True})
    if led.bounded.error:
        raise CliError(f"The leader failed: {led.bounded.error}", **row)
    if why.startswith(peer):
        raise CliError(f"Ended: {why.rstrip('.')}.", **row)
    _report_sent(screen, why, row)


def _publish(screen: Screen, leader: str, peer: str, source: Any, options: TeleopOptions) -> None:
    """Publish a leader on the mesh as ``peer`` until it ends."""
    from strands_robots.fleet.mesh.leading import DEVICE, PublishedLeader, publisher  # noqa: PLC0415 - as above

    with mesh_peer(None, peer, "tool") as mesh:
        published = PublishedLeader(source)
        publishing = publisher(mesh, published, options.method, options.hz)
        publishing.start()
        screen.say(f"{leader} is published as {peer}/{DEVICE}. Ctrl-C ends it.")
        over = options.timed(lambda: "The leader has finished." if published.finished else "")
        try:
            why = wait_until(screen, over, getattr(source, "duration", None) or 0.0)
        finally:
            sent = publishing.stop()
    row = {"frames": sent["frames"], "errors": sent["errors"]}
    screen.data({"event": "ended", **row, "why": why})
    if not row["frames"]:
        raise CliError(f"{leader} gave no frame that could be published.", **row)
    _report_sent(screen, why, row)


def _report_sent(screen: Screen, why: str, row: Mapping[str, Any]) -> None:
    screen.say(f"{why} {row['frames']} frames sent, {row['errors']} of the leader's unusable.", "green")


def _check_keys(follower: str, leader: Any, bounds: Ranges) -> None:
    """Refuse a leader of joints that the follower lacks, before anything moves."""
    unknown = [key for key in getattr(leader, "keys", ()) if key not in bounds]
    if unknown:
        raise ValidationError(f"{follower} has {', '.join(bounds)}, not {', '.join(unknown)}, which the leader leads.")


def _announce(screen: Screen, leader: str, follower: str, source: Any) -> None:
    """Print which leader leads which follower, and its keys."""
    screen.say(f"{leader} leads {follower}. Ctrl-C stops the follower.")
    for name, up, down in getattr(source, "help", []):
        screen.say(f"  {up} and {down} move {name}")


@contextmanager
def _refused() -> Iterator[None]:
    """Raise a refusal as the command's failure."""
    try:
        yield
    except RefusalError as refusal:
        silent = isinstance(refusal, NoAnswerError | NoSuchRobotError)
        raise CliError(str(refusal), Exit.SILENT if silent else Exit.REFUSED) from refusal


def _how_served(network: Network, follower: str, peer_id: str | None, on_mesh: str | None, *, alone: bool) -> Serving:
    """Return how a follower of this machine is served."""
    if not follower.startswith(MESH_PREFIX) and follower != NO_FOLLOWER:
        return Serving.of(network, peer_id, on_mesh, alone=alone)
    if alone or peer_id is not None:
        raise ValidationError(f"--peer-id and --no-network are for a follower of this machine, not for {follower}.")
    if network.flags:
        network.use_mesh()
    return Serving(network)


@contextmanager
def _made_follower(
    screen: Screen, follower: str, arm: dict[str, Any], record: Path | None, how: Serving
) -> Iterator[LedRobot]:
    """Make, serve and record ``TYPE@PORT`` or a model; halt it at the end."""
    from strands_robots.robot import NO_SUCH_MODEL, Robot, counts_as_hardware  # noqa: PLC0415 - heavy, and needed by these commands alone

    kind, at, port = follower.partition("@")
    how.check()
    try:
        robot: Any = Robot(kind, mode="real" if at else "sim", mesh=False, **({**arm, "port": port} if at else {}))
    except ValidationError as exc:
        if exc.code != NO_SUCH_MODEL or "/" in kind or "." in kind:
            raise
        hint = "A device of Device Connect takes no frames; serve its robot on the mesh too, and name it mesh:PEER."
        raise ValidationError(f"{exc} {hint}") from exc
    try:
        if not callable(getattr(robot, "attach_teleop", None)):
            raise ValidationError(f"follower must be a robot that a leader can lead; {kind} has no attach_teleop.")
        with served(screen, robot, how, "real" if at or counts_as_hardware(kind) else "sim") as led:
            try:
                with record_robot(screen, robot, how.peer_id or robot.tool_name_str, record):
                    yield led
            finally:
                # On the network still: a stop reaches it until it stands.
                led.halt_last()
    finally:
        robot.cleanup()


def _tell_stop(screen: Screen, robot: Any, verdict: StopVerdict) -> None:
    screen.say("Stopping the follower...")
    if verdict.stopped:
        screen.say("The follower stands still.", "green")
    if verdict.settling:
        screen.say(robot.wait_settled())


def _check_stopped(verdict: StopVerdict, stopped_by: str) -> None:
    if not verdict.stopped:
        raise CliError(f"The follower did not confirm its stop: {text_of(verdict.envelope())}")
    if stopped_by:
        raise CliError(f"Stopped from the network: {stopped_by}")


@contextmanager
def _connected_leader(leader: str, robot: Any, options: dict[str, Any]) -> Iterator[Any]:
    """Yield the leader of that name, ready to lead ``robot``.

    Raises:
        ConnectionError: a leader arm cannot be connected.
    """
    from strands_robots.robot import LEROBOT  # noqa: PLC0415 - heavy, and needed by these commands alone

    if leader in _MANUAL:
        from strands_robots.teleoperators import GamepadLeader, KeyboardLeader  # noqa: PLC0415 - as above

        body = robot.body()
        present = body.get_joints()
        start = {key: present[key] for key in body.bounds if key in present}
        manual = KeyboardLeader if leader == "keyboard" else GamepadLeader
        with manual(start, body.bounds) as source:
            yield source
        return
    kind, at, port = leader.partition("@")
    stated = {**options, "port": port} if at else options
    plug_in = PLUG_INS.get(kind)
    made = None if plug_in is None else plug_in.make(**stated)
    if made is not None and not callable(getattr(made, "connect", None)):
        yield made
        return
    if made is None and not at:
        yield _recorded_leader(Path(leader))
        return
    from strands_robots.hardware import LeaderArm  # noqa: PLC0415 - real arms only
    from strands_robots.hardware.lerobot_device import make_device  # noqa: PLC0415

    with ExitStack() as stack:
        arm = LeaderArm(make_device(kind.removeprefix(LEROBOT), stated, "leader") if made is None else made)
        try:
            stack.enter_context(arm)
        except Exception as exc:
            raise ConnectionError(f"{leader} could not be connected: {' '.join(str(exc).split())}") from exc
        yield arm


def _recorded_leader(path: Path, device: str | None = None, speed: float = 1.0) -> Any:
    """Return a recording as a leader: ``.csv``, ``.parquet`` or ``.mcap``.

    Args:
        path: the file.
        device: the device in an ``.mcap`` of several; the episode of a ``.parquet``.
        speed: times as fast.

    Raises:
        ValidationError: it cannot be read, or it has no actions of that device.
        MissingExtraError: the package that reads it is not installed.
    """
    from strands_robots.recording.file import recorded_actions  # noqa: PLC0415 - as above
    from strands_robots.teleoperators import RecordedLeader, read_episode, read_frames  # noqa: PLC0415

    if path.suffix == ".mcap":
        frames = recorded_actions(path, device)
    else:
        frames = read_episode(path, device) if path.suffix == ".parquet" else read_frames(path)
    return RecordedLeader(frames, speed)


def _arm_options(port: str, device: str | None, calibration: Path | None) -> dict[str, Any]:
    """Return the options of a real arm that were given."""
    options = {"port": port or None, "id": device, "calibration": calibration}
    return {key: value for key, value in options.items() if value is not None}


class _EnterKey:
    """The next press of Enter, read on a thread."""

    def __init__(self) -> None:
        self._line = ""
        self._reader = threading.Thread(target=self._read, name="enter", daemon=True)
        self._reader.start()

    def pressed(self) -> bool:
        """Return True once it was pressed, or the input has ended."""
        return not self._reader.is_alive()

    def wait(self) -> None:
        """Wait for it. Raises :class:`ValidationError` where the input has ended."""
        self._reader.join()
        if not self._line:
            raise ValidationError("calibrate needs a person at the keyboard; standard input has ended.")

    def _read(self) -> None:
        self._line = sys.stdin.readline()


def _draw_reaches(screen: Screen, reaches: dict[str, JointReach]) -> None:
    if screen.live:
        rows = [(motor, each.low, each.present, each.high) for motor, each in reaches.items()]
        screen.out.control(Control.move(0, -(len(rows) + 3)) if rows else Control())
        screen.show(table("", ("joint", "lowest", "now", "highest"), rows))
    time.sleep(POLL_S)
