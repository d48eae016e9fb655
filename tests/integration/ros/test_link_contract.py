"""What every link to a ROS graph promises, asked of the one in memory, of bare DDS and of rclpy's stand-in."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures import rclpy_stand_in
from fixtures.base_process import nav2
from fixtures.ros_memory import MemoryLink
from fixtures.waiting import eventually

from strands_robots.ros.dds import DdsLink
from strands_robots.ros.link import Goal, Message, OnMessage, RosError, RosLink, run_goal
from strands_robots.ros.rclpy import RclpyLink

DOMAIN = 95
TWIST = "geometry_msgs/msg/Twist"
NAV, NAV_KIND = "/navigate_to_pose", "nav2_msgs/action/NavigateToPose"
ARM_KIND = "std_srvs/srv/SetBool"


@pytest.fixture(params=["memory", "rclpy", "dds"])
def ends(request: pytest.FixtureRequest) -> Iterator[tuple[RosLink, RosLink]]:
    """Two links on one graph."""
    if request.param == "memory":
        link = MemoryLink()
        yield link, link
        return
    with rclpy_stand_in.installed():
        kind: Any = RclpyLink if request.param == "rclpy" else DdsLink
        # The far end is bare DDS, so that no link is only ever tried against itself.
        links = kind(DOMAIN, match_s=20.0), DdsLink(DOMAIN, match_s=20.0)
        yield links
        for each in links:
            each.close()
            each.close()


def served(goal: Message, feedback: OnMessage, sent: Goal) -> None:
    """Reaches what is near; what is far takes until it is cancelled."""
    feedback({"distance_remaining": 0.0})
    if goal["pose"]["pose"]["position"]["x"] < 1:
        sent.end(4, {"error_code": 0})


@pytest.fixture(params=["memory", "rclpy"])
def stacked(request: pytest.FixtureRequest) -> Iterator[RosLink]:
    """A link to a graph with a service and an action."""
    if request.param == "memory":
        link = MemoryLink({"/arm": lambda request: {"success": request["data"], "message": "armed"}})
        link.serve(NAV, served)
        yield link
        return
    with rclpy_stand_in.installed(), nav2(DOMAIN, "reach"):
        over = RclpyLink(DOMAIN)
        # Discovery is over once the service answers, so that the short times below are the goals' own.
        over.call("/arm", ARM_KIND, {"data": True}, 40.0)
        eventually(lambda: NAV in over.actions())
        yield over
        over.close()


def place(x: float) -> dict[str, Any]:
    return {"pose": {"header": {"frame_id": "map"}, "pose": {"position": {"x": x}}}}


@pytest.mark.parametrize("back", [False, True])
def test_published_messages_reach_a_watcher_until_it_unwatches(ends: tuple[RosLink, RosLink], back: bool) -> None:
    near, far = reversed(ends) if back else ends
    received: list[Message] = []
    unwatch = far.watch("/cmd_vel", TWIST, received.append)
    near.publish("/cmd_vel", TWIST, {"linear": {"x": 0.25}})
    assert eventually(lambda: received)[0]["linear"]["x"] == 0.25
    unwatch()
    unwatch()
    again: list[Message] = []
    far.watch("/cmd_vel", TWIST, again.append)
    near.publish("/cmd_vel", TWIST, {"linear": {"x": 0.5}})
    eventually(lambda: again)
    assert len(received) == 1


def test_raising_watcher_does_not_affect_the_others(ends: tuple[RosLink, RosLink]) -> None:
    near, far = ends
    received: list[Message] = []

    def fail(message: Message) -> None:
        raise ValueError(message)

    far.watch("/cmd_vel", TWIST, fail)
    far.watch("/cmd_vel", TWIST, received.append)

    def sent_again() -> bool:
        near.publish("/cmd_vel", TWIST, {})
        return len(received) > 1

    eventually(sent_again)


def test_read_returns_the_next_message_or_names_the_silence(ends: tuple[RosLink, RosLink]) -> None:
    near, far = ends
    done = threading.Event()

    def talk() -> None:
        while not done.is_set():
            far.broadcast("/chatter", "std_msgs/msg/String", {"data": "hi"})  # type: ignore[attr-defined]
            done.wait(0.01)

    talker = threading.Thread(target=talk)
    talker.start()
    try:
        assert near.read("/chatter", "std_msgs/msg/String", 20.0)["data"] == "hi"
    finally:
        done.set()
        talker.join()
    with pytest.raises(RosError, match=r"Nothing arrived on /silence within 0.05 s"):
        near.read("/silence", "std_msgs/msg/String", 0.05)


def test_a_closed_link_opens_anew_when_it_is_used(ends: tuple[RosLink, RosLink]) -> None:
    near, far = ends
    near.close()
    received: list[Message] = []
    far.watch("/cmd_vel", TWIST, received.append)
    near.publish("/cmd_vel", TWIST, {"linear": {"x": 1.0}})
    eventually(lambda: received)


def test_service_answers_and_a_missing_one_is_named(stacked: RosLink) -> None:
    assert stacked.call("/arm", ARM_KIND, {"data": True}, 20.0) == {"success": True, "message": "armed"}
    with pytest.raises(RosError, match="No server for the service /disarm"):
        stacked.call("/disarm", ARM_KIND, {"data": True}, 0.1)


def test_reached_goal_reports_its_feedback_and_its_end(stacked: RosLink) -> None:
    felt: list[Message] = []
    report = run_goal(stacked, NAV, NAV_KIND, place(0.05), 40.0, feedback=felt.append)
    assert (report.state, report.over, report.status, report.values["error_code"]) == ("succeeded", True, 4, 0)
    eventually(lambda: felt and "distance_remaining" in felt[-1])


def test_goal_is_cancelled_after_its_time_or_on_request(stacked: RosLink) -> None:
    report = run_goal(stacked, NAV, NAV_KIND, place(100.0), 4.0)
    assert (report.state, report.over, report.ended_by) == ("canceled", True, "its time of 4 s")
    felt: list[Message] = []
    report = run_goal(stacked, NAV, NAV_KIND, place(100.0), 30.0, feedback=felt.append, cancelled=lambda: bool(felt))
    assert (report.state, report.over, report.ended_by) == ("canceled", True, "a stop")


def test_goal_without_a_server_or_cancelled_before_never_begins(stacked: RosLink) -> None:
    with pytest.raises(RosError, match="No server for the action /elsewhere"):
        run_goal(stacked, "/elsewhere", NAV_KIND, place(0.0), 0.1)
    with pytest.raises(RosError, match=r"given up before|No server for"):
        run_goal(stacked, NAV, NAV_KIND, place(0.0), 5.0, cancelled=lambda: True)
