"""ROS 2 mobile base, driven by velocities and by navigation goals."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

from strands_robots.drivers.ros.mobile_base import TWIST, AgentVerb, PosedBaseRobot
from strands_robots.drivers.ros.motion import Destination, Navigation
from strands_robots.envelope import Envelope, error, success
from strands_robots.ros.actions import Ros2Link
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.link import RosLink, graph_name, interface
from strands_robots.safety.gate import MotionRequest, Permit
from strands_robots.safety.stopping import PendingVerdict, StopVerdict
from strands_robots.utils import ValidationError, number, text

NAVIGATE = "nav2_msgs/action/NavigateToPose"
DISCONNECT_S = 1.0
"""Seconds that a goal has to end before the graph is left."""


class RosBridgedRobot(PosedBaseRobot):
    """A base on a ROS 2 graph, reached by rclpy or, for topics only, bare DDS.

    Constructing it needs neither; the first verb names what is missing. It declares no limits unless they are
    given. A stop cancels a navigation goal besides sending its zeros, and says when the server did not confirm it.

    Args:
        node_name: name of the robot and of its tools; it need not be the name of its node.
        cmd_vel_topic: the velocity topic, of ``cmd_vel_type`` (a Twist or a TwistStamped).
        odom_topic: odometry or pose; with it a stop waits to see the base still. The graph is asked for the types of
            this topic and of ``scan_topic`` where they are not given.
        nav_action: the action of a navigation stack, such as /navigate_to_pose. ``nav_action_type``: its interface,
            whose goal is that of ``NavigateToPose``.
        domain_id: 0 to 232; ``ROS_DOMAIN_ID`` by default.
        link: a link to use in place of a :class:`Ros2Link`.

    The other arguments are those of :class:`MobileBaseRobot`.
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
        ros2 = Ros2Link(domain_id)
        self.nav_action = None if nav_action is None else graph_name("nav_action", nav_action)
        self.nav_action_type = interface("nav_action_type", nav_action_type)
        self._navigation: Navigation | None = None
        super().__init__(
            node_name,
            link or ros2,
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
        # The same base over bare DDS is the same robot: a lockout covers it on either link.
        self.safety_key = f"dds:{ros2.domain_id}:{cmd_vel_topic}"

    @classmethod
    def from_ros(
        cls, node_name: str, cmd_vel_topic: str, odom_topic: str, scan_topic: str | None = None, **kwargs: Any
    ) -> RosBridgedRobot:
        """Construct the robot, by a name that matches the other classes."""
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
        """Give the navigation stack a goal and return when it has ended.

        Obstacles, path and recovery are the robot's own. Success means that the server reported the goal as reached;
        every other end, refusal and failure is an error envelope with ``goal_state``: not sent, rejected, aborted,
        canceled, or lost where it is unknown whether the robot is still on its way.

        Args:
            x: Position of the goal in metres, along the frame's x axis.
            y: Position of the goal in metres, along the frame's y axis.
            yaw: Heading at the goal in radians; positive is to the left.
            frame_id: Frame in which the goal is given, such as map or odom.
            timeout: Seconds after which the goal is cancelled, above 0.
            tool_context: Context of an agent's call, through which the operator is asked.
        """
        goal = self._begin_navigation(x, y, yaw, frame_id, timeout, tool_context)
        return self._run(goal) if isinstance(goal, Navigation) else goal

    def start_navigation(  # noqa: PLR0917 - as above
        self,
        x: float,
        y: float,
        yaw: float = 0.0,
        frame_id: str = "map",
        timeout: float = 120.0,
        tool_context: Any = None,
        *,
        request: MotionRequest | None = None,
    ) -> Envelope:
        """Start a goal; :meth:`get_task_status` and observers report its end."""
        goal = self._begin_navigation(x, y, yaw, frame_id, timeout, tool_context, request)
        if not isinstance(goal, Navigation):
            return goal
        refusal = self._run_in_background(goal)
        return refusal or success(f"On the way: {goal.instruction}.", timeout=goal.to.timeout_s)

    def halt_here(self, reason: str, deadline: float) -> PendingVerdict:
        """Cancel the navigation goal and stop the base.

        A goal that its server has not ended by the deadline is a base that did not stop: its stack may send
        velocities beside our zeros.
        """
        goal = self._navigation
        if goal is None or goal.doubt() is None:
            return super().halt_here(reason, deadline)
        # Revoking the permit cancels a goal that is still waited for; a lost one is cancelled again.
        self.gate.revoke()
        not_cancelled = self._cancel_again(goal) if goal.ended.is_set() else ""
        return _NavigationOver(super().halt_here(reason, deadline), goal, not_cancelled)

    def disconnect(self) -> None:
        """Cancel the navigation goal too, and give it a moment to end."""
        self.gate.revoke()
        if self._navigation is not None:
            self._navigation.ended.wait(DISCONNECT_S)
        super().disconnect()

    def agent_verbs(self) -> dict[str, AgentVerb]:
        verbs = super().agent_verbs()
        if self.nav_action is not None:
            text = f"Let {self.node_name} navigate to a place around obstacles; returns when it arrived or gave up."
            verbs["navigate"] = (self.navigate_to, text)
        return verbs

    def _begin_navigation(  # noqa: PLR0917 - as above
        self,
        x: object,
        y: object,
        yaw: object,
        frame_id: object,
        timeout: object,
        tool_context: Any,
        request: MotionRequest | None = None,
    ) -> Navigation | Envelope:
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
        target = (self.nav_action, self.nav_action_type)

        def make(permit: Permit) -> Navigation:
            self._navigation = Navigation(self.link, *target, to, permit)
            return self._navigation

        return self._begin("navigate_to", target, tool_context, make, request)

    def _cancel_again(self, goal: Navigation) -> str:
        """Cancel a lost goal again; return what to add to its doubt, or "".

        On a thread, because a broken link may block it; beside the zeros, because its stack may drive against them.
        """
        try:
            threading.Thread(target=goal.cancel_again, name=f"cancel-{self.node_name}", daemon=True).start()
        except RuntimeError as exc:
            return f"; its server was not asked again: {exc}"
        return ""


class _NavigationOver(PendingVerdict):
    """Verdict on a base and on the end of its navigation goal.

    Args:
        base: the verdict on the base alone.
        not_cancelled: added to the doubt about the goal.
    """

    def __init__(self, base: PendingVerdict, goal: Navigation, not_cancelled: str) -> None:
        super().__init__(base.until, pause_s=0.0)
        self._base, self._goal, self._not_cancelled = base, goal, not_cancelled

    def known(self) -> StopVerdict | None:
        return self.judged(None, last=False)

    def read(self) -> None:
        self._base.read()

    def judged(self, reading: object, *, last: bool) -> StopVerdict | None:
        base = self._base.judged(reading, last=last)
        over = self._goal.doubt() is None
        return None if base is None or not (over or last) else self._with_goal(base)

    def unread(self, why: str) -> StopVerdict:
        return self._with_goal(self._base.unread(why))

    def _with_goal(self, base: StopVerdict) -> StopVerdict:
        doubt = self._goal.doubt()
        if doubt is None:
            return replace(base, halted=(*base.halted, "navigation"))
        return replace(base, not_stopped={**base.not_stopped, "navigation": doubt + self._not_cancelled})
