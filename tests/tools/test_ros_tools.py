"""Tools for a ROS graph: plain calls, and the names of strands-robots 0.5."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
from fixtures.waiting import free_port

from strands_robots.envelope import Envelope, success
from strands_robots.tools import use_ros, use_rosbridge, use_rtps
from strands_robots.utils import ValidationError

TOOLS = [use_ros, use_rosbridge, use_rtps]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The actions that the tools pass on."""
    noted: list[dict[str, Any]] = []

    def ros_action(action: str, **options: Any) -> Envelope:
        noted.append({"action": action, **options})
        return success("done")

    monkeypatch.setattr(sys.modules["strands_robots.tools.ros"], "ros_action", ros_action)
    return noted


@pytest.mark.parametrize("tool", TOOLS)
def test_plain_call_needs_no_tool_context(asked: list[dict[str, Any]], tool: Any) -> None:
    assert tool("status")["status"] == "success"
    assert tool(action="echo", name="/odom")["status"] == "success"
    assert [(each["action"], each["name"], each["tool_context"]) for each in asked] == [
        ("status", "", None),
        ("echo", "/odom", None),
    ]


@pytest.mark.parametrize("tool", TOOLS)
@pytest.mark.parametrize("older", ["topic", "service", "action_name"])
def test_older_name_of_a_topic_service_or_action_is_taken(asked: list[dict[str, Any]], tool: Any, older: str) -> None:
    nothing = dict.fromkeys(("topic", "service", "action_name", "type", "fields"))
    tool(action="info", **{**nothing, older: "/odom"}, timeout=1.0)
    assert (asked[0]["name"], asked[0]["type"], asked[0]["timeout"]) == ("/odom", None, 1.0)


def test_goal_of_the_older_name_is_a_goal(asked: list[dict[str, Any]]) -> None:
    use_ros(action="action_send_goal", action_name="/go", type="p/action/Go", fields={"x": 1})
    assert (asked[0]["action"], asked[0]["name"], asked[0]["fields"]) == ("action_goal", "/go", {"x": 1})


async def test_agent_may_use_the_older_name(asked: list[dict[str, Any]]) -> None:
    use = {"toolUseId": "1", "name": "use_rtps", "input": {"action": "echo", "topic": "/odom"}}
    events = [event async for event in use_rtps.stream(use, {"agent": None})]
    assert asked[0]["name"] == "/odom", events


@pytest.mark.parametrize("tool", TOOLS)
def test_two_names_for_one_thing_are_refused(tool: Any) -> None:
    answer = tool(action="echo", name="/odom", topic="/scan")
    assert answer["status"] == "error"
    assert use_rtps(action="echo", name="/odom or /scan")["reason"].startswith("name must be a ROS name")


@pytest.mark.parametrize(
    ("action", "instead"), [("types", "docs/ros.md"), ("advertise", "publish"), ("subscribe", "echo")]
)
def test_action_that_is_none_here_says_what_to_use(action: str, instead: str) -> None:
    answer = use_rtps(action=action, topic="/cmd_vel", type="geometry_msgs/msg/Twist")
    assert answer["status"] == "error"
    assert instead in answer["reason"]


def test_argument_that_no_version_has_is_refused_by_name() -> None:
    with pytest.raises(TypeError, match="hz"):
        use_ros(action="echo", topic="/odom", hz=3)


@pytest.mark.parametrize("tool", TOOLS)
def test_command_of_an_agent_with_a_misspelt_argument_is_not_sent(asked: list[dict[str, Any]], tool: Any) -> None:
    given = {"action": "publish", "topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "cuont": 5}
    with pytest.raises(ValidationError, match=r"publish takes name, .*, not 'cuont'"):
        tool.stream({"toolUseId": "1", "name": tool.tool_name, "input": given}, {"agent": None})
    assert asked == []


async def test_read_of_an_agent_ignores_what_it_does_not_take(asked: list[dict[str, Any]]) -> None:
    use = {"toolUseId": "1", "name": "use_rtps", "input": {"action": "echo", "name": "/odom", "hz": 3}}
    assert [event async for event in use_rtps.stream(use, {"agent": None})]
    assert asked[0]["name"] == "/odom"


@pytest.mark.parametrize("first", ["strands_robots.tools", "strands_robots.tools.{}"])
@pytest.mark.parametrize("name", ["robot_mesh", "use_ros", "use_rosbridge", "use_rtps"])
def test_both_ways_to_import_a_tool_give_the_same(name: str, first: str) -> None:
    code = (
        f"from {first.format(name)} import {name} as one\n"
        f"from strands_robots.tools.{name} import {name} as two\n"
        f"from strands_robots.tools import {name} as three\n"
        "assert one is two is three and callable(one)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)


def test_goal_without_a_server_is_an_error_and_no_exception() -> None:
    answer = use_rosbridge(action="action_send_goal", action_name="/go", type="p/Go", port=free_port(), timeout=1.0)
    assert answer["reason"].startswith("No connection to rosbridge at ")
