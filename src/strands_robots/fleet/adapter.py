"""Adapter of one network to the calling side, in a file of its own each."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any, Protocol

from strands_robots.envelope import Envelope
from strands_robots.errors import RefusalError, UnreachableError
from strands_robots.safety.scope import EVERY_ROBOT, Remembers, Scope

if TYPE_CHECKING:
    from strands_robots.safety.answers import OnProgress, Press, StopReport
    from strands_robots.safety.lockout import Lockout
    from strands_robots.safety.network_key import NetworkKey
    from strands_robots.safety.roster import OnReport, Sending
    from strands_robots.safety.stop_roster import StopOutcome
    from strands_robots.serving.advertised import AdvertisedVerb

SOURCE = "strands-robots"
"""Name of the command line and of ``connect()``, where none is given."""

TOOL = "robot-mesh-tool"
"""Name of the agent's tool and of commands on the mesh; an allowlist of a robot must include it."""


TOO_MANY = "more stops than it can keep apart; resume --local at its own machine"


@dataclass(frozen=True, slots=True)
class LockoutReport:
    """Lockouts and status of one robot; ``problem`` is empty if it reports them.

    ``at`` is the time of the report in monotonic seconds.
    """

    name: str
    lockouts: tuple[Lockout, ...] = ()
    problem: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict, repr=False)
    round_trip_ms: float = 0.0
    at: float = field(default_factory=time.monotonic)


Resumed = tuple[bool, str]
"""Whether a robot is free now, and what it said."""


logger = logging.getLogger(__name__)

DEVICE_CONNECT, MESH = "device_connect", "mesh"

FIND_S = 2.0
"""Seconds at most in which robots are looked for."""

CLOSED = "the fleet was closed before it answered"
"""Reason of a call that the end of its network ends, or that comes later."""

STOP_S = 5.0
"""Seconds in which a robot has to answer a stop."""


class NetworkBusyError(UnreachableError):
    """Something takes connections there and has not answered in time."""


@dataclass(frozen=True, slots=True)
class FoundRobot:
    """A robot as its network announces it; the texts are plain and short.

    Attributes:
        must_answer: it can be stopped, so that a stop expects its answer.
        world: id of the world that it is a part of, and stops with; empty for none.
        status: what it says it is doing.
        age_s: seconds since its last own message; None where only a registry names it.
        locked: whether an emergency stop locks it, as it says; not proven. None where it says nothing.
        facts: all that its network knows of it, for programs.
        functions: as they came over the wire; None where it has not told them.
    """

    id: str
    type: str = ""
    model: str = ""
    tags: tuple[str, ...] = ()
    must_answer: bool = False
    world: str = ""
    status: str = ""
    age_s: float | None = None
    locked: bool | None = None
    facts: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)
    functions: object = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Place:
    """Place where the robots of a network are looked for.

    Attributes:
        text: one sentence on it.
        local: all robots are known to be on this machine.
        meeting_port: the loopback port where they meet; None where it is not known.
    """

    text: str
    local: bool = False
    meeting_port: int | None = None


@dataclass(frozen=True, slots=True)
class ReceivedCall:
    """A call as its robot receives it, which is what an operator approves.

    Attributes:
        caller: the caller's name on the network.
        verb: its name on the network.
        arguments: without those of the lease.
    """

    caller: str
    verb: str
    arguments: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class RobotEvent:
    """An event of a robot, as it arrived. The robot is the one that the topic names.

    What it says of the robot is read by its network, in the same shape for all of them.

    Attributes:
        joints: positions by name, not yet checked; None where it has none.
        part: the robot of a world that they belong to.
        task: what the robot does, as :func:`~strands_robots.fleet.reports.task_of` returns it.
        load: of the robot's host, 1 for all of its cores.
        frequent: one of many of its kind, which report a state.
        alive: False where a broker may have kept it, so that it proves no life.
        picture: a JPEG of the camera that ``part`` names.
    """

    robot: str
    name: str
    payload: Mapping[str, Any]
    joints: Mapping[str, Any] | None = field(default=None, repr=False, compare=False)
    part: str = field(default="", repr=False, compare=False)
    task: Mapping[str, Any] | None = field(default=None, repr=False, compare=False)
    load: float | None = field(default=None, repr=False, compare=False)
    frequent: bool = field(default=False, repr=False, compare=False)
    alive: bool = field(default=True, repr=False, compare=False)
    picture: bytes | None = field(default=None, repr=False, compare=False)


EVERY = "*"
"""Every robot of a network, where one is followed."""


class Detail(Enum):
    """Messages of a robot that are followed, where its network tells them apart."""

    EVENTS = "its events"
    STATES = "its states besides"
    ALL = "its pictures besides, and the stops and resumes of the fleet"


OnEvent = Callable[[RobotEvent], None]
"""Takes an event on a thread of the network: it returns at once and does not raise."""


def _new_epoch() -> str:
    from strands_robots.safety.orders import new_epoch  # noqa: PLC0415 - a stop alone needs it

    return new_epoch()


@dataclass(frozen=True, slots=True)
class StopRequest:
    """An emergency stop, as its caller asks for it.

    Attributes:
        reason: sent to the robots.
        scope: the robots that it is for. Where none of them is there, every robot is stopped.
        signing_key: an Ed25519 private key that signs it; then only enrolled robots can confirm it.
        estop_id: 32 hex digits, the epoch of the lockout; a fresh one by default.
        named: robots that must answer; a network that looks for robots then looks for no further ones.
        deadline_s: seconds until silence is silence; by default, and where it has its own, the network's.
        remembers: says whether a robot of ``scope`` is known; by default by the network's roster.
        on_progress: called with the answers so far, where the network tells them; it returns at once.
    """

    reason: str = ""
    scope: Scope = EVERY_ROBOT
    signing_key: Any = None
    estop_id: str = field(default_factory=_new_epoch)
    named: Collection[str] = ()
    deadline_s: float | None = None
    remembers: Remembers | None = None
    on_progress: OnProgress = lambda progress: None


class StopSender(Protocol):
    """Sender of emergency stops on one network, such as a ``SafetyController``."""

    @property
    def controller_id(self) -> str:
        """The source that robots see."""

    @property
    def network(self) -> NetworkKey | None:
        """The network of its stops, whose roster must answer; None where it is not known."""

    @property
    def link_up(self) -> bool:
        """True while a stop would leave at once."""

    @property
    def sending(self) -> Sending:
        """The way its stops leave."""

    def press(self, estop_id: str) -> Press:
        """Note the moment of a press, once."""

    def check_in_every(self, interval_s: float) -> None:
        """Check in with the robots that need a live controller."""

    def stop(
        self,
        expected: Collection[str] = (),
        reason: str = "",
        *,
        estop_id: str = "",
        more: bool = False,
        on_progress: OnProgress = lambda progress: None,
        on_report: OnReport = lambda report: None,
        scope: Scope = EVERY_ROBOT,
    ) -> StopReport:
        """Stop every robot, or those of ``scope``, and wait for answers."""

    def expect(self, estop_id: str, names: Collection[str], *, more: bool = False) -> bool:
        """Name further robots that must answer; False when the stop is over."""

    def review(self, report: StopReport) -> StopReport:
        """Return the report with what came since."""


class NetworkAdapter(Protocol):
    """Robots of one network, as the calling side finds, calls and stops them.

    Attributes:
        name: :data:`DEVICE_CONNECT` or :data:`MESH`.
        has_stop_link: emergency stops leave on a connection of their own, so that they need no :meth:`open`.
        tells_absence: a stop of a robot that is not there is answered at once, so that silence is that of a robot.
        announces_verbs: robots announce their verbs, so that :meth:`describe` asks no one.
        reads: the names on this network of the reads ``status``, ``state`` and ``features``.
        starts: the name on this network of the verb that starts a task.
    """

    name: str
    has_stop_link: bool
    tells_absence: bool
    announces_verbs: bool
    reads: Mapping[str, str]
    starts: str

    @property
    def place(self) -> Place:
        """The place where robots are looked for."""

    def open(self) -> None:
        """Join the network.

        Raises:
            UnreachableError: it cannot be reached; :class:`NetworkBusyError` where it may be reached later.
        """

    def find(self, timeout: float | None = FIND_S, *, peers: bool = False) -> list[FoundRobot]:
        """Return the robots in reach.

        Args:
            timeout: seconds at most; None for as long as this network takes to know them.
            peers: peers without a robot, too, for which all of the time is waited.
        """

    def known(self, robot: str) -> FoundRobot:
        """Return what is known of a robot; asks no one."""

    def announced(self) -> Collection[str]:
        """Return robots that have announced themselves; asks no one.

        At least those since the last :meth:`find`.
        """

    def bears(self, robot: str) -> bool:
        """Return whether a robot of this id is known here; asks no one."""

    def reaches(self, robot: str) -> bool:
        """Return whether a robot of this id is in reach, once that can be known.

        It may be asked.

        Raises:
            RefusalError: the network does not carry the question.
        """

    def session(self, robot: str) -> object:
        """Return what differs once another robot may answer to this id; asks no one."""

    def enrolled_key(self, robot: str) -> bytes | None:
        """Return the public key that is enrolled for this id; None for none."""

    def announced_functions(self, robot: str) -> object:
        """Return the functions that a robot's announcement tells; asks no one."""

    def describe(self, robot: str, *, anew: bool = False) -> object:
        """Return the robot's functions as they came over the wire.

        ``anew`` asks the robot itself; what is known is returned where it does not answer.

        Raises:
            RefusalError: it is not known, and does not answer.
        """

    def describe_each(self, robots: Iterable[str]) -> Mapping[str, object]:
        """Return the functions of many robots, within a second; none of unknown ones."""

    def verb(self, robot: str, name: str) -> AdvertisedVerb | None:
        """Return a verb as its robot describes it.

        None where it does not describe it in time, and for what takes energy away: a stop waits for no description.

        Raises:
            NoSuchRobotError: no robot in reach has this id.
        """

    def call(self, robot: str, verb: str, arguments: Mapping[str, Any], timeout: float) -> Envelope:
        """Call a verb and return the answer, also one of status error.

        Raises:
            RefusalError: the call got no answer, or was refused as such; ``envelope`` is empty where it was not sent.
        """

    def stop(
        self, robot: str, timeout: float = STOP_S, robot_name: str = "", *, insist: bool = False
    ) -> Envelope | None:
        """Stop a robot and return its answer, None where it is not on this network.

        It is sent whether or not the robot is known. No answer in time is an envelope with ``stopped`` None, whose
        ``in_reach`` is False where no robot took the stop.

        Args:
            robot: its id.
            timeout: seconds in which it has to answer.
            robot_name: stops one robot of a world alone.
            insist: the robot is on no other network. Its answer is waited for all the time, and None is never returned.
        """

    def received(self, robot: str, verb: str, arguments: Mapping[str, Any]) -> ReceivedCall:
        """Return a call as the robot receives it; asks no one.

        Raises:
            RefusalError: it would refuse the arguments.
        """

    async def call_async(self, robot: str, verb: str, arguments: Mapping[str, Any], within: float) -> Envelope:
        """Call a verb from an event loop; raises as :meth:`call`."""

    async def describe_async(self, robot: str, within: float) -> FoundRobot:
        """Return a robot with its functions, as it describes itself now.

        Raises:
            RefusalError: it is not known, or does not answer.
        """

    async def stop_async(self, robot: str, within: float = STOP_S, robot_name: str = "") -> Envelope:
        """Stop a robot, or one of a world, from an event loop; never raises.

        It waits for no other call.

        It is sent whether or not the robot is known. Without an answer ``stopped`` is None, and ``in_reach`` False
        where no robot took it.
        """

    @property
    def key(self) -> NetworkKey:
        """The name of this network, under which its robots are remembered."""

    @property
    def stale(self) -> str:
        """Reason why the last search may have missed robots, or ""."""

    def stop_all(self, timeout: float = STOP_S) -> tuple[dict[str, Envelope], StopOutcome]:
        """Stop every robot in reach, without a lockout.

        Returns:
            The answers by id, and the outcome measured by the roster.
        """

    def emergency_stop(self, request: StopRequest) -> StopOutcome:
        """Stop and lock the robots of a request; return the outcome.

        The outcome is recorded. A stop that did not leave is an outcome, too.
        """

    def verdict(self, outcome: StopOutcome) -> Envelope:
        """Return the outcome of an emergency stop as one answer."""

    def standing(self, signing_key: Any, known: Callable[[], Collection[str]]) -> AbstractContextManager[StopSender]:
        """Return a controller that stands for the length of the block.

        It reports whom it misses after the stops of others. It needs no :meth:`open` where its stops leave on a
        connection of their own.

        Args:
            signing_key: signs its stops and check-ins, or None.
            known: returns the robots that it shows besides its roster.
        """

    def beats(self, robots: Iterable[str]) -> Mapping[str, float | None]:
        """Return the monotonic time of each robot's last beat, None without one."""

    def lockable(self, timeout: float = FIND_S) -> list[str]:
        """Return the robots in reach that can be locked and resumed."""

    def lockouts(self, robots: Iterable[str], timeout: float, *, signed: bool = False) -> list[LockoutReport]:
        """Ask each robot for its lockouts, many at once.

        An enrolled robot whose answer is not its own has a ``problem``.

        Args:
            robots: their ids.
            timeout: seconds in which each has to answer.
            signed: ask every robot to sign its answer, so that its key is known.

        Raises:
            KeyFileError: the enrolled keys cannot be used.
        """

    async def lockout_async(self, robot: str, within: float) -> LockoutReport:
        """Ask one robot for its lockouts from an event loop.

        Every failure is a ``problem``.
        """

    def resume(self, reports: Sequence[LockoutReport], signer: Any, timeout: float) -> dict[str, Resumed]:
        """Clear every lockout of these reports; return each robot's outcome.

        Args:
            reports: as :meth:`lockouts` gives them.
            signer: the operator's Ed25519 key.
            timeout: seconds in which each robot has to answer.
        """

    def beats_every(self, robot: str) -> float:
        """Return the seconds between two beats of a robot."""

    def subscribe(self, robot: str, on_event: OnEvent, detail: Detail = Detail.EVENTS) -> Callable[[], None]:
        """Receive the robot's events; return what ends it, which never fails.

        Args:
            robot: an id, or :data:`EVERY` for all robots: then also their states and signs of life.
            on_event: takes each event.
            detail: the messages that are events.
        """

    def close(self) -> None:
        """Leave the network; a second call does nothing."""


MISSED_BEATS = 3
"""Beats after which a robot that has left one network counts as gone from another one, too."""


def bears(network: NetworkAdapter, robot: str) -> bool:
    """Return whether a network has a robot now; False for a network that was left."""
    try:
        return network.bears(robot)
    except RefusalError:
        return False


def reaches(network: NetworkAdapter, robot: str) -> bool:
    """Return whether a robot is in reach, which may be asked."""
    try:
        return network.reaches(robot)
    except RefusalError as exc:
        logger.debug("%s: %s cannot be looked for: %s", network.name, robot, exc)
        return False


def silent(network: NetworkAdapter, robot: str) -> bool:
    """Return whether a robot has missed its last beats on a network."""
    try:
        last = network.beats([robot]).get(robot)
        return last is not None and time.monotonic() - last > MISSED_BEATS * network.beats_every(robot)
    except RefusalError:
        return True
