"""Recording of a robot of this command: its driver, and its readings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

from strands_robots.cli.far_hand import HandLeader, LeadableHere
from strands_robots.cli.leading import (
    LEADER,
    TeleopOptions,
    begin,
    begin_policy,
    load_policy,
)
from strands_robots.cli.led_robot import LedRobot
from strands_robots.cli.output import CliError, Screen
from strands_robots.datasets.recorded import LED_BY_PERSON, LED_BY_RECORDING
from strands_robots.errors import RefusalError
from strands_robots.fleet.reports import said
from strands_robots.policies.rollout import Rollout
from strands_robots.recording.cameras import Frames
from strands_robots.recording.file import Pictures, Recorder, RobotRecording
from strands_robots.safety.stopping import StopVerdict

CAMERAS_HZ_MAX = 60


@dataclass(frozen=True, slots=True)
class Driver:
    """Driver of a robot in its attempts.

    Args:
        begin: begins one; returns its task.
        turn: closed at the end of each attempt.
        led_by: event that tells the leader's kind; empty of a policy.
    """

    begin: Callable[[], Any]
    turn: ExitStack
    led_by: str = ""


@contextmanager
def policy_drives(  # noqa: PLR0917 - one policy, and what is done with it
    screen: Screen, policy: str, task: str, seconds: float | None, check: Callable[[], object], led: LedRobot
) -> Iterator[Driver]:
    """Have a policy drive the robot in each attempt of the block.

    ``check`` raises :class:`CliError` where none may begin any more.

    Raises:
        ValidationError: there is no such policy.
        CliError: it cannot be loaded.
    """

    def started() -> Any:
        # Loaded already but after a failure: the next attempt waits for it, not the caller.
        load_policy(screen, policy, check)
        return begin_policy(screen, led, policy, task, seconds)

    load_policy(screen, policy)
    screen.say(f"The policy {policy} drives {led.robot.tool_name_str}. Ctrl-C stops the robot.")
    yield Driver(started, ExitStack())


@contextmanager
def turns_drive(  # noqa: PLR0917 - one leader, one policy, and what is done with them
    screen: Screen,
    policy: str,
    task: str,
    seconds: float | None,
    hand: HandLeader,
    check: Callable[[], object],
    led: LedRobot,
) -> Iterator[Driver]:
    """Have a policy drive in each attempt of the block, and a leader take over.

    ``check`` raises :class:`CliError` where none may begin any more.

    Raises:
        ConnectionError: a leader arm cannot be connected.
        ValidationError: there is no such policy, or the leader leads joints that the robot lacks.
        CliError: the policy cannot be loaded.
    """
    turn = ExitStack()

    def begun() -> Any:
        load_policy(screen, policy, check)
        turn.callback(hand.end)
        failures = list[str]()

        def ended(why: str, halted: bool) -> None:
            # The session tells of a stop itself, which may be the end of the attempt.
            if not halted:
                failures.append(why)

        with led.held_by(hand.leader_id, lambda: hand.leader_id in led.robot.tasks.leading()):
            try:
                hand.begin(LeadableHere(led.robot), policy, task, seconds, ended)
            except RefusalError as refused:
                raise CliError(said(refused)) from refused
        return TurnsTask(led.robot.tasks.by_leader[hand.leader_id], failures)

    load_policy(screen, policy)
    with hand.connected():
        screen.say(f"The policy {policy} drives {led.robot.tool_name_str} until the leader takes over.")
        yield Driver(begun, turn)


class TurnsTask:
    """The run of a lead, which a leader that fails ends as well.

    Args:
        session: of the robot.
        failures: gets the reason of the leader's end; an empty one is none.
    """

    def __init__(self, session: Rollout, failures: list[str]) -> None:
        self._session, self._failures = session, failures

    @property
    def running(self) -> bool:
        """True until its end."""
        return self._session.running and not self._failures

    @property
    def voided(self) -> bool:
        """True where the robot was stopped."""
        return self._session.voided

    @property
    def error(self) -> str:
        """The reason of a failure; empty without one."""
        return self._session.error or "".join(self._failures[:1])


@contextmanager
def leader_drives(screen: Screen, hand: HandLeader, robot: str, led: LedRobot) -> Iterator[Driver]:
    """Have a leader lead the robot in each attempt of the block.

    Its own control loop reads the leader, so that a frame has the command of its beat.

    Args:
        screen: where a resume is told.
        hand: the leader.
        robot: as the command line has it.
        led: the robot.

    Raises:
        ConnectionError: a leader arm cannot be connected.
    """
    turn = ExitStack()

    def lead() -> Any:
        turn.callback(hand.end)
        source = hand.ready(robot, led.robot, led.robot.body().bounds)
        begin(screen, led, hand.name, source, TeleopOptions(hand.method), publish=False)
        return led.robot.tasks.by_leader[LEADER]

    with hand.connected():
        yield Driver(lead, turn, LED_BY_PERSON if hand.person else LED_BY_RECORDING)


class LocalAttempts:
    """A robot of this process, as :func:`record_attempts` takes it.

    Args:
        led: the robot, served.
        frames: takes its pictures; None for none.
        driver: of its attempts.
        cameras: names of those that are recorded; None for all that ``frames`` has.
    """

    def __init__(
        self, led: LedRobot, frames: Frames | None, driver: Driver, cameras: Sequence[str] | None = None
    ) -> None:
        self._led, self._frames, self._driver, self._cameras = led, frames, driver, cameras or ()

    @property
    def name(self) -> str:
        """Its name in the recording."""
        return str(self._led.robot.tool_name_str)

    @property
    def stopped(self) -> bool:
        """True where others stopped it in this attempt."""
        return self._led.stopped

    @property
    def stopped_by(self) -> str:
        """The reason of the stop, with its caller."""
        return self._led.stopped_by

    @property
    def locked(self) -> str:
        """By whom it is locked; empty while it is free."""
        return self._led.locked if self._led.peer_id else ""

    @property
    def has_cameras(self) -> bool:
        """True where pictures are recorded."""
        return self._frames is not None

    @property
    def cameras(self) -> Sequence[str]:
        """Names of its cameras in the recording, and of those that it lacks."""
        found = [] if self._frames is None else [str(name) for name in self._frames()]
        lacking = (each for each in self._cameras if {each, each.replace("/", ".")}.isdisjoint(found))
        return [*found, *lacking]

    @contextmanager
    def recorded(self, recorder: Recorder, fps: int, pictures: Pictures | None) -> Iterator[None]:
        """Record it in the block, and hand the pictures of its cameras over."""
        if self._driver.led_by:
            recorder.take(self.name, self._driver.led_by, {})
        how: dict[str, Any] = {"frames": self._frames, "cameras_hz": min(fps, CAMERAS_HZ_MAX), "pictures": pictures}
        # An episode has the joints of its steps.
        with self._driver.turn, RobotRecording(self._led.robot, recorder, self.name, joints_hz=1, **how):
            yield

    def halt(self, reason: str) -> StopVerdict:
        """Halt it, and return the verdict."""
        verdict: StopVerdict = self._led.robot.halt(reason)
        return verdict

    def hold(self, screen: Screen) -> object:
        """Tell who stopped it, and stay on the network until Ctrl-C."""
        return self._led.hold(screen)
