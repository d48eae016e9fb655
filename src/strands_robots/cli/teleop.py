"""``teleop`` and ``replay``: lead a follower. ``calibrate``: measure an arm."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.control import Control

from strands_robots.cli.app import Seconds
from strands_robots.cli.far_hand import HandLeader
from strands_robots.cli.leading import (
    LEADER,
    MANUAL,
    TeleopOptions,
    announce,
    arm_options,
    begin,
    check_keys,
    connected_leader,
    is_own,
    made_follower,
    recorded_leader,
)
from strands_robots.cli.led_robot import ENDED, LedRobot, NotBegunError, Serving, halted_first
from strands_robots.cli.network import Network, answering, mesh_peer, one_robot, reached
from strands_robots.cli.output import POLL_S, CliError, Exit, Screen, table, wait_until
from strands_robots.envelope import text_of
from strands_robots.errors import NoAnswerError, NoSuchRobotError, RefusalError, UnreachableError
from strands_robots.policies.rollout import STOP_JOIN_S
from strands_robots.safety.stopping import StopVerdict
from strands_robots.teleoperators import FULL_RANGES_PER_S, LeaderPolicy
from strands_robots.utils import ValidationError, identifier, number

if TYPE_CHECKING:
    from strands_robots.fleet import RemoteRobot
    from strands_robots.hardware.lerobot_device import JointReach

MESH_PREFIX = "mesh:"
"""Prefix of the name of a leader or follower on the mesh."""

NO_FOLLOWER = "none"
"""Follower of a leader that is only published."""

FollowerId = Annotated[str | None, typer.Option("--id", help="Calibration id of the follower.")]
Calibration = Annotated[Path | None, typer.Option("--calibration", help="Calibration file of the follower.")]
PeerId = Annotated[str | None, typer.Option("--peer-id", help="Id of the follower on the network.")]
NoNetwork = Annotated[bool, typer.Option("--no-network", help="Lead it on no network: only Ctrl-C stops it.")]


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
        str,
        typer.Argument(
            help="TYPE@PORT of a real arm, a simulated robot, the id of a served one, or none to --publish."
        ),
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
    arm = arm_options("", follower_id, calibration)
    remote = "" if leader.startswith(MESH_PREFIX) else publish
    how = _how_served(network, follower, peer_id, remote, alone=no_network)
    options = TeleopOptions(leader if leader in MANUAL else "arm", seconds, hz, max_speed)
    if leader.startswith(MESH_PREFIX):
        if follower.startswith(MESH_PREFIX) or publish is not None:
            raise ValidationError("a leader of the mesh leads a follower of this machine, and publishes itself.")
        peer = identifier("leader", leader.removeprefix(MESH_PREFIX))
        _follow(screen, peer, follower, arm, how=how, options=options, record=record)
        return

    of_leader = arm_options("", leader_id, leader_calibration)
    if not no_network and _is_served(follower):
        if publish is not None or record is not None or arm or peer_id is not None:
            raise ValidationError(f"{follower} is served elsewhere: leave out what is of a follower of this command.")
        hand = HandLeader(screen, leader, of_leader, None)
        _lead_served(screen, network, hand, follower, options, argument="FOLLOWER")
        return

    def connected(robot: Any) -> AbstractContextManager[Any]:
        return connected_leader(leader, robot, of_leader)

    _drive(screen, leader, follower, connected, arm, how=how, options=options, publish=publish, record=record)


def replay(
    screen: Screen,
    network: Network,
    *,
    file: Annotated[Path, typer.Argument(help="A recording: .mcap, .csv or .parquet.")],
    to: Annotated[str, typer.Option("--to", help="TYPE@PORT of a real arm, a model, or the id of a served robot.")],
    device: Annotated[str | None, typer.Option("--device", help="Device in a recording of several.")] = None,
    follower_id: FollowerId = None,
    calibration: Calibration = None,
    speed: Annotated[float, typer.Option("--speed", help="Times as fast, at most 10.")] = 1.0,
    peer_id: PeerId = None,
    no_network: NoNetwork = False,
) -> None:
    """Play the recorded actions of a device to a follower, and stop it at the end."""
    leader = recorded_leader(file, device, speed)
    arm = arm_options("", follower_id, calibration)
    if not no_network and _is_served(to):
        if arm or peer_id is not None:
            raise ValidationError(f"{to} is served elsewhere: leave out what is of a follower of this command.")
        hand = HandLeader(screen, file.name, {}, None, leader)
        _lead_served(screen, network, hand, to, TeleopOptions(), argument="--to")
        return
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

    made = make_device(arm, arm_options(port, device, None), "leader" if leader else "follower", calibrated=False)
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
        made_follower(screen, follower, arm, record, how) as led,
        connected(led.robot) as source,
        halted_first(led.robot),
    ):
        robot = led.robot
        check_keys(follower, source, robot.body().bounds)
        begin(screen, led, leader, source, options, publish=publish is not None)
        session = robot.tasks.by_leader[LEADER]
        announce(screen, leader, follower, source)
        if publish is not None:
            screen.say(f"Others may follow {publish}/{LEADER} on the mesh.")
        ended = list[StopVerdict | None]()
        wait_until(
            screen,
            lambda: "" if session.running and not session.voided else "It has ended.",
            getattr(source, "duration", None) or 0.0,
            at_end=lambda: ended.append(_halted(led)),
        )
        verdict, why = _ended(screen, led, ended[0])
        session.join(STOP_JOIN_S)
        row: dict[str, Any] = robot.teleop_status()["leaders"][LEADER]
    screen.data({"event": "ended", **row, "stopped": verdict.stopped, **({"stopped_by": why} if why else {})})
    if row["state"] == "error":
        raise CliError(f"The teleoperation failed: {row['error']}", **row)
    screen.say(f"{row['state'].capitalize()} after {row['step']} frames, {row['errors']} of them unusable.", "green")
    _check_stopped(verdict, why)


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

    with made_follower(screen, follower, arm, record, how) as led, halted_first(led.robot):
        robot, leaders, ended = led.robot, list[FollowedPeer](), list[StopVerdict | None]()
        with _refused(), ExitStack() as stack:
            with led.held_by(peer, lambda: bool(leaders)):
                leaders.append(stack.enter_context(followed(robot, peer, options.max_speed)))
            # The end of the stream waits for its last frame and for the network.
            stack.enter_context(halted_first(robot))
            leading = leaders[0]
            announce(screen, f"{peer}/{DEVICE}", robot.tool_name_str, leading)
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
            check_keys(peer, source, follower.bounds)
            policy = LeaderPolicy(source, device=DEVICE, method=options.method, max_speed=speed, period=1 / rate)
            led = LedPeer(follower, mesh.peer_id, policy)
            publishing = publisher(mesh, led.bounded, options.method, rate)
            duration = getattr(source, "duration", None) or 0.0
            try:
                # The follower is stopped first; publishing ends even when it does not answer.
                with halted_first(follower):
                    with _refused():
                        follower.open_stream(mesh.peer_id)
                    publishing.start()
                    announce(screen, leader, peer, source)
                    why = wait_until(screen, options.timed(led.over), duration, at_end=lambda: follower.halt(ENDED))
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


def _is_served(follower: str) -> bool:
    """Return True for the id of a robot that another process serves."""
    return not follower.startswith(MESH_PREFIX) and follower != NO_FOLLOWER and not is_own(follower)


def _lead_served(
    screen: Screen, network: Network, hand: HandLeader, follower: str, options: TeleopOptions, *, argument: str
) -> None:
    """Let a leader drive a robot that another process serves, and stop it.

    Args:
        screen: where it is told.
        network: that reaches the robot.
        hand: the leader.
        follower: ``ID`` or ``WORLD/ROBOT``, the value of ``argument``.
        options: of the teleoperation.
        argument: names the follower in a refusal.

    Raises:
        CliError: it was refused, the leader failed, or others stopped the robot.
    """
    ends = list[tuple[str, bool]]()
    with served_follower(screen, network, follower, argument) as robot, hand.connected(), halted_first(robot):
        with _refused():
            hand.begin(robot, "", "", options.seconds, lambda *end: ends.append(end), max_speed=options.max_speed)
        verdicts = list[StopVerdict]()

        def stop() -> None:
            hand.cease()
            verdicts.append(robot.halt(ENDED))
            hand.end()

        over = options.timed(lambda: ends[0][0] or "The leader has finished." if ends else "")
        why = wait_until(screen, over, at_end=stop)
    why, halted = ends[0] if ends else (why, False)
    screen.data({"event": "ended", "why": why, "stopped": verdicts[0].stopped, "stopped_by_others": halted})
    if ends and why:
        raise CliError(f"Ended: {why}")
    _check_stopped(verdicts[0], "")
    screen.say(f"{why or 'The leader has finished.'} {follower} stands still.", "green")


@contextmanager
def served_follower(screen: Screen, network: Network, name: str, argument: str) -> Iterator[RemoteRobot]:
    """Join the networks, and yield the served robot ``ID`` or ``WORLD/ROBOT``.

    Raises:
        CliError: there is no such robot, or it does not answer.
        ValidationError: the world has several robots and none is named, or none of that name.
    """
    peer, _, part = name.partition("/")
    with reached(screen, network, identifier(argument, peer)) as (there, world):
        with answering(there, peer, ""):
            robot = one_robot(world, part, argument)
        yield robot


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


@contextmanager
def _refused() -> Iterator[None]:
    """Raise a refusal as the command's failure.

    Raises:
        NotBegunError: the robot refused it, or is not there.
        CliError: it did not answer, and may have begun.
    """
    try:
        yield
    except RefusalError as refusal:
        silent = isinstance(refusal, NoAnswerError | NoSuchRobotError)
        failure = CliError if isinstance(refusal, NoAnswerError | UnreachableError) else NotBegunError
        raise failure(str(refusal), Exit.SILENT if silent else Exit.REFUSED) from refusal


def _how_served(network: Network, follower: str, peer_id: str | None, on_mesh: str | None, *, alone: bool) -> Serving:
    """Return how a follower of this machine is served."""
    if not follower.startswith(MESH_PREFIX) and follower != NO_FOLLOWER:
        return Serving.of(network, peer_id, on_mesh, alone=alone)
    if alone or peer_id is not None:
        raise ValidationError(f"--peer-id and --no-network are for a follower of this machine, not for {follower}.")
    if network.flags:
        network.use_mesh()
    return Serving(network)


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
