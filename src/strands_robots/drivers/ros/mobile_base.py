"""The contract of a mobile base on a ROS graph, whatever road leads to it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from strands_robots import settings
from strands_robots.contract import Observer, Unsubscribe
from strands_robots.drivers.ros.burst import COUNT_MAX, Burst, Order, messages_for
from strands_robots.drivers.ros.observers import Observers, Unbegun, state_of
from strands_robots.drivers.ros.odometry import Odometry
from strands_robots.drivers.ros.wire import Hold, Holds, VelocityWire
from strands_robots.envelope import Envelope, error, success
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.link import RosError, RosLink
from strands_robots.ros.names import bare_kind, graph_name, interface
from strands_robots.safety.gate import MotionGate, MotionRefused
from strands_robots.safety.stopping import StopVerdict
from strands_robots.utils import MissingExtraError, ValidationError, identifier, number, whole

logger = logging.getLogger(__name__)

TWIST = "geometry_msgs/msg/Twist"
ANSWER_SHARE = 0.9
"""Part of the halt deadline that a halt waits for stillness; the rest is for its verdict to arrive in time."""

UNREACHABLE = (RosError, MissingExtraError)
NO_POLICIES = "{} is a mobile base and runs no policies; use drive."


class MobileBaseRobot:
    """A base that is driven by velocities. Thread-safe; one drive at a time.

    A drive is checked in this order, before anything is done: velocities; ``duration``, else ``count``; the limits;
    the lockout; the operator's leave for the velocity topic; the handshake that arms the vehicle. Then it is clamped
    and sent. Every timed or repeated drive that is not zero ends with one zero, and :meth:`stop`, that zero and
    the zeros of a halt need nobody's leave.

    Args:
        node_name: what the robot and its tools are called, an identifier.
        link: the road to the graph.
        command_topic: the velocity topic; ``command_type`` is what it carries.
        odom_topic: where the base tells how it moves; with it, a stop waits to see the base still.
        publish_rate: Hz of a drive that is held, above 0.
        max_linear: clamp in m/s, above 0; None: this platform declares no limit. ``max_angular`` in rad/s likewise.
        max_duration: longest drive in seconds, above 0; a longer one is refused.
        command_gate: asks the operator's leave; that of the settings by default.

    Raises:
        ValidationError: an argument outside its domain.
    """

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
        self.link = link
        self._topic = graph_name("command_topic", command_topic)
        self._kind = interface("command_type", command_type)
        self._scan = (_optional(graph_name, "scan_topic", scan_topic), _optional(interface, "scan_type", scan_type))
        odom = (_optional(graph_name, "odom_topic", odom_topic), _optional(interface, "odom_type", odom_type))
        self._odom_kind = odom[1]
        self.publish_rate = number("publish_rate", publish_rate, above=0)
        self.max_linear = None if max_linear is None else number("max_linear", max_linear, above=0)
        self.max_angular = None if max_angular is None else number("max_angular", max_angular, above=0)
        self.max_duration = None if max_duration is None else number("max_duration", max_duration, above=0)
        self.gate = MotionGate()
        self.command_gate = command_gate or CommandGate()
        self._odometry = Odometry(link, *odom)
        self._wire = VelocityWire(link, self._topic, self._kind, self.command_message(0.0, 0.0))
        self._holds = Holds(lambda: Hold(self._wire, self.publish_rate, self._still_now, self.node_name))
        self._observers = Observers(self.tool_name_str)
        self._slot = threading.Lock()
        self._burst: Burst | None = None
        self._latched = False

    # What a subclass says about its platform.

    def command_message(self, linear: float, angular: float) -> dict[str, Any]:
        """The fields of the message that commands these velocities, in m/s and rad/s, or of the zero."""
        twist = {
            "linear": {"x": linear, "y": 0.0, "z": 0.0},
            "angular": {"x": 0.0, "y": 0.0, "z": angular},
        }
        return {"twist": twist} if bare_kind(self._kind) == "geometry_msgs/TwistStamped" else twist

    def check_motion(self, linear: float, angular: float) -> None:
        """Raise :class:`ValidationError` where the platform cannot execute this motion."""

    def handshake(self, tool_context: Any = None) -> Envelope | None:
        """Put the vehicle into a state in which it takes commands; the error that stands in the way, or None."""
        return None

    # Commands.

    def drive(
        self,
        linear: float = 0.0,
        angular: float = 0.0,
        duration: float | None = None,
        count: int = 1,
        tool_context: Any = None,
    ) -> Envelope:
        """Send velocities (m/s forwards, rad/s to the left) and return when they are sent.

        With ``duration`` in seconds they are held for that long and a zero follows; else ``count`` messages are
        sent. A bare single message goes on until :meth:`stop`, as a raw command does. Every refusal and failure is
        an error envelope, and nothing is sent for a refused one.
        """
        burst = self._begin(linear, angular, duration, count, tool_context)
        if not isinstance(burst, Burst):
            return burst
        return self._run(burst)

    def start_drive(self, linear: float, angular: float, duration: float, tool_context: Any = None) -> Envelope:
        """Start a timed drive and return; its end is told to observers and by :meth:`get_task_status`."""
        try:
            seconds = number("duration", duration, above=0, high=self.max_duration)
        except ValidationError as refused:
            return error(str(refused))
        burst = self._begin(linear, angular, seconds, 1, tool_context)
        if not isinstance(burst, Burst):
            return burst
        refusal = self._run_behind(lambda: self._run(burst), burst, "drive")
        if refusal is not None:
            return refusal
        order = burst.order
        return success(
            f"Driving at {order.linear:g} m/s and {order.angular:g} rad/s for {seconds:g} s.",
            linear=order.linear,
            angular=order.angular,
            duration=seconds,
        )

    def stop(self, tool_context: Any = None) -> Envelope:
        """Stop the base: a zero at once and more until it is still. Needs nobody's leave; the answer is the verdict.

        It is the one that every network gives: where odometry is silent, an error with ``stopped`` None.
        """
        del tool_context
        return self.halt("stop").envelope()

    def halt(self, reason: str = "") -> StopVerdict:
        """Void every permit, send zeros until the base is still, and say within the deadline what is known.

        With odometry, stopped means that two samples after the first zero say so; one that still moves did not
        stop, and one whose odometry is silent is unknown. Without odometry, stopped means that the link took the
        zero: nobody measures the rest. A zero that the link does not take is a base that did not stop.
        """
        began = time.monotonic()
        deadline = began + ANSWER_SHARE * settings.number("STRANDS_HALT_DEADLINE_S")
        self.gate.revoke()
        self._odometry.expect_stillness()
        burst = self._burst
        driven = self._latched or (burst is not None and not burst.ended.is_set())
        if burst is not None:
            burst.interrupt()
        hold = self._holds.begin()
        verdict = self._verdict(hold, burst, driven, deadline)
        self._latched = self._latched and not verdict.stopped
        logger.info("Halted %s (%s): %s", self.tool_name_str, reason or "no reason given", verdict.stopped)
        return replace(verdict, elapsed_ms=(time.monotonic() - began) * 1000)

    # Reads.

    def get_scan(self, timeout: float = 5.0) -> Envelope:
        """The next laser scan, within ``timeout`` seconds, above 0."""
        return self._read("get_scan", "scan_topic", self._scan, timeout)

    @property
    def tools(self) -> list[Any]:
        """What this robot can do, as Strands agent tools named by it. Needs the [agent] extra."""
        from strands_robots.drivers.ros.tools import tools_of  # noqa: PLC0415 - strands is loaded when it is used

        return tools_of(self)

    @property
    def reads(self) -> tuple[str, ...]:
        """The reads that this robot's topics allow, such as ``get_scan``."""
        return () if self._scan[0] is None else ("get_scan",)

    @property
    def holding(self) -> bool:
        """Zeros still go out after a halt."""
        return self._holds.running

    def motion_note(self) -> str:
        """What an agent has to know about how this platform moves, one sentence."""
        return "It turns in place."

    # The robot contract, so that every network takes a base.

    def start_task(
        self, instruction: str, policy_provider: str = "mock", duration: float = 30.0, policy_port: int = 0
    ) -> Envelope:
        """Refused: a base is driven, it follows no policy."""
        del instruction, policy_provider, duration, policy_port
        return error(NO_POLICIES.format(self.tool_name_str))

    def stop_task(self) -> Envelope:
        """The same as :meth:`stop`."""
        return self.stop()

    def get_task_status(self) -> Envelope:
        """``task_status`` (idle, running, completed, stopped, error) and what the current or last drive sent."""
        burst = self._burst
        if burst is None:
            return success("Idle.", task_status="idle", instruction="", step_count=0, duration=0.0)
        state = state_of(burst)
        return success(
            f"The last drive is {state}.",
            task_status=state,
            instruction=f"drive {burst.order.linear:g} m/s, {burst.order.angular:g} rad/s",
            step_count=burst.sent,
            duration=round(burst.elapsed_s, 3),
        )

    def get_features(self) -> Envelope:
        """``observation_features`` and ``action_features`` as data, with the declared limits."""
        limits = {"linear": self.max_linear, "angular": self.max_angular, "duration": self.max_duration}
        return success(
            "A mobile base: linear in m/s, angular in rad/s.",
            observation_features=dict.fromkeys(self.reads, "message"),
            action_features={"linear": "float", "angular": "float"},
            limits=limits,
        )

    def get_state(self) -> Envelope:
        """``joints`` (none), the drive as ``task``, and ``still`` as far as odometry tells."""
        task = self.get_task_status()["task_status"]
        return success(f"{task}.", joints={}, task=task, still=self._odometry.still)

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Tell ``observer`` when a drive begins and ends."""
        return self._observers.add(observer)

    def cleanup(self) -> Envelope:
        """Stop and let go of the graph. A base that is not known to stand stays connected, to be stopped again."""
        verdict = self.halt("cleanup")
        if verdict.stopped:
            self.disconnect()
        return verdict.envelope()

    def disconnect(self) -> None:
        """End what is sent, the zeros too, and let go of the graph. :meth:`cleanup` stops the base first."""
        self.gate.revoke()
        self._holds.close()
        try:
            self._odometry.close()
        except UNREACHABLE as gone:
            logger.info("%s: %s", self.tool_name_str, gone)
        self.link.close()

    def _begin(self, linear: Any, angular: Any, duration: Any, count: Any, tool_context: Any) -> Burst | Envelope:
        try:
            order = self._checked(linear, angular, duration, count)
            if not self._slot.acquire(blocking=False):
                return error("The base is being driven; stop it first, or wait for the drive's end.")
        except ValidationError as refused:
            return error(str(refused))
        held = False
        try:
            permit = self.gate.permit("drive")
            refusal = self.command_gate.refusal(self._topic, self._kind, "drive", tool_context)
            # Asking may take minutes: a stop meanwhile ends the handshake too, which would arm the vehicle.
            with permit.inside():
                refusal = refusal or self.handshake(tool_context)
            if refusal is not None:
                return refusal
            self._odometry.start()
            self._holds.end_for(permit)
            burst = self._burst = Burst(order, self._wire, permit)
            held = True
        except MotionRefused as locked:
            return locked.envelope
        finally:
            if not held:
                self._slot.release()
        return burst

    def _checked(self, linear: Any, angular: Any, duration: Any, count: Any) -> Order:
        asked = number("linear", linear), number("angular", angular)
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
        self.check_motion(*asked)
        sent = _clamped(asked[0], self.max_linear), _clamped(asked[1], self.max_angular)
        return Order(
            *sent,
            fields=self.command_message(*sent),
            messages=messages,
            rate_hz=self.publish_rate,
            latches=duration is None and messages == 1,
            zero=not any(sent),
        )

    def _run_behind(self, run: Callable[[], object], motion: Unbegun, what: str) -> Envelope | None:
        """Run on a thread; where none is to be had, why, with the base as free and as held as before."""
        try:
            threading.Thread(target=run, name=f"{what}-{self.node_name}", daemon=True).start()
        except RuntimeError as exc:
            answer = motion.never_began(str(exc))
            self._slot.release()
            motion.ended.set()
            self._holds.resume()
            return answer
        return None

    def _run(self, burst: Burst) -> Envelope:
        self._observers.started(burst)
        try:
            answer = burst.run()
        finally:
            # A shot that failed, or that a Ctrl-C cut off, may have reached the base all the same.
            self._latched = burst.order.latches and not burst.order.zero and burst.state != "stopped"
            # The slot first: whoever stopped the drive and waits for its end may drive anew at once.
            self._slot.release()
            burst.ended.set()
            self._observers.finished(burst)
        return answer

    def _still_now(self) -> bool | None:
        self._odometry.start_behind()
        return self._odometry.still

    def _verdict(self, hold: Hold, burst: Burst | None, driven: bool, deadline: float) -> StopVerdict:
        source = "drive" if driven else "velocity"
        hold.sent.wait(max(0.0, deadline - time.monotonic()))
        if not hold.sent.is_set():
            why = hold.problem or "the link did not take the zero in time"
            return StopVerdict(not_stopped={source: why})
        if burst is not None and not burst.ended.wait(max(0.0, deadline - time.monotonic())):
            return StopVerdict(not_stopped={source: "the drive has not ended in time"})
        if self._odometry.topic is not None:
            while not self._odometry.still and time.monotonic() < deadline:
                time.sleep(0.005)
            if self._odometry.still is None:
                return StopVerdict(unknown={source: f"zeros are sent, but {self._odometry.topic} says nothing"})
            if not self._odometry.still:
                linear, angular = self._odometry.last_speeds or (0.0, 0.0)
                why = f"zeros are sent, but odometry still tells {linear:.2f} m/s and {angular:.2f} rad/s"
                return StopVerdict(not_stopped={source: why})
        return StopVerdict(halted=("drive",) if driven else ())

    def _read(self, verb: str, argument: str, source: tuple[str | None, str | None], timeout: object) -> Envelope:
        try:
            seconds = number("timeout", timeout, above=0, high=threading.TIMEOUT_MAX)
            if source[0] is None:
                return error(f"{verb} needs {argument}, and {self.tool_name_str} was made without one.")
            message = self.link.read(source[0], source[1], seconds)
        except (ValidationError, *UNREACHABLE) as exc:
            return error(str(exc))
        return success(f"One message of {source[0]}.", topic=source[0], message=message)


def _optional(check: Callable[[str, object], str], name: str, value: str | None) -> str | None:
    return None if value is None else check(name, value)


def _clamped(value: float, limit: float | None) -> float:
    return value if limit is None else max(-limit, min(limit, value))
