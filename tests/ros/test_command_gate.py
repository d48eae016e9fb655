from __future__ import annotations

from typing import Any

import pytest

from strands_robots.ros.gate import CommandGate, surface_of
from strands_robots.ros.link import graph_name, interface
from strands_robots.utils import ValidationError


class Operator:
    """A tool context whose operator gives one answer."""

    def __init__(self, answer: object) -> None:
        self.answer = answer
        self.requests: list[tuple[str, Any]] = []

    def interrupt(self, name: str, reason: Any = None) -> object:
        self.requests.append((name, reason))
        return self.answer


def gate(*allowed: str, bypass: bool = False) -> CommandGate:
    return CommandGate(lambda _: allowed, lambda: bypass)


@pytest.mark.parametrize(
    ("name", "surface"),
    [
        ("/cmd_vel", "cmd_vel"),
        ("/turtle1/cmd_vel", "cmd_vel"),
        ("/cmd_vel_unstamped", "cmd_vel_unstamped"),
        ("/nav/cmd_vel_raw", "cmd_vel"),
        ("/arm/joint_command", "joint_command"),
        ("/navigate_to_pose/_action/send_goal", "navigate_to_pose"),
        ("vehicle_state", "vehicle_state"),
        ("/Base/CMD_VEL", "cmd_vel"),
        ("~joint_command", "joint_command"),
        ("~/joint_command", "joint_command"),
        ("~cmd_vel", "cmd_vel"),
        ("/left_joint_command", "joint_command"),
        ("/left_joint_commands", "joint_commands"),
        ("/right_arm/left_joint_trajectory", "joint_trajectory"),
        ("/arm/follow_joint_trajectory/_action/send_goal", "follow_joint_trajectory"),
        ("/move_base_simple/goal", "move_base_simple"),
        ("/forward_position_controller/commands", "commands"),
        ("/joint_states", None),
        ("/joint_command_echo", None),
        ("/odom", None),
        ("/scan", None),
    ],
)
def test_command_surface_is_recognized_by_a_part_of_its_name(name: str, surface: str | None) -> None:
    assert surface_of(name) == surface


def test_twist_is_a_velocity_command_on_any_topic() -> None:
    assert surface_of("/base/please", "geometry_msgs/msg/Twist") == "cmd_vel"
    assert surface_of("/base/please", "geometry_msgs/Twist") == "cmd_vel"
    assert surface_of("/chatter", "std_msgs/msg/String") is None


def test_harmless_topic_needs_no_approval() -> None:
    operator = Operator("no")
    assert gate().refusal("/chatter", "std_msgs/msg/String", "publish", operator) is None
    assert operator.requests == []


@pytest.mark.parametrize("entry", ["cmd_vel", "/turtle1/cmd_vel", "/turtle1/*"])
def test_a_listed_surface_or_name_passes_without_asking(entry: str) -> None:
    operator = Operator("no")
    assert gate(entry).refusal("/turtle1/cmd_vel", None, "drive", operator) is None
    assert operator.requests == []


def test_a_list_for_another_surface_does_not_pass() -> None:
    assert gate("joint_command", "/turtle2/*").refusal("/turtle1/cmd_vel", None, "drive") is not None


def test_a_bypass_passes_without_asking() -> None:
    assert gate(bypass=True).refusal("/cmd_vel", None, "drive") is None


@pytest.mark.parametrize("answer", [True, "yes", " Y ", "approve"])
def test_the_operator_may_approve(answer: object) -> None:
    assert gate().refusal("/cmd_vel", None, "drive", Operator(answer)) is None


@pytest.mark.parametrize("answer", [False, "no", "", None, 1, {"approve": True}])
def test_anything_but_a_yes_refuses(answer: object) -> None:
    refusal = gate().refusal("/cmd_vel", None, "drive", Operator(answer))
    assert refusal is not None
    assert "did not approve" in refusal["reason"]


def test_refusal_without_an_operator_names_the_setting() -> None:
    refusal = gate().refusal("/cmd_vel", None, "drive", None)
    assert refusal is not None
    assert refusal["surface"] == "cmd_vel"
    assert "STRANDS_ROS2_COMMAND_ALLOW" in refusal["reason"]


@pytest.mark.parametrize("name", ["", "/", "cmd vel", "/1st", "a//b", "a__b", "/a/", 3, None, "x" * 256])
def test_invalid_graph_name_is_refused_by_its_argument(name: object) -> None:
    with pytest.raises(ValidationError, match="topic must be a ROS name"):
        graph_name("topic", name)


@pytest.mark.parametrize("kind", ["Twist", "geometry_msgs", "geometry_msgs/twist", "a/b/C", "", None, "g/msg/T;x"])
def test_invalid_interface_type_is_refused_by_its_argument(kind: object) -> None:
    with pytest.raises(ValidationError, match="kind must be a ROS type"):
        interface("kind", kind)
