"""Recording of a robot of this command: its driver, and its readings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

from strands_robots.cli.dataset_recording import Keys
from strands_robots.cli.far_hand import HandLeader, LeadableHere
from strands_robots.cli.leading import (
    LEADER,
    MANUAL,
    TeleopOptions,
    announce,
    begin,
    begin_policy,
    check_keys,
    connected_leader,
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
from strands_robots.teleoperators import RecordedLeader

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
def policy_drives(screen: Screen, policy: str, task: str, seconds: float | None, led: LedRobot) -> Iterator[Driver]:
    """Have a policy drive the robot in each attempt of the block.

    Raises:
        ValidationError: there is no such policy.
        CliError: it cannot be loaded.
    """

    def started() -> Any:
        # Loaded already but after a failure: the next attempt waits for it, not the caller.
        load_policy(screen, policy)
        return begin_policy(screen, led, policy, task, seconds)

    load_policy(screen, policy)
    screen.say(f"The policy {policy} drives {led.robot.tool_name_str}. Ctrl-C stops the robot.")
    yield Driver(started, ExitStack())


@contextmanager
def turns_drive(  # noqa: PLR0917 - one leader, one policy, and what is done with them
    screen: Screen, policy: str, task: str, seconds: float | None, hand: HandLeader, led: LedRobot
) -> Iterator[Driver]:
    """Have a policy drive in each attempt of the block, and a leader take over.

    Raises:
        ConnectionError: a leader arm cannot be connected.
        ValidationError: there is no such policy, or the leader leads joints that the robot lacks.
        CliError: the policy cannot be loaded.
    """
    turn = ExitStack()

    def begun() -> Any:
        load_policy(screen, policy)
        turn.callback(hand.end)
        failures = list[str]()

        def ended(why: str, halted: bool) -> None:
            # The session tells of a stop itself, which may be the end of the attempt.
            if not halted:
                failures.append(why)

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
def leader_drives(  # noqa: PLR0917 - one leader, and what is done with it
    screen: Screen, leader: str, robot: str, options: dict[str, Any], keys: Keys | None, led: LedRobot
) -> Iterator[Driver]:
    """Have a leader lead the robot in each attempt of the block.

    Args:
        screen: where its keys are told.
        leader: as the command line has it.
        robot: as the command line has it.
        options: of a leader arm.
        keys: of the person; None for nobody.
        led: the robot.

    Raises:
        ConnectionError: a leader arm cannot be connected.
        ValidationError: it leads joints that the robot lacks.
    """
    manual, turn = leader in MANUAL, ExitStack()
    how = TeleopOptions(leader if manual else "arm")

    def connected() -> AbstractContextManager[Any]:
        return connected_leader(leader, led.robot, options, (lambda key: None) if keys is None else keys.pressed)

    # What a hand moves begins each attempt where the robot then is.
    with nullcontext() if manual else connected() as lasting:
        recorded = isinstance(lasting, RecordedLeader)
        if not manual:
            check_keys(robot, lasting, led.robot.body().bounds)
            announce(screen, leader, robot, lasting)

        def lead() -> Any:
            source: Any = turn.enter_context(connected()) if manual else lasting
            if manual:
                announce(screen, leader, robot, source)
            if keys is not None and leader == "keyboard":
                keys.leading = True
                turn.callback(setattr, keys, "leading", False)
            if recorded:
                source.rewind()
            begin(screen, led, leader, source, how, publish=False)
            return led.robot.tasks.by_leader[LEADER]

        yield Driver(lead, turn, LED_BY_RECORDING if recorded else LED_BY_PERSON)


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
