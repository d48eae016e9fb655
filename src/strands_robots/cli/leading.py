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
from strands_robots.cli.output import POLL_S, CliError, Screen
from strands_robots.cli.record import record_robot
from strands_robots.envelope import is_error, text_of
from strands_robots.policies import create_policy
from strands_robots.policies.base import Ranges
from strands_robots.policies.preload import Warmable
from strands_robots.policies.rollout import Rollout
from strands_robots.safety.gate import REFUSALS, refusal_envelope
from strands_robots.teleoperators import FULL_RANGES_PER_S, PLUG_INS
from strands_robots.utils import DURATION_MAX_S, ValidationError

LEADER = "leader"
"""Name of the leader at its follower."""

EXECUTE = "execute"
"""The motion of a policy, as callers ask for it."""

ELSEWHERE = "A robot that another process serves is led by its id, over a network."

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
                raise _refused(screen, led, text_of(answer))


def begin_policy(screen: Screen, led: LedRobot, policy: str, task: str, seconds: float | None) -> Rollout:
    """Have a policy drive the robot; return its run.

    Args:
        screen: where a resume is told.
        led: the robot.
        policy: its name, or that of a profile.
        task: in words.
        seconds: its longest time; None for as long as one may take.

    Raises:
        CliError: it was refused. A locked robot stays on the network before, so that its resume reaches it.
    """
    tasks = led.robot.tasks
    with led.held_by(policy, lambda: bool(tasks.running()), EXECUTE):
        try:
            new = tasks.of_policy(task, policy, min(seconds or DURATION_MAX_S, DURATION_MAX_S), {})
            started: Rollout = tasks.start("start_task", "", new)
        except REFUSALS as refused:
            raise _refused(screen, led, text_of(refusal_envelope("start_task", refused))) from refused
    return started


def load_policy(screen: Screen, policy: str, check: Callable[[], object] = lambda: None) -> None:
    """Wait until a policy is loaded, which may take a large one minutes.

    Args:
        screen: where it is told.
        policy: its name.
        check: raises :class:`CliError` where nothing may begin any more; asked to the end.

    Raises:
        ValidationError: there is no such policy.
        CliError: it cannot be loaded.
    """
    made, told = create_policy(policy), False
    while isinstance(made, Warmable) and (problem := made.warm()) is not None:
        check()
        if problem:
            raise CliError(f"The policy {policy} could not be loaded: {problem}.")
        if not told:
            screen.say(f"The policy {policy} is loading.")
            told = True
        time.sleep(POLL_S)
    check()


def _refused(screen: Screen, led: LedRobot, why: str) -> CliError:
    """Return the refusal to begin, once a locked robot was resumed."""
    if led.peer_id and led.locked:
        led.hold(screen)
    return CliError(why)


def is_own(robot: str) -> bool:
    """Return True for a robot that a command itself makes.

    It is TYPE@PORT, a model's file, or a name of this or another package; any other name is that of a served robot.
    """
    from strands_robots.robot import PLUG_INS as ROBOTS  # noqa: PLC0415 - heavy, and needed by these commands alone

    return "@" in robot or "." in robot or robot in ROBOTS.built_in or ROBOTS.get(robot) is not None


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
def made_follower(
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
        raise ValidationError(f"{exc} {ELSEWHERE}") from exc
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
