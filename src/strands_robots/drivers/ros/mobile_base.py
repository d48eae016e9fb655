"""Contract of a mobile base on a ROS graph, whatever link leads to it."""

from __future__ import annotations

import functools
import hashlib
import inspect
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ParamSpec, TypeVar

from strands_robots import settings
from strands_robots.contract import Observer, Unsubscribe, for_request
from strands_robots.drivers.ros.motion import COUNT_MAX, BaseMotion, Drive, DriveOrder, messages_for
from strands_robots.drivers.ros.velocity import CurrentHold, OdometryMonitor, VelocityPublisher, ZeroVelocityHold
from strands_robots.envelope import Envelope, error, success
from strands_robots.policies.rollout import RolloutObservers
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.link import RosError, RosLink, bare_kind, graph_name, interface
from strands_robots.safety.gate import MotionGate, MotionRefused, MotionRequest, Permit
from strands_robots.safety.stop_targets import halted_with_verbs
from strands_robots.safety.stopping import PendingVerdict, StopVerdict, halts_in_parts
from strands_robots.stop_log import stop_logger
from strands_robots.utils import MissingExtraError, ValidationError, identifier, number, shown, whole

logger = stop_logger(__name__)

TWIST = "geometry_msgs/msg/Twist"
ANSWER_SHARE = 0.9
"""Part of the halt deadline that a halt waits for stillness; the rest is for its verdict to arrive in time."""

LOOK_S = 0.005
"""Seconds between two looks at a base that is to come to rest."""

LINK_ERRORS = (RosError, MissingExtraError)
NO_POLICIES = "{} is a mobile base and runs no policies; use drive."

TOOL_SUFFIX_MAX = 55
"""Longest robot name in a tool's name, which model APIs limit to 64 characters: the longest verb takes nine."""

_HASHED = 8

AgentVerb = tuple[Callable[..., Envelope], str]
_Motion = TypeVar("_Motion", bound=BaseMotion)
_P = ParamSpec("_P")

LINK_METHODS = ("publish", "read", "call", "watch", "close")
"""Methods of a :class:`RosLink`, all of which a base's link has."""


def tool_suffix(node_name: str) -> str:
    """Return the robot's unique part of a tool's name that model APIs accept."""
    plain = node_name.replace(".", "_")
    if plain == node_name and len(plain) <= TOOL_SUFFIX_MAX:
        return plain
    digest = hashlib.sha256(node_name.encode()).hexdigest()[:_HASHED]
    return f"{plain[: TOOL_SUFFIX_MAX - _HASHED - 1]}_{digest}"


def _checked_link(link: object) -> Any:
    if isinstance(link, str):
        # The order of strands-robots 0.5: node_name, cmd_vel_topic, transport.
        raise _no_link(link)
    missing = [name for name in LINK_METHODS if not callable(getattr(link, name, None))]
    if missing:
        raise ValidationError(
            f"link must be a link of strands_robots.ros.link, and {type(link).__name__} has no {', '.join(missing)}."
        )
    return link


def _no_link(link: object) -> ValidationError:
    return ValidationError(
        f"link must be a link of strands_robots.ros.link, not {shown(link)}: give MobileBaseRobot its "
        "node_name, link and command_topic in this order."
    )


def _without_transport(init: Callable[_P, None]) -> Callable[_P, None]:
    """Refuse the keywords of strands-robots 0.5 as its positions are refused."""

    @functools.wraps(init)
    def checked(*args: _P.args, **kwargs: _P.kwargs) -> None:
        if "transport" in kwargs or "cmd_vel_topic" in kwargs:
            raise _no_link(kwargs.get("cmd_vel_topic", kwargs.get("transport")))
        init(*args, **kwargs)

    return checked


class MobileBaseRobot:
    """A base that is driven by velocities. Thread-safe; one drive at a time.

    A drive is checked in this order, before any side effect: velocities; ``duration``, else ``count``; the limits;
    the lockout; the operator's approval of the velocity topic; the handshake that arms the vehicle. Then it is
    clamped and sent. Every timed or repeated drive that is not zero ends with one zero. :meth:`stop`, that zero and
    the zeros of a halt need no approval.

    Args:
        node_name: name of the robot and of its tools, an identifier.
        link: the link to the graph.
        command_topic: the velocity topic, of ``command_type``.
        odom_topic: odometry or pose; with it, a stop waits to see the base still.
        publish_rate: Hz of a timed or repeated drive, above 0.
        max_linear: clamp in m/s, above 0; None: this platform declares no limit. ``max_angular`` in rad/s likewise.
        max_duration: longest drive in seconds, above 0; a longer one is refused.
        command_gate: asks the operator; that of the settings by default.

    Raises:
        ValidationError: an argument outside its domain.
    """

    takes_tasks = False
    """It follows no policy: :meth:`start_task` refuses."""

    @_without_transport
    def __init__(
        self,
        node_name: str,
        link: RosLink,
        command_topic: str,
        command_type: str = TWIST,
        *,
        odom_topic: str | None = None,
        odom_type: str | None = None,
        scan_topic: str | None = None,
        scan_type: str | None = None,
        publish_rate: float = 10.0,
        max_linear: float | None = None,
        max_angular: float | None = None,
        max_duration: float | None = None,
        command_gate: CommandGate | None = None,
    ) -> None:
        self.tool_name_str = self.node_name = identifier("node_name", node_name)
        self.link = _checked_link(link)
        self._topic = graph_name("command_topic", command_topic)
        self._kind = interface("command_type", command_type)
        self._scan = (_optional(graph_name, "scan_topic", scan_topic), _optional(interface, "scan_type", scan_type))
        self._odom = (_optional(graph_name, "odom_topic", odom_topic), _optional(interface, "odom_type", odom_type))
        self.publish_rate = number("publish_rate", publish_rate, above=0)
        self.max_linear = None if max_linear is None else number("max_linear", max_linear, above=0)
        self.max_angular = None if max_angular is None else number("max_angular", max_angular, above=0)
        self.max_duration = None if max_duration is None else number("max_duration", max_duration, above=0)
        self.gate = MotionGate()
        self.command_gate = command_gate or CommandGate()
        self._odometry = OdometryMonitor(link, *self._odom)
        self._publisher = VelocityPublisher(link, self._topic, self._kind, self.command_message(0.0, 0.0))
        self._hold = CurrentHold(
            lambda ended: ZeroVelocityHold(self._publisher, self.publish_rate, self._still_now, self.node_name, ended),
            self._leave_again,
        )
        self._left = False
        self._observers = RolloutObservers()
        self._slot = threading.Lock()
        self._motion: BaseMotion | None = None
        self._latched = False
        self._driven = False

    # Overridden by a platform.

    def command_message(self, linear: float, angular: float) -> dict[str, Any]:
        """Return the message that commands these velocities, in m/s and rad/s."""
        twist = {
            "linear": {"x": linear, "y": 0.0, "z": 0.0},
            "angular": {"x": 0.0, "y": 0.0, "z": angular},
        }
        return {"twist": twist} if bare_kind(self._kind) == "geometry_msgs/TwistStamped" else twist

    def check_motion(self, linear: float, angular: float) -> None:
        """Raise :class:`ValidationError` where the platform cannot execute this motion."""

    def handshake(self, tool_context: Any = None, *, request: MotionRequest | None = None) -> Envelope | None:
        """Make the vehicle ready for commands of a request; return the error, or None."""
        return None

    def motion_note(self) -> str:
        """Return one sentence on how this platform moves, for agents."""
        return "It turns in place."

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the reads that this robot's topics allow, such as ``get_scan``."""
        return () if self._scan[0] is None else ("get_scan",)

    def agent_verbs(self) -> dict[str, AgentVerb]:
        """Return the method and the description of each agent tool, by verb."""
        name = self.node_name
        verbs: dict[str, AgentVerb] = {
            "drive": (
                self.start_drive,
                f"Drive {name} for some seconds; returns once it has begun. {self.motion_note()}",
            ),
            "stop": (self.stop, f"Stop {name} now; says whether it stands."),
            "status": (self.get_task_status, f"Whether {name} is driving, and how its last drive ended."),
        }
        if "get_scan" in self.reads:
            verbs["get_scan"] = (self.get_scan, f"Read one laser scan of {name}.")
        return verbs

    # Commands.

    def drive(
        self,
        linear: float = 0.0,
        angular: float = 0.0,
        duration: float | None = None,
        count: int = 1,
        tool_context: Any = None,
    ) -> Envelope:
        """Send velocities in m/s forwards and rad/s to the left, then return.

        With ``duration`` in seconds they are repeated for that long and a zero follows; else ``count`` messages are
        sent. A single message latches until :meth:`stop`, as a raw command does. Every refusal and failure is an
        error envelope, and nothing is sent for a refused drive.
        """
        drive = self._begin_drive(linear, angular, duration, count, tool_context)
        return self._run(drive) if isinstance(drive, Drive) else drive

    def start_drive(
        self,
        linear: float,
        angular: float,
        duration: float,
        tool_context: Any = None,
        *,
        request: MotionRequest | None = None,
    ) -> Envelope:
        """Start a timed drive; :meth:`get_task_status` and observers report its end.

        Args:
            linear: Speed forwards in m/s; negative reverses.
            angular: Turning rate in rad/s; positive turns left.
            duration: Seconds until the robot is stopped again, above 0.
            tool_context: Context of an agent's call, through which the operator is asked.
            request: What it begins for; made now by default.
        """
        try:
            seconds = number("duration", duration, above=0, high=self.max_duration)
        except ValidationError as refused:
            return error(str(refused))
        drive = self._begin_drive(linear, angular, seconds, 1, tool_context, request=request)
        if not isinstance(drive, Drive):
            return drive
        order = drive.order
        return self._run_in_background(drive) or success(
            f"Driving at {order.linear:g} m/s and {order.angular:g} rad/s for {seconds:g} s.",
            linear=order.linear,
            angular=order.angular,
            duration=seconds,
        )

    def stop(self, tool_context: Any = None) -> Envelope:
        """Send zeros until the base is still, without approval; return the verdict.

        Where odometry is silent this is an error with ``stopped`` None.
        """
        del tool_context
        return self.halt("stop").envelope()

    def halt_ordered(self) -> None:
        """Note whether it is driven; a drive whose permit is void counts as halted."""
        drive = self._motion
        self._driven |= self._latched or (isinstance(drive, Drive) and not drive.ended.is_set())

    @halts_in_parts
    def halt(self, reason: str = "") -> StopVerdict:
        """Void every permit, send zeros until the base is still, return the verdict.

        With odometry, stopped means that two samples after the first zero are still; a base that moves on did not
        stop, and one whose odometry is silent is unknown. Without odometry, stopped means that the link accepted the
        zero: nothing measures the rest. A zero that the link does not accept is a base that did not stop.
        """
        began = time.monotonic()
        deadline = began + ANSWER_SHARE * settings.number("STRANDS_HALT_DEADLINE_S")
        verdict = halted_with_verbs(self, lambda: self.halt_here(reason, deadline), deadline)
        return replace(verdict, elapsed_ms=(time.monotonic() - began) * 1000)

    def halt_here(self, reason: str, deadline: float) -> PendingVerdict:
        """Void every permit and begin to send zeros; leave the base's rest to be read."""
        self.halt_ordered()
        self.gate.revoke()
        self._odometry.expect_stillness()
        drive = self._motion if isinstance(self._motion, Drive) else None
        driven, self._driven = self._driven, False
        if drive is not None:
            drive.interrupt()
        return _BaseAtRest(
            self._hold.begin(), drive, odometry=self._odometry, driven=driven, until=deadline, then=self._halted
        )

    # Reads.

    def get_scan(self, timeout: float = 5.0) -> Envelope:
        """Return the next laser scan.

        Args:
            timeout: Seconds to wait for a sample, above 0.
        """
        return self._read("get_scan", "scan_topic", self._scan, timeout)

    @property
    def tools(self) -> list[Any]:
        """The robot's verbs as Strands agent tools, which need the [agent] extra.

        The ``drive`` tool needs a duration and returns at once, so that an agent can stop the drive that it began.
        """
        from strands_robots.agent_tool import strict, tool  # noqa: PLC0415 - strands is loaded when it is used

        suffix = tool_suffix(self.node_name)
        made = {
            verb: tool(name=f"{verb}_{suffix}", description=description, context=True)(_without_request(method))
            for verb, (method, description) in self.agent_verbs().items()
        }
        # A stop is refused for nothing, and a read ignores what it does not have.
        return [each if verb in ("stop", "status", *self.reads) else strict(each) for verb, each in made.items()]

    @property
    def holding(self) -> bool:
        """True while zeros still go out after a halt."""
        return self._hold.running

    # The robot contract, so that every network takes a base.

    def start_task(
        self, instruction: str, policy_provider: str = "mock", duration: float = 30.0, policy_port: int = 0
    ) -> Envelope:
        """Refuse: a base is driven, it follows no policy."""
        del instruction, policy_provider, duration, policy_port
        return error(NO_POLICIES.format(self.tool_name_str))

    def stop_task(self) -> Envelope:
        """Do the same as :meth:`stop`."""
        return self.stop()

    def get_task_status(self) -> Envelope:
        """Return ``task_status`` and the progress of the last motion."""
        if self._motion is None:
            return success("Idle.", task_status="idle", instruction="", step_count=0, duration=0.0)
        return self._motion.status()

    def get_features(self) -> Envelope:
        """Return ``observation_features``, ``action_features`` and ``limits``."""
        limits = {"linear": self.max_linear, "angular": self.max_angular, "duration": self.max_duration}
        return success(
            "A mobile base: linear in m/s, angular in rad/s.",
            observation_features=dict.fromkeys(self.reads, "message"),
            action_features={"linear": "float", "angular": "float"},
            limits=limits,
        )

    def get_state(self) -> Envelope:
        """Return ``joints`` (none), ``task`` and ``still``: True, False or None."""
        task = self.get_task_status()["task_status"]
        return success(f"{task}.", joints={}, task=task, still=self._odometry.still)

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Call ``observer`` when a motion begins and after its end."""
        return self._observers.subscribe(observer)

    def cleanup(self) -> Envelope:
        """Stop, then leave the graph unless the base may still move."""
        verdict = self.halt("cleanup")
        if verdict.stopped:
            self.disconnect()
        return verdict.envelope()

    def disconnect(self) -> None:
        """Leave the graph without a stop; :meth:`cleanup` stops the base first."""
        self.gate.revoke()
        self._hold.close()
        self._left = True
        self._leave()

    def _leave(self) -> None:
        try:
            self._odometry.close()
        except LINK_ERRORS as exc:
            logger.info("%s: %s", self.tool_name_str, exc)
        self.link.close()

    def _leave_again(self) -> None:
        """Leave the graph after the zeros of a stop that came when the base had left it."""
        if self._left:
            self._leave()

    # One motion at a time, for this class and its subclasses.

    def _begin(
        self,
        verb: str,
        target: tuple[str, str],
        tool_context: Any,
        make: Callable[[Permit], _Motion],
        request: MotionRequest | None = None,
    ) -> _Motion | Envelope:
        """Return a motion that may begin and has the base's one slot, or the refusal.

        Args:
            verb: name of the motion in refusals.
            target: name and type of the topic or action that the operator has to approve.
            tool_context: context of an agent's call, through which the operator is asked.
            make: makes the motion of its permit.
            request: what it begins for; made now by default.
        """
        if not self._slot.acquire(blocking=False):
            return error("The base is being driven; stop it first, or wait for its end.")
        motion = None
        try:
            permit = self.gate.permit(verb, request)
            refusal = self.command_gate.refusal(*target, verb, tool_context)
            # The operator may take minutes to answer: a stop meanwhile also ends the handshake, which would arm.
            refusal = refusal or for_request(permit.request, self.handshake)(tool_context)
            if refusal is not None:
                return refusal
            self._left = False
            self._odometry.start()
            self._hold.end_for(permit)
            motion = self._motion = make(permit)
        except MotionRefused as locked:
            return locked.envelope
        finally:
            if motion is None:
                self._slot.release()
        return motion

    def _run_in_background(self, motion: BaseMotion) -> Envelope | None:
        """Run on a thread; without one, undo :meth:`_begin` and return the error."""
        name = f"{motion.policy}-{self.node_name}"
        try:
            threading.Thread(target=self._run, args=(motion,), name=name, daemon=True).start()
        except RuntimeError as exc:
            answer = motion.fail_to_begin(str(exc))
            self._slot.release()
            motion.ended.set()
            self._hold.resume()
            return answer
        return None

    def _run(self, motion: BaseMotion) -> Envelope:
        self._observers.notify(motion.event("started", self.tool_name_str))
        try:
            return motion.run()
        finally:
            if isinstance(motion, Drive):
                self._latched = motion.latched
            # The slot is released first: a caller that waits for the end may start the next motion at once.
            self._slot.release()
            motion.ended.set()
            self._observers.notify(motion.event("finished", self.tool_name_str))

    def _begin_drive(
        self,
        linear: object,
        angular: object,
        duration: object,
        count: object,
        tool_context: Any,
        *,
        request: MotionRequest | None = None,
    ) -> Drive | Envelope:
        try:
            order = self._checked(linear, angular, duration, count)
        except ValidationError as refused:
            return error(str(refused))
        target = (self._topic, self._kind)
        return self._begin("drive", target, tool_context, lambda permit: Drive(order, self._publisher, permit), request)

    def _checked(self, linear: object, angular: object, duration: object, count: object) -> DriveOrder:
        requested = number("linear", linear), number("angular", angular)
        if duration is not None:
            seconds = number("duration", duration, above=0, high=self.max_duration)
            messages = messages_for("duration", seconds, self.publish_rate)
        else:
            messages = whole("count", count, low=1, high=COUNT_MAX)
            most = COUNT_MAX if self.max_duration is None else min(COUNT_MAX, self.max_duration * self.publish_rate)
            if messages > max(1, round(most)):
                raise ValidationError(
                    f"count must be at most {max(1, round(most))}, what {self.max_duration:g} s hold at "
                    f"{self.publish_rate:g} Hz, not {messages}."
                )
        self.check_motion(*requested)
        sent = _clamped(requested[0], self.max_linear), _clamped(requested[1], self.max_angular)
        return DriveOrder(
            *sent,
            fields=self.command_message(*sent),
            messages=messages,
            rate_hz=self.publish_rate,
            latches=duration is None and messages == 1,
        )

    def _still_now(self) -> bool | None:
        self._odometry.start_in_background()
        return self._odometry.still

    def _halted(self, verdict: StopVerdict) -> StopVerdict:
        self._latched = self._latched and not verdict.stopped
        return verdict

    def _read(self, verb: str, argument: str, source: tuple[str | None, str | None], timeout: object) -> Envelope:
        try:
            seconds = number("timeout", timeout, above=0, high=threading.TIMEOUT_MAX)
            if source[0] is None:
                return error(f"{verb} needs {argument}, and {self.tool_name_str} was made without one.")
            message = self.link.read(source[0], source[1], seconds)
        except (ValidationError, *LINK_ERRORS) as exc:
            return error(str(exc))
        return success(f"One message of {source[0]}.", topic=source[0], message=message)


class _BaseAtRest(PendingVerdict):
    """Verdict on a base to which zeros go out.

    Args:
        then: gets the final verdict.
    """

    def __init__(
        self,
        hold: ZeroVelocityHold,
        drive: Drive | None,
        *,
        odometry: OdometryMonitor,
        driven: bool,
        until: float,
        then: Callable[[StopVerdict], StopVerdict],
    ) -> None:
        # The reading itself waits.
        super().__init__(until, pause_s=0.0)
        self._hold, self._drive, self._odometry, self._then = hold, drive, odometry, then
        self._driven = driven
        self._source = "drive" if driven else "velocity"

    def known(self) -> StopVerdict | None:
        return self.judged(None, last=False)

    def read(self) -> None:
        if not self._hold.sent.is_set():
            self._hold.sent.wait(LOOK_S)
        elif self._drive is not None and not self._drive.ended.is_set():
            self._drive.ended.wait(LOOK_S)
        else:
            time.sleep(LOOK_S)

    def judged(self, reading: object, *, last: bool) -> StopVerdict | None:
        verdict = self.unread("")
        return self._then(verdict) if verdict.stopped or last else None

    def unread(self, why: str) -> StopVerdict:
        source, odometry = self._source, self._odometry
        if not self._hold.sent.is_set():
            return StopVerdict(not_stopped={source: self._hold.problem or "the link did not take the zero in time"})
        if self._drive is not None and not self._drive.ended.is_set():
            return StopVerdict(not_stopped={source: "the drive has not ended in time"})
        if odometry.topic is not None and odometry.still is None:
            return StopVerdict(unknown={source: f"zeros are sent, but {odometry.topic} is silent"})
        if odometry.topic is not None and not odometry.still:
            linear, angular = odometry.last_speeds or (0.0, 0.0)
            why = f"zeros are sent, but odometry still reports {linear:.2f} m/s and {angular:.2f} rad/s"
            return StopVerdict(not_stopped={source: why})
        return StopVerdict(halted=("drive",) if self._driven else ())


class PosedBaseRobot(MobileBaseRobot):
    """A mobile base with odometry, whose topic can be read too."""

    def get_pose(self, timeout: float = 5.0) -> Envelope:
        """Return the next sample of the odometry topic.

        Args:
            timeout: Seconds to wait for a sample, above 0.
        """
        return self._read("get_pose", "odom_topic", self._odom, timeout)

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the reads that this robot's topics allow: ``get_pose``, ``get_scan``."""
        return super().reads if self._odom[0] is None else ("get_pose", *super().reads)

    def agent_verbs(self) -> dict[str, AgentVerb]:
        verbs = super().agent_verbs()
        if "get_pose" in self.reads:
            verbs["get_pose"] = (self.get_pose, f"Read where {self.node_name} is and how it moves.")
        return verbs


def _without_request(method: Callable[..., Envelope]) -> Callable[..., Envelope]:
    """Return a method without its argument ``request``, which no agent gives."""

    @functools.wraps(method)
    def verb(*values: Any, **named: Any) -> Envelope:
        return method(*values, **named)

    signature = inspect.signature(method)
    given = [each for name, each in signature.parameters.items() if name != "request"]
    vars(verb)["__signature__"] = signature.replace(parameters=given)
    return verb


def _optional(check: Callable[[str, object], str], name: str, value: str | None) -> str | None:
    return None if value is None else check(name, value)


def _clamped(value: float, limit: float | None) -> float:
    return value if limit is None else max(-limit, min(limit, value))
