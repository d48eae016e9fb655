"""Bench of one robot, which is served on both networks of this process.

Its ports are used by nothing else. The user's settings do not count meanwhile, and state is kept in a directory that
is removed. Nothing leaves the machine.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial, wraps
from typing import Any, Self, TypeVar

from strands_robots.adapted import behind_contract
from strands_robots.contract import holds_robots, robots_in
from strands_robots.device_connect import init_device_connect_sync, stop_device_connect
from strands_robots.device_connect.backends.config import loopback_config
from strands_robots.envelope import text_of
from strands_robots.errors import NoAnswerError, RefusalError, RobotError, StrandsRobotsError, UnreachableError
from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.device_connect.network import DeviceConnectNetwork
from strands_robots.fleet.fleet import Fleet
from strands_robots.fleet.mesh.network import MeshNetwork
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.remote_robot import RemoteRobot
from strands_robots.fleet.reports import runs as says_it_runs
from strands_robots.fleet.verdicts import FleetVerdict
from strands_robots.mesh import init_mesh
from strands_robots.safety.estop_listener import estop_listener
from strands_robots.safety.plane import plane
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.advertised import RESUMES, AdvertisedParameter, AdvertisedVerb
from strands_robots.testing.private_network import private_network
from strands_robots.testing.raised import RaisedExceptions
from strands_robots.testing.subject import LongMotion, Subject

T = TypeVar("T")

PEER = "conform-robot"
CALLER = "conform"
ANSWER_S = 10.0
"""Seconds in which a read, a refusal or a start has to be answered."""

LASTS_MAX_S = 60.0
"""Seconds that a check waits for a read that declares more."""

_EVERY_S = 0.005

TASKS = ("execute", "start")
"""Verbs that start a task, on Device Connect and on the mesh."""

OPEN_GATES = {
    **dict.fromkeys(("DEVICE_CONNECT_RPC_ALLOW", "DEVICE_CONNECT_ESTOP_ALLOW"), "*"),
    **dict.fromkeys(("BYPASS_TOOL_CONSENT", "STRANDS_ALLOW_MOCK"), "true"),
}
"""Settings with which any caller may move it."""

OF_A_MOTION = frozenset({"wait"})
"""Reads that are refused while no motion runs."""

TASK = {"instruction": "wave", "policy_provider": "mock", "duration": 30.0}


class NotKeptError(StrandsRobotsError, AssertionError):
    """A promise that is not kept; the text says what happened."""


class NotProvenError(StrandsRobotsError):
    """A promise that cannot be checked on this robot; the text says what is missing."""


class DriftError(NotKeptError):
    """The robot does something other than what it declares."""


def within(seconds: float, call: Callable[[], T], what: str) -> T:
    """Return what ``call`` returns, on a thread of its own.

    A robot may hang in it for ever.

    Raises:
        NotKeptError: no answer in time.
        Exception: what the call raises.
    """
    answer: list[T] = []
    raised: list[BaseException] = []

    def work() -> None:
        try:
            answer.append(call())
        except BaseException as exc:  # noqa: BLE001 - it is raised on the thread that waits
            raised.append(exc)

    thread = threading.Thread(target=work, name="conform call", daemon=True)
    thread.start()
    thread.join(seconds)
    if raised:
        raise raised[0]
    if not answer:
        raise NotKeptError(f"{what} gave no answer within {seconds:g} s")
    return answer[0]


class NetworkBench:
    """A robot as its callers have it, on each network.

    Attributes:
        subject: limits, exemptions and the motion of its checks.
        on: the robot by network.
        poll_s: seconds between two looks whether it moves.
        raised: exceptions of a robot of this process.
    """

    poll_s = _EVERY_S

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.on: dict[str, RemoteRobot] = {}
        self.raised = RaisedExceptions()

    @property
    def remote(self) -> RemoteRobot:
        """The robot on its first network, Device Connect where it is there."""
        return next(iter(self.on.values()))

    def motions(self, network: str = "") -> list[AdvertisedVerb]:
        """Return its verbs that may move it, on a network; by default on the first one.

        One that changes something and moves nothing is none.
        """
        robot = self.on[network] if network else self.remote
        verbs = (each for each in robot.verbs.values() if each.name not in RESUMES)
        return [each for each in verbs if each.kind == "motion" and not each.changes]

    def plain_reads(self, network: str) -> list[AdvertisedVerb]:
        """Return its reads on a network that need neither an argument nor a motion."""
        verbs = [each for each in self.on[network].verbs.values() if each.name not in OF_A_MOTION]
        return [each for each in verbs if each.reads and not any(named.required for named in each.parameters)]

    def answer_s(self, verb: AdvertisedVerb) -> float:
        """Return the seconds in which a read has to be answered, its ``lasts`` included."""
        return self.subject.answer_s + min(verb.lasts_s, LASTS_MAX_S)

    def arguments(self, verb: AdvertisedVerb) -> dict[str, Any]:
        """Return valid arguments of a motion, the subject's where it gives some."""
        given = self.subject.motion
        if given is not None and given.verb == verb.name:
            return dict(given.arguments)
        if verb.name in TASKS:
            return dict(TASK)
        return {each.name: usual_value(each) for each in verb.parameters if each.required}

    @property
    def writes(self) -> int:
        """Writes of its bus so far; 0 without a recorder."""
        return 0 if self.subject.recorder is None else self.subject.recorder.count

    def halt(self, reason: str = "conformance") -> StopVerdict:
        """Halt it over its networks."""
        return self.remote.halt(reason)

    def settle(self) -> None:
        """Do what a motion needs once it was halted and its call is over."""

    def rest(self) -> None:
        """Have it stand still, for the next check."""
        self.halt("the check is over")

    def runs(self) -> bool:
        """Return True while its status says that it moves."""
        return says_it_runs(self.remote.status())

    @property
    def motion(self) -> LongMotion:
        """The motion that is stopped.

        Raises:
            NotProvenError: it has none that is known to last.
        """
        return self.subject.motion or usual_motion(self)

    @contextmanager
    def moving(self, motion: LongMotion | None = None) -> Iterator[MotionRun]:
        """Have it move for the block, by a call on Device Connect, and halt it.

        Raises:
            NotProvenError: the motion ended before it could be stopped.
        """
        run = MotionRun(self, self.remote, motion or self.motion)
        try:
            run.start()
            yield run
        finally:
            # Of a robot that refused it, another caller's motion may be under way.
            if not run.refused:
                with suppress(NotKeptError):
                    self.halt("the motion of a check is over")
            run.join()
            if not run.refused:
                self.settle()


class ConformanceBench(NetworkBench):
    """A robot of a subject, served on both networks, and a caller on each.

    Args:
        subject: makes the robot.
    """

    def __init__(self, subject: Subject) -> None:
        super().__init__(subject)
        self._stack = ExitStack()
        self.body: Any = None
        self.fleets: dict[str, Fleet] = {}
        """A caller by network."""

        self.estops: list[str] = []
        """Ids of the emergency stops of the run."""

        self.halted_unlinked: StopVerdict | Exception = StopVerdict()
        """Verdict of a halt before it was on a network, or what that raised."""

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(private_network(self.subject.deadline_s, OPEN_GATES, log=self.raised))
            self.body = stack.enter_context(made(self.subject))
            try:
                self.halted_unlinked = self.halt()
            except Exception as exc:  # noqa: BLE001 - the check of it says so
                self.halted_unlinked = exc
            peer = init_mesh(self.body, PEER)
            if peer is not None:
                stack.callback(peer.close)
            runtime = init_device_connect_sync(self.body, peer_id=PEER, link=loopback_config())
            stack.callback(stop_device_connect, runtime)
            for network in (DeviceConnectNetwork(loopback_config(), CALLER), MeshNetwork(f"{CALLER}-mesh")):
                networks = Networks([network])
                self.fleets[network.name] = stack.enter_context(Fleet(networks))
                # Its id is known: there is no need to wait for others that may join.
                wait_for(partial(_described, network), ANSWER_S, "the robot on its network")
                self.on[network.name] = RemoteRobot(network.known(PEER), network, networks)
            wait_for(_estops_arrive, ANSWER_S, "its e-stop link")
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stack.__exit__(None, None, None)

    def estop(self, network: str = "") -> FleetVerdict:
        """Send an emergency stop to it, as a safety controller does.

        Args:
            network: over which; Device Connect by default.
        """
        verdict = self.fleets[network or next(iter(self.fleets))].estop("emergency stop of a check")
        self.estops.append(verdict.estop_id)
        return verdict

    def clear(self) -> None:
        """Free it, as an operator at this machine does."""
        plane().clear_local("conformance")

    def halt(self, reason: str = "conformance") -> StopVerdict:
        """Halt it by its own contract, within the deadline."""
        body = behind_contract(self.body)
        limit = self.subject.deadline_s + 1.0
        return within(limit, lambda: body.halt(reason), "halt")

    def rest(self) -> None:
        """Have it stand still and unlocked, for the next check."""
        with suppress(NotKeptError):
            self.halt("the check is over")
        self.clear()

    def runs(self) -> bool:
        """Return True while a task or a declared verb of it is under way."""
        return runs(self.body)

    def check_moves_again(self, after: str) -> None:
        """Have it move and halt within the time to answer.

        What was out of reach may take a while to be found again.

        Raises:
            NotKeptError: it does not move within the time to answer, or did not stop.
        """
        deadline, tries = time.monotonic() + self.subject.answer_s, 0
        while True:
            try:
                with self.moving():
                    return self.check_still(self.halt(), self.writes, f"halt after {after}")
            except NotProvenError as exc:
                tries += 1
                # A motion that began on the old link ends with it, and takes all of the time to answer.
                if tries > 1 and time.monotonic() >= deadline:
                    raise NotKeptError(f"after {after}, it does not move again: {exc}") from exc
            time.sleep(_EVERY_S)

    def check_still(self, verdict: StopVerdict, count: int, how: str) -> None:
        """Check a verdict against the bus: stopped, and no write after ``count``.

        Raises:
            NotKeptError: it did not stop, or wrote after the verdict.
        """
        check_stopped(verdict, how)
        self.check_no_write(count, how)

    @contextmanager
    def halts_noted(self) -> Iterator[list[HaltCall]]:
        """Note the calls of the robot's halts, from every transport, for the block."""
        calls: list[HaltCall] = []
        with ExitStack() as stack:
            own = [name for name in HALTS if callable(getattr(self.body, name, None))]
            # One that halts on the stop executor's thread writes there, whoever waits for it.
            for name in own[:1] if own[:1] == ["halt_here"] else own:
                stack.enter_context(put(self.body, name, _noted(getattr(self.body, name), calls)))
            yield calls

    def wait_for_fault(self) -> None:
        """Wait until something has met the fault, at most ``watch_s``."""
        ends = time.monotonic() + self.subject.watch_s
        while self.subject.recorder and not self.subject.recorder.fault_met and time.monotonic() < ends:
            time.sleep(_EVERY_S)

    def check_fault_met(self, how: str) -> None:
        """Check that something on the bus met its fault.

        Raises:
            NotProvenError: nothing did.
        """
        if self.subject.recorder and not self.subject.recorder.fault_met:
            raise NotProvenError(
                f"nothing met the bus that {how}: call recorder.fail() before each line that the device answers, the "
                "stop's too (docs/your-robot.md, The bus and its recorder)"
            )

    def check_no_write(self, count: int, how: str, halts: Sequence[HaltCall] = ()) -> None:
        """Check that nothing is written after ``count`` for the subject's ``watch_s``.

        Args:
            count: writes until the verdict.
            how: it was stopped, for the error.
            halts: calls of halts, in which a robot on a bus is frozen, which is a write.

        Raises:
            NotKeptError: a write followed.
        """
        recorder = self.subject.recorder
        if recorder is None:
            return
        verdict_at = time.monotonic()
        while time.monotonic() - verdict_at < self.subject.watch_s:
            if late := [each for each in recorder.since(count) if not any(call.had(each.at) for call in halts)]:
                after_ms = max(0.0, (late[0].at - verdict_at) * 1000)
                raise NotKeptError(f"{how}: {late[0].what or 'a write'} {after_ms:.0f} ms after the verdict")
            time.sleep(_EVERY_S)
        if self.subject.moving is not None and self.subject.moving():
            after_ms = (time.monotonic() - verdict_at) * 1000
            raise NotKeptError(f"{how}: its motor moves {after_ms:.0f} ms after the verdict")


HALTS = ("halt_here", "halt", "stop_task")
"""Methods by which a stop halts a robot."""


@dataclass(slots=True)
class HaltCall:
    """One call of a robot's halt, in monotonic s; without an end while it runs."""

    began: float
    ended: float = math.inf

    def had(self, moment: float) -> bool:
        """Return True for a moment in it."""
        return self.began <= moment <= self.ended


def _noted(method: Callable[..., T], calls: list[HaltCall]) -> Callable[..., T]:
    @wraps(method)
    def noted(*values: Any, **named: Any) -> T:
        call = HaltCall(time.monotonic())
        calls.append(call)
        try:
            return method(*values, **named)
        finally:
            call.ended = time.monotonic()

    return noted


@contextmanager
def put(body: object, name: str, method: Callable[..., Any]) -> Iterator[None]:
    """Have an object another method for the block."""
    own = vars(body).get(name)
    setattr(body, name, method)
    try:
        yield
    finally:
        if own is None:
            delattr(body, name)
        else:
            setattr(body, name, own)


class MotionRun:
    """A motion under way, called over a network on a thread of its own."""

    def __init__(self, bench: NetworkBench, robot: RemoteRobot, motion: LongMotion) -> None:
        self._bench, self._robot, self.motion = bench, robot, motion
        self.answer: dict[str, Any] | RefusalError | None = None
        self._thread = threading.Thread(target=self._call, name="conform motion", daemon=True)

    def start(self) -> None:
        """Start it and wait until the robot moves."""
        before = self._bench.writes
        self._thread.start()
        deadline = time.monotonic() + self._bench.subject.answer_s
        while time.monotonic() < deadline:
            if isinstance(self.answer, RefusalError):
                raise NotProvenError(f"{self.motion.verb} was refused: {self.answer}")
            over = self.over and self._returns_at_its_end
            # A task that is refused while it begins may have held the robot, which is a write, too.
            begun = self.motion.verb not in TASKS or self.over
            moved = self._bench.writes > before if self._bench.subject.recorder else self._bench.runs()
            if begun and moved and not isinstance(self.answer, RefusalError):
                return
            if over:
                raise NotProvenError(
                    f"{self.motion.verb} ended before it moved the robot: {self._said} Give Subject(motion=...) "
                    "that moves it from wherever it stands"
                )
            time.sleep(self._bench.poll_s)
        if self._bench.subject.recorder is not None and self._bench.runs():
            look = "is recorder.wrote() called where the motor is written?"
            raise NotProvenError(f"{self.motion.verb} runs, and the recorder saw no write: {look}")
        raise NotProvenError(f"{self.motion.verb} did not move the robot within {self._bench.subject.answer_s:g} s")

    @property
    def refused(self) -> bool:
        """True where the robot refused to begin it."""
        unknown = RobotError, NoAnswerError, UnreachableError
        return isinstance(self.answer, RefusalError) and not isinstance(self.answer, unknown)

    @property
    def over(self) -> bool:
        """True once its call was answered."""
        return not self._thread.is_alive()

    def join(self) -> None:
        """Wait for the answer of its call."""
        self._thread.join(self._bench.subject.answer_s)

    @property
    def _returns_at_its_end(self) -> bool:
        """True for a verb of the robot's own; a task was started when its call returns."""
        verb = self._robot.verbs.get(self.motion.verb)
        return verb is not None and verb.own

    @property
    def _said(self) -> str:
        return text_of(self.answer) if isinstance(self.answer, dict) else "it gave no answer"

    def _call(self) -> None:
        try:
            self.answer = self._robot.call(self.motion.verb, timeout=60.0, **self.motion.arguments)
        except RefusalError as exc:
            self.answer = exc


@contextmanager
def made(subject: Subject) -> Iterator[Any]:
    """Yield a robot of the subject, and let go of it."""
    body = subject.make()
    try:
        yield body
    finally:
        cleanup = getattr(body, "cleanup", None)
        if callable(cleanup):
            with suppress(NotKeptError):
                within(ANSWER_S, cleanup, "cleanup")


def check_stopped(verdict: StopVerdict, how: str) -> None:
    """Check that a verdict says stopped.

    Raises:
        NotKeptError: it says anything else.
    """
    if verdict.stopped is not True:
        raise NotKeptError(f"{how}: {text_of(verdict.envelope())}")


def usual_motion(bench: NetworkBench) -> LongMotion:
    """Return a task of the policy mock, or the first declared motion.

    Raises:
        NotProvenError: there is none whose arguments are known.
    """
    verbs = {each.name: each for each in bench.motions()}
    for name in TASKS:
        if name in verbs:
            return LongMotion(name, TASK)
    for verb in verbs.values():
        if not verb.own:
            continue
        arguments = bench.arguments(verb)
        if None not in arguments.values():
            return LongMotion(verb.name, arguments)
    raise NotProvenError("the robot declares no motion with known arguments; give the subject a motion")


def usual_value(parameter: AdvertisedParameter) -> Any:
    """Return a valid value of a parameter, the largest one; None for none known."""
    if parameter.choices:
        return parameter.choices[0]
    if parameter.type in ("integer", "number"):
        value = next((each for each in (parameter.high, parameter.default, parameter.low) if each is not None), 1)
        return int(value) if parameter.type == "integer" else float(value)
    return {"string": "conformance", "boolean": True, "array": [], "object": {}}.get(parameter.type)


def runs(body: Any) -> bool:
    """Return True while a task or a declared verb of the robot is under way."""
    robot = behind_contract(body)
    if robot.gate.under_way:
        return True
    if holds_robots(robot):
        return any(robot.list_policies_running()) and bool(robots_in(robot))
    status = getattr(robot, "get_task_status", None)
    answer = within(ANSWER_S, status, "get_task_status") if callable(status) else {}
    return isinstance(answer, Mapping) and str(answer.get("task_status", "")).lower() == "running"


def wait_for(condition: Callable[[], T | None], seconds: float, what: str) -> T:
    """Return the first truthy value of a condition.

    Raises:
        NotKeptError: the time is over.
    """
    deadline = time.monotonic() + seconds
    while not (value := condition()):
        if time.monotonic() >= deadline:
            raise NotKeptError(f"{what} was not there within {seconds:g} s")
        time.sleep(_EVERY_S)
    return value


def _described(network: NetworkAdapter) -> bool:
    try:
        return network.describe(PEER, anew=True) is not None and network.bears(PEER)
    except RefusalError:
        return False


def _estops_arrive() -> bool:
    return all(each.link.up for each in estop_listener().registrations)
