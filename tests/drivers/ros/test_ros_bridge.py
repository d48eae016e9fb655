from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from fixtures.ros_bases import Lock, memory, none_left, velocities
from fixtures.ros_memory import MemoryLink
from fixtures.waiting import eventually

from strands_robots.contract import TaskRobot
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.drivers.ros.rtps_robot import RtpsRobot
from strands_robots.envelope import Envelope
from strands_robots.ros.gate import CommandGate
from strands_robots.ros.link import Goal, Message, OnMessage, RosError
from strands_robots.utils import ValidationError

NAV = "/navigate_to_pose"
OPEN = CommandGate(lambda _: ("cmd_vel", "navigate_to_pose"), lambda: False)
SHUT = CommandGate(lambda _: ("cmd_vel",), lambda: False)


class Stack:
    """A navigation stack in memory: keeps what it was asked, ends goals as the test says."""

    def __init__(self) -> None:
        self.requests: list[Message] = []
        self.goals: list[Goal] = []
        self.cancels = 0
        self.feedback: OnMessage = lambda message: None
        self.obeys = True
        self.at_once: int | None = None

    def begun(self, goal: Message, feedback: OnMessage, sent: Goal) -> None:
        def cancel() -> None:
            self.cancels += 1
            if self.obeys:
                sent.end(5, {})

        self.requests.append(goal)
        self.feedback = feedback
        sent.cancel = cancel
        self.goals.append(sent)
        if self.at_once is not None:
            sent.end(self.at_once, {"error_code": 0})


Made = Callable[..., RosBridgedRobot]


@pytest.fixture
def stack() -> Stack:
    return Stack()


@pytest.fixture
def made(stack: Stack, monkeypatch: pytest.MonkeyPatch) -> Iterator[Made]:
    monkeypatch.setattr("strands_robots.ros.link.CANCEL_S", 0.2)
    robots: list[RosBridgedRobot] = []

    def make(**options: Any) -> RosBridgedRobot:
        link = MemoryLink()
        link.serve(NAV, stack.begun)
        options = {"publish_rate": 200.0, "command_gate": OPEN, "nav_action": NAV, "link": link, **options}
        robots.append(RosBridgedRobot("rover", "/cmd_vel", "/odom", **options))
        standing = {"twist": {"twist": {"linear": {"x": 0.0}, "angular": {"z": 0.0}}}}
        link.watch("/cmd_vel", None, lambda _: link.publish("/odom", "nav_msgs/msg/Odometry", standing))
        return robots[-1]

    yield make
    for robot in robots:
        robot.disconnect()


def going(robot: RosBridgedRobot, stack: Stack, **options: Any) -> tuple[threading.Thread, list[Envelope]]:
    """A navigation on a thread of its own, begun."""
    answers: list[Envelope] = []
    thread = threading.Thread(target=lambda: answers.append(robot.navigate_to(1.0, 2.0, **options)))
    thread.start()
    eventually(lambda: stack.goals)
    return thread, answers


def over(thread: threading.Thread) -> None:
    thread.join(20)
    assert not thread.is_alive()


def test_reached_goal_reports_result_and_feedback(made: Made, stack: Stack) -> None:
    robot = made()
    thread, answers = going(robot, stack, yaw=math.pi / 2, frame_id="odom")
    for left in range(8):
        stack.feedback({"distance_remaining": left})
    assert robot.get_task_status()["task_status"] == "running"
    stack.goals[0].end(4, {"error_code": 0})
    over(thread)
    answer = answers[0]
    assert (answer["status"], answer["goal_state"], answer["goal_status"]) == ("success", "succeeded", 4)
    assert (answer["result"], answer["feedback_count"], len(answer["feedback"])) == ({"error_code": 0}, 8, 5)
    assert answer["feedback"][-1] == {"distance_remaining": 7}
    pose = stack.requests[0]["pose"]
    assert pose["header"]["frame_id"] == "odom"
    assert pose["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 0.0}
    assert pose["pose"]["orientation"]["z"] == pytest.approx(math.sqrt(0.5))
    status = robot.get_task_status()
    assert (status["task_status"], status["step_count"]) == ("completed", 8)
    assert status["instruction"] == "navigate to x 1 m, y 2 m in odom"


@pytest.mark.parametrize(("status", "state"), [(6, "aborted"), (5, "canceled"), (99, "lost")])
def test_goal_that_is_not_reached_is_an_error(made: Made, stack: Stack, status: int, state: str) -> None:
    stack.at_once = status
    answer = made().navigate_to(1.0, 2.0)
    assert (answer["status"], answer["goal_state"], answer["goal_status"]) == ("error", state, status)


def test_a_goal_that_takes_too_long_is_cancelled(made: Made, stack: Stack) -> None:
    robot = made()
    answer = robot.navigate_to(1.0, 2.0, timeout=0.05)
    assert (answer["goal_state"], answer["ended_by"], stack.cancels) == ("canceled", "its time of 0.05 s", 1)
    assert robot.get_task_status()["task_status"] == "error"


def test_goal_that_ignores_its_cancel_is_lost_and_every_stop_cancels_it_again(
    made: Made, stack: Stack, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, stack.obeys = made(), False
    answer = robot.navigate_to(1.0, 2.0, timeout=0.05)
    assert (answer["status"], answer["goal_state"]) == ("error", "lost")
    assert "it is unknown whether the goal still goes on" in answer["reason"]
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.2")
    verdict = robot.halt("test")
    assert verdict.stopped is False
    assert "it is unknown" in verdict.not_stopped["navigation"]
    eventually(lambda: stack.cancels == 2)
    stack.obeys = True
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "20")
    assert robot.halt("test").halted == ("navigation",)
    assert (robot.halt("test").stopped, stack.cancels) == (True, 3)


def test_stop_without_a_thread_to_cancel_a_lost_goal_still_sends_its_zero(
    made: Made, stack: Stack, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, stack.obeys = made(), False
    assert robot.navigate_to(1.0, 2.0, timeout=0.05)["goal_state"] == "lost"
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.2")
    permit = robot.gate.permit("drive")
    before = len(velocities(memory(robot)))
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", none_left)
        verdict = robot.halt("test")
    assert not permit.valid
    assert velocities(memory(robot))[before:] == [(0.0, 0.0)]
    assert verdict.stopped is False
    assert "was not asked again: can't start new thread" in verdict.not_stopped["navigation"]


@pytest.mark.parametrize("cut", [KeyboardInterrupt, ValueError])
def test_goal_with_an_interrupted_wait_is_in_doubt(
    made: Made, stack: Stack, monkeypatch: pytest.MonkeyPatch, cut: type[BaseException]
) -> None:
    begun = stack.begun

    def cut_off(within_s: float) -> bool:
        raise cut("in the wait")

    def unreachable() -> None:
        stack.cancels += 1
        raise RosError("the connection is gone")

    def begun_and_cut_off(goal: Message, feedback: OnMessage, sent: Goal) -> None:
        begun(goal, feedback, sent)
        sent.cancel = unreachable
        monkeypatch.setattr(sent.done, "wait", cut_off)

    monkeypatch.setattr(stack, "begun", begun_and_cut_off)
    robot = made()
    events: list[tuple[str, str]] = []
    robot.subscribe(lambda event: events.append((event.kind, event.state)))
    with pytest.raises(cut):
        robot.navigate_to(1.0, 2.0)
    assert (robot.get_task_status()["task_status"], stack.cancels) == ("error", 1)
    assert events == [("started", "running"), ("finished", "error")]
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.2")
    verdict = robot.halt("test")
    assert verdict.stopped is False
    assert "interrupted" in verdict.not_stopped["navigation"]
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "20")
    memory(robot).serve(NAV, begun)
    stack.at_once = 4
    assert robot.navigate_to(1.0, 2.0)["goal_state"] == "succeeded"
    assert robot.halt("test").stopped is True


def test_stop_cancels_the_goal_and_reports_it(made: Made, stack: Stack) -> None:
    robot = made()
    thread, answers = going(robot, stack)
    verdict = robot.stop()
    assert (verdict["stopped"], verdict["halted"], stack.cancels) == (True, ["navigation"], 1)
    over(thread)
    assert (answers[0]["goal_state"], answers[0]["ended_by"]) == ("canceled", "a stop")
    assert robot.get_task_status()["task_status"] == "stopped"
    assert robot.stop()["halted"] == []


def test_stop_whose_goal_does_not_end_in_time_did_not_stop(
    made: Made, stack: Stack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    robot, stack.obeys = made(), False
    monkeypatch.setattr("strands_robots.ros.link.CANCEL_S", 60.0)
    thread, _ = going(robot, stack)
    verdict = robot.halt("test")
    assert verdict.stopped is False
    assert "being cancelled" in verdict.not_stopped["navigation"]
    stack.goals[0].end(5, {})
    over(thread)


@pytest.mark.parametrize("argument", ["x", "y", "yaw"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), True, "1", None])
def test_invalid_goal_position_is_refused(made: Made, stack: Stack, argument: str, bad: Any) -> None:
    answer = made().navigate_to(**{"x": 1.0, "y": 2.0, argument: bad})
    assert argument in answer["reason"]
    assert stack.requests == []


@pytest.mark.parametrize("bad", [0, -1, float("nan"), float("inf"), True, 1e308])
def test_invalid_goal_timeout_is_refused(made: Made, stack: Stack, bad: Any) -> None:
    assert "timeout" in made().navigate_to(1.0, 2.0, timeout=bad)["reason"]
    assert "frame_id" in made().navigate_to(1.0, 2.0, frame_id="")["reason"]
    assert stack.requests == []


def test_goal_needs_a_stack_an_approval_and_no_lockout(made: Made, stack: Stack) -> None:
    assert "nav_action" in made(nav_action=None).navigate_to(1.0, 2.0)["reason"]
    assert "needs operator approval" in made(command_gate=SHUT).navigate_to(1.0, 2.0)["reason"]
    locked = made()
    locked.gate.attach(Lock())
    assert "locked" in locked.navigate_to(1.0, 2.0)["reason"]
    alone = made(link=MemoryLink())
    answer = alone.navigate_to(1.0, 2.0)
    assert (answer["goal_state"], "No server for" in answer["reason"]) == ("not sent", True)
    assert stack.requests == []


def test_a_drive_and_a_goal_exclude_each_other(made: Made, stack: Stack) -> None:
    robot = made()
    thread, _ = going(robot, stack)
    assert "stop it first" in robot.drive(0.1, duration=0.1)["reason"]
    assert "stop it first" in robot.navigate_to(3.0, 3.0)["reason"]
    robot.stop()
    over(thread)
    assert robot.drive(0.1, duration=0.02)["status"] == "success"
    assert robot.get_task_status()["instruction"].startswith("drive")


def test_goal_without_a_thread_leaves_the_base_free(made: Made, stack: Stack, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = made()
    start = threading.Thread.start

    def no_way(thread: threading.Thread) -> None:
        (none_left if thread.name.startswith("navigate-") else start)(thread)

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", no_way)
        answer = robot.start_navigation(1.0, 2.0)
    assert ("could not begin" in answer["reason"], answer["goal_state"]) == (True, "not sent")
    assert robot.get_task_status()["task_status"] == "error"
    assert stack.goals == []
    assert robot.stop()["stopped"] is True
    assert robot.drive(0.1, duration=0.01)["status"] == "success"


def test_disconnect_cancels_the_goal_first(made: Made, stack: Stack) -> None:
    robot = made()
    thread, answers = going(robot, stack)
    robot.disconnect()
    over(thread)
    assert (stack.cancels, answers[0]["goal_state"]) == (1, "canceled")


def test_tools_have_the_robots_name_and_describe_every_parameter(made: Made, stack: Stack) -> None:
    robot = made(scan_topic="/scan")
    names = [each.tool_name for each in robot.tools]
    assert names == [
        "drive_rover",
        "stop_rover",
        "status_rover",
        "get_scan_rover",
        "get_pose_rover",
        "navigate_rover",
    ]
    for each in robot.tools:
        for name, parameter in each.tool_spec["inputSchema"]["json"]["properties"].items():
            assert len(parameter["description"]) > 10, (each.tool_name, name)
    assert "navigate_rover" not in [each.tool_name for each in made(nav_action=None).tools]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"nav_action": "not a name"}, "nav_action"),
        ({"nav_action_type": "x"}, "nav_action_type"),
        ({"publish_rate": 0}, "publish_rate"),
        ({"max_linear": -1}, "max_linear"),
        ({"domain_id": 233}, "domain_id"),
    ],
)
def test_invalid_constructor_argument_is_refused_by_name(options: dict[str, Any], named: str) -> None:
    with pytest.raises(ValidationError, match=named):
        RosBridgedRobot("rover", "/cmd_vel", "/odom", **options)


def test_robot_without_ros_is_constructed_and_its_verbs_name_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "1")
    monkeypatch.setattr("strands_robots.ros.actions.sourced", lambda: False)
    monkeypatch.setattr("strands_robots.ros.actions.find_spec", lambda name: None)
    robot = RosBridgedRobot.from_ros("rover", cmd_vel_topic="/cmd_vel", odom_topic="/odom", command_gate=OPEN)
    assert isinstance(robot, TaskRobot)
    for answer in (robot.drive(0.1), robot.get_pose(), robot.stop()):
        assert "source a ROS 2 installation, or install the [ros2] extra" in answer["reason"]
    robot.disconnect()


def test_same_base_over_bare_dds_has_the_same_lockout_key() -> None:
    here, there = RosBridgedRobot("a", "/cmd_vel", "/odom", domain_id=7), RtpsRobot("b", "/cmd_vel", domain_id=7)
    assert here.safety_key == there.safety_key
