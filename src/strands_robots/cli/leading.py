"""Leaders and their followers, as the commands make and connect them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from strands_robots.cli.led_robot import LedRobot, Serving, served
from strands_robots.cli.output import CliError, Screen
from strands_robots.cli.record import record_robot
from strands_robots.envelope import is_error, text_of
from strands_robots.policies.base import Ranges
from strands_robots.teleoperators import FULL_RANGES_PER_S, PLUG_INS
from strands_robots.utils import ValidationError

LEADER = "leader"
"""Name of the leader at its follower."""

ELSEWHERE = "A device of Device Connect takes no frames; serve its robot on the mesh too, and name it mesh:PEER."

MANUAL = ("keyboard", "gamepad")
"""Leaders that a person holds in hand, without an arm."""


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


def begin(screen: Screen, led: LedRobot, leader: str, source: Any, options: TeleopOptions, *, publish: bool) -> None:
    """Let the leader lead from the robot's present position.

    Raises:
        CliError: it was refused. A locked robot stays on the network before, so that its resume reaches it.
    """
    robot = led.robot
    with led.held_by(leader if "@" in leader else Path(leader).name, lambda: LEADER in robot.teleoperating()):
        for answer in (
            robot.attach_teleop(source, LEADER, method=options.method, max_speed=options.max_speed),
            robot.teleoperate(LEADER, duration=options.seconds, hz=options.hz, publish=publish),
        ):
            if is_error(answer):
                if led.peer_id and led.locked:
                    led.hold(screen)
                raise CliError(text_of(answer))


def check_keys(follower: str, leader: Any, bounds: Ranges) -> None:
    """Refuse a leader of joints that the follower lacks, before anything moves."""
    unknown = [key for key in getattr(leader, "keys", ()) if key not in bounds]
    if unknown:
        raise ValidationError(f"{follower} has {', '.join(bounds)}, not {', '.join(unknown)}, which the leader leads.")


def announce(screen: Screen, leader: str, follower: str, source: Any) -> None:
    """Print which leader leads which follower, and its keys."""
    screen.say(f"{leader} leads {follower}. Ctrl-C stops the follower.")
    for name, up, down in getattr(source, "help", []):
        screen.say(f"  {up} and {down} move {name}")


@contextmanager
def made_follower(  # noqa: PLR0917 - one robot, and what is done with it
    screen: Screen, follower: str, arm: dict[str, Any], record: Path | None, how: Serving, elsewhere: str = ELSEWHERE
) -> Iterator[LedRobot]:
    """Make, serve and record ``TYPE@PORT`` or a model; halt it at the end.

    ``elsewhere`` is said of a name that is no model, and may be that of a robot of another process.
    """
    from strands_robots.robot import NO_SUCH_MODEL, Robot, counts_as_hardware  # noqa: PLC0415 - heavy, and needed by these commands alone

    kind, at, port = follower.partition("@")
    how.check()
    try:
        robot: Any = Robot(kind, mode="real" if at else "sim", mesh=False, **({**arm, "port": port} if at else {}))
    except ValidationError as exc:
        if exc.code != NO_SUCH_MODEL or "/" in kind or "." in kind:
            raise
        raise ValidationError(f"{exc} {elsewhere}") from exc
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


@contextmanager
def connected_leader(
    leader: str, robot: Any, options: dict[str, Any], other: Callable[[str], None] = lambda key: None
) -> Iterator[Any]:
    """Yield the leader of that name, ready to lead ``robot``.

    Args:
        leader: as the command line has it.
        robot: that it is to lead.
        options: of a leader arm.
        other: gets the keys of a keyboard that move nothing.

    Raises:
        ConnectionError: a leader arm cannot be connected.
    """
    from strands_robots.robot import LEROBOT  # noqa: PLC0415 - heavy, and needed by these commands alone

    if leader in MANUAL:
        from strands_robots.teleoperators import GamepadLeader, KeyboardLeader  # noqa: PLC0415 - as above

        body = robot.body()
        present = body.get_joints()
        start = {key: present[key] for key in body.bounds if key in present}
        manual: Any = partial(KeyboardLeader, other=other) if leader == "keyboard" else GamepadLeader
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
        yield recorded_leader(Path(leader))
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


def recorded_leader(path: Path, device: str | None = None, speed: float = 1.0) -> Any:
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


def arm_options(port: str, device: str | None, calibration: Path | None) -> dict[str, Any]:
    """Return the options of a real arm that were given."""
    options = {"port": port or None, "id": device, "calibration": calibration}
    return {key: value for key, value in options.items() if value is not None}
