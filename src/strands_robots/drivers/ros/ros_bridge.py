"""A ROS 2 mobile base, driven by velocities and, where it has a navigation stack, by goals."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from strands_robots import settings
from strands_robots.drivers.ros.mobile_base import ANSWER_SHARE, TWIST
from strands_robots.drivers.ros.navigation import Destination, Navigation
from strands_robots.drivers.ros.observers import state_of
from strands_robots.drivers.ros.posed_base import PosedBaseRobot
from strands_robots.envelope import Envelope, error, success
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.link import RosLink
from strands_robots.ros.names import graph_name, interface
from strands_robots.ros.ros2 import Ros2Link
from strands_robots.safety.gate import MotionRefused
from strands_robots.safety.stopping import StopVerdict
from strands_robots.utils import ValidationError, number, text

NAVIGATE = "nav2_msgs/action/NavigateToPose"
DISCONNECT_S = 1.0
"""Seconds that a goal has to end before the graph is left."""


class RosBridgedRobot(PosedBaseRobot):
    """A base on a ROS 2 graph, reached by rclpy where a ROS 2 is sourced, else over bare DDS (topics only).

    It is made without either; what is missing is said by the first verb. It declares no limits unless they are
    given. A stop cancels a navigation goal besides sending its zeros, and says when the server did not confirm it.

    Args:
        node_name: what the robot and its tools are called; it need not be the name of its node.
        cmd_vel_topic: the velocity topic, of ``cmd_vel_type`` (a Twist or a TwistStamped).
        odom_topic: odometry or pose; with it a stop waits to see the base still. The graph tells the types of this
            topic and of ``scan_topic`` where they are not given.
        publish_rate: Hz of a drive that is held, above 0.
        max_linear: clamp in m/s. ``max_angular``: clamp in rad/s. ``max_duration``: longest drive in seconds.
        nav_action: the action of a navigation stack, such as /navigate_to_pose. ``nav_action_type``: its interface,
            whose goal is that of ``NavigateToPose``.
        domain_id: 0 to 232; ``ROS_DOMAIN_ID`` by default.
        link: another road in place of the nearest one.
        command_gate: asks the operator's leave; that of the settings by default.

    Raises:
        ValidationError: an argument outside its domain.
    """

    def __init__(
        self,
        node_name: str,
        cmd_vel_topic: str,
        odom_topic: str,
        scan_topic: str | None = None,
        *,
        cmd_vel_type: str = TWIST,
        odom_type: str | None = None,
        scan_type: str | None = None,
        publish_rate: float = 10.0,
        max_linear: float | None = None,
        max_angular: float | None = None,
        max_duration: float | None = None,
        nav_action: str | None = None,
        nav_action_type: str = NAVIGATE,
        domain_id: int | None = None,
        link: RosLink | None = None,
        command_gate: CommandGate | None = None,
    ) -> None:
        road = Ros2Link(domain_id)
        self.nav_action = None if nav_action is None else graph_name("nav_action", nav_action)
        self.nav_action_type = interface("nav_action_type", nav_action_type)
        self._navigation: Navigation | None = None
        super().__init__(
            node_name,
            link or road,
            cmd_vel_topic,
            cmd_vel_type,
            odom_topic=graph_name("odom_topic", odom_topic),
            odom_type=odom_type,
            scan_topic=scan_topic,
            scan_type=scan_type,
            publish_rate=publish_rate,
            max_linear=max_linear,
            max_angular=max_angular,
            max_duration=max_duration,
            command_gate=command_gate,
        )
        # The same base over bare DDS is the same robot, so that a lock holds it on either road.
        self.safety_key = f"dds:{road.domain_id}:{cmd_vel_topic}"

    @classmethod
    def from_ros(
        cls, node_name: str, cmd_vel_topic: str, odom_topic: str, scan_topic: str | None = None, **kwargs: Any
    ) -> RosBridgedRobot:
        """The constructor, by the name that matches the other classes'."""
        return cls(node_name, cmd_vel_topic, odom_topic, scan_topic, **kwargs)

    def navigate_to(  # noqa: PLR0917 - the documented order of a goal's parts
        self,
        x: float,
        y: float,
        yaw: float = 0.0,
        frame_id: str = "map",
        timeout: float = 120.0,
        tool_context: Any = None,
    ) -> Envelope:
        """Give the navigation stack a goal and return when it has ended; after ``timeout`` seconds it is cancelled.

        Position in metres and heading in radians (left is positive) in ``frame_id``. Obstacles, path and recovery are
        the robot's own. Success is that the server says the goal was reached; every other end, refusal and
        failure is an error envelope with ``goal_state``: not sent, rejected, aborted, canceled, or lost where nobody
        knows whether the robot is still on its way.
        """
        going = self._depart((x, y, yaw, frame_id, timeout), tool_context)
        return self._travel(going) if isinstance(going, Navigation) else going

    def start_navigation(  # noqa: PLR0917 - as above
        self,
        x: float,
        y: float,
        yaw: float = 0.0,
        frame_id: str = "map",
        timeout: float = 120.0,
        tool_context: Any = None,
    ) -> Envelope:
        """Start what :meth:`navigate_to` waits for; its end is told to observers and by :meth:`get_task_status`."""
        going = self._depart((x, y, yaw, frame_id, timeout), tool_context)
        if not isinstance(going, Navigation):
            return going
        refusal = self._run_behind(lambda: self._travel(going), going, "navigate")
        return refusal or success(f"On the way: {going.instruction}.", timeout=going.to.timeout_s)

    def halt(self, reason: str = "") -> StopVerdict:
        """Cancel the navigation goal and stop the base; see :meth:`MobileBaseRobot.halt`.

        A goal that its server has not ended by the deadline is a base that did not stop: its stack may send
        velocities beside our zeros.
        """
        began = time.monotonic()
        going = self._navigation
        was_going = going is not None and going.doubt is not None
        # This is what cancels a goal that is waited for.
        self.gate.revoke()
        unasked = self._ask_again(going) if going is not None and was_going and going.ended.is_set() else ""
        verdict = super().halt(reason)
        if going is None or not was_going:
            return verdict
        left = ANSWER_SHARE * settings.number("STRANDS_HALT_DEADLINE_S") - (time.monotonic() - began)
        going.wait_until_over(max(0.0, left))
        doubt = going.doubt
        spent = (time.monotonic() - began) * 1000
        if doubt is None:
            return replace(verdict, halted=(*verdict.halted, "navigation"), elapsed_ms=spent)
        return replace(verdict, not_stopped={**verdict.not_stopped, "navigation": doubt + unasked}, elapsed_ms=spent)

    def disconnect(self) -> None:
        """Cancel the navigation goal too, and give it a moment to end; see :meth:`MobileBaseRobot.disconnect`."""
        self.gate.revoke()
        if self._navigation is not None:
            self._navigation.ended.wait(DISCONNECT_S)
        super().disconnect()

    def get_task_status(self) -> Envelope:
        """As of every base; while and after a navigation, its state and how many samples of feedback came."""
        going = self._navigation
        if going is None or self._burst is not None:
            return super().get_task_status()
        latest: Mapping[str, Any] = going.feedback[-1] if going.feedback else {}
        state = state_of(going)
        return success(
            f"The last goal is {state}.",
            task_status=state,
            instruction=going.instruction,
            step_count=going.sent,
            duration=round(going.elapsed_s, 3),
            feedback=latest,
        )

    @property
    def tools(self) -> list[Any]:
        """What this robot can do, as Strands agent tools named by it, with ``navigate_<name>`` where it has a stack."""
        from strands_robots.drivers.ros.tools import navigate_tool  # noqa: PLC0415 - strands is loaded when it is used

        found = super().tools
        return found if self.nav_action is None else [*found, navigate_tool(self)]

    def _depart(self, stated: tuple[Any, Any, Any, Any, Any], tool_context: Any) -> Navigation | Envelope:
        """A navigation that may begin, with the base's one slot taken for it; or why it may not."""
        x, y, yaw, frame_id, timeout = stated
        try:
            to = Destination(
                number("x", x),
                number("y", y),
                number("yaw", yaw),
                text("frame_id", frame_id, longest=255),
                number("timeout", timeout, above=0, high=threading.TIMEOUT_MAX),
            )
        except ValidationError as refused:
            return error(str(refused))
        if self.nav_action is None:
            return error(f"navigate_to needs nav_action, and {self.tool_name_str} was made without one.")
        if not self._slot.acquire(blocking=False):
            return error("The base is being driven; stop it first, or wait for its end.")
        held = False
        try:
            permit = self.gate.permit("navigate_to")
            refusal = self.command_gate.refusal(self.nav_action, self.nav_action_type, "navigate_to", tool_context)
            if refusal is not None:
                return refusal
            self._odometry.start()
            self._holds.end_for(permit)
            self._burst = None
            going = self._navigation = Navigation(self.link, self.nav_action, self.nav_action_type, to, permit)
            held = True
        except MotionRefused as locked:
            return locked.envelope
        finally:
            if not held:
                self._slot.release()
        return going

    def _ask_again(self, going: Navigation) -> str:
        """Ask for the end of a goal that nobody waits for any longer; what to add to its doubt when that cannot be.

        On a thread, because a broken link may hold it up; beside the zeros, because its stack may drive against them.
        """
        try:
            threading.Thread(target=going.cancel_again, name=f"cancel-{self.node_name}", daemon=True).start()
        except RuntimeError as exc:
            return f"; its server was not asked again: {exc}"
        return ""

    def _travel(self, going: Navigation) -> Envelope:
        self._observers.started(going)
        try:
            return going.run()
        finally:
            # The slot first: whoever waits for the end may send the robot on at once.
            self._slot.release()
            going.ended.set()
            self._observers.finished(going)
