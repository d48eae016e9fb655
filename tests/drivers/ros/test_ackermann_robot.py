from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pytest
from fixtures.ros_bases import Lock
from fixtures.ros_memory import MemoryLink
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from strands_robots.drivers.ros.ackermann_robot import AckermannRosRobot
from strands_robots.ros.gate import CommandGate
from strands_robots.utils import ValidationError

OPEN = CommandGate(lambda _: ("manual_drive", "vehicle_state", "enable_state"), lambda: False)
STATE, ENABLE = "/ctrl_pkg/vehicle_state", "/ctrl_pkg/enable_state"


def ok(_: Mapping[str, Any]) -> dict[str, Any]:
    return {}


def car(link: MemoryLink | None = None, **options: Any) -> AckermannRosRobot:
    link = link or MemoryLink({STATE: ok, ENABLE: ok})
    return AckermannRosRobot.from_deepracer(
        "racer", link=link, **{"publish_rate": 1000.0, "command_gate": OPEN, **options}
    )


def sent(robot: AckermannRosRobot) -> list[dict[str, Any]]:
    assert isinstance(robot.link, MemoryLink)
    return [message for _, message in robot.link.sent]


@hypothesis_settings(max_examples=200, deadline=None)
@given(
    linear=st.floats(-1.5, 1.5).filter(lambda v: abs(v) > 1e-3),
    radius=st.floats(0.3, 50.0),
    left=st.sampled_from([1, -1]),
)
def test_steering_angle_corresponds_to_the_requested_yaw_rate(linear: float, radius: float, left: int) -> None:
    robot = car()
    angular = left * abs(linear) / radius
    message = robot.command_message(linear, angular)
    speed = message["throttle"] * robot.max_speed
    steering = message["angle"] * robot.max_steering_rad
    assert speed == pytest.approx(linear)
    assert speed * math.tan(steering) / robot.wheelbase_m == pytest.approx(angular, rel=1e-9)


@hypothesis_settings(max_examples=200, deadline=None)
@given(linear=st.floats(-1e308, 1e308), angular=st.floats(-1e308, 1e308))
def test_no_command_exceeds_the_servo_range(linear: float, angular: float) -> None:
    message = car().command_message(linear, angular)
    assert -1 <= message["angle"] <= 1
    assert -1 <= message["throttle"] <= 1


def test_a_turn_in_place_is_refused_before_the_handshake() -> None:
    robot = car()
    assert "cannot turn in place" in robot.drive(0.0, 0.5)["reason"]
    assert sent(robot) == []
    assert robot.link.called == []  # type: ignore[attr-defined]


def test_handshake_runs_once_in_order_and_the_drive_ends_with_a_zero() -> None:
    robot = car()
    assert robot.drive(0.75, 0.0, duration=0.003)["status"] == "success"
    assert robot.drive(5.0, 0.0, count=2)["linear"] == 1.5
    assert robot.link.called == [(STATE, {"state": 1}), (ENABLE, {"is_active": True})]  # type: ignore[attr-defined]
    assert [m["throttle"] for m in sent(robot)] == [0.5] * 3 + [0.0] + [1.0] * 2 + [0.0]


def test_failed_handshake_sends_nothing_and_is_repeated_from_its_start() -> None:
    link = MemoryLink({STATE: ok})
    robot = car(link)
    answer = robot.drive(0.5)
    assert (answer["service"], sent(robot)) == (ENABLE, [])
    assert robot.enable()["status"] == "error"
    assert [service for service, _ in link.called] == [STATE, STATE]


@pytest.mark.parametrize("refused", [{"error": 1}, {"error": -2}, {"success": False}, {"error": "no calibration"}])
def test_service_that_answers_a_failure_fails_the_handshake(refused: dict[str, Any]) -> None:
    link = MemoryLink({STATE: ok, ENABLE: lambda _: refused})
    robot = car(link)
    answer = robot.drive(0.5)
    assert (answer["status"], answer["service"], sent(robot)) == ("error", ENABLE, [])
    link.offer(ENABLE, lambda _: {"error": 0, "success": True})
    assert robot.enable()["status"] == "success"
    assert [service for service, _ in link.called] == [STATE, ENABLE, STATE, ENABLE]


def test_unapproved_car_is_neither_armed_nor_driven() -> None:
    drive_only = CommandGate(lambda _: ("manual_drive",), lambda: False)
    robot = car(command_gate=drive_only)
    assert "needs operator approval" in robot.drive(0.5)["reason"]
    assert robot.link.called == []  # type: ignore[attr-defined]
    assert robot.stop()["status"] == "success"
    assert sent(robot)[0] == {"angle": 0.0, "throttle": 0.0}
    robot.disconnect()


def test_a_locked_car_is_not_armed() -> None:
    robot = car()
    robot.gate.attach(Lock())
    assert robot.enable()["reason"] == "enable is locked"
    assert robot.link.called == []  # type: ignore[attr-defined]


def test_stop_needs_no_handshake_and_ends_a_running_one() -> None:
    link = MemoryLink({ENABLE: ok})
    robot = car(link)
    link.offer(STATE, lambda _: {"halted": robot.halt("in between").stopped})
    assert "stopped before /ctrl_pkg/enable_state" in robot.drive(0.5)["reason"]
    assert {m["throttle"] for m in sent(robot)} == {0.0}
    robot.disconnect()


def test_stop_while_the_operator_is_asked_prevents_arming() -> None:
    """Asking takes as long as the operator takes; the handshake is part of the drive that was stopped meanwhile."""
    robot = car(command_gate=CommandGate(lambda _: (), lambda: False))

    class Operator:
        def interrupt(self, name: str, reason: Any = None) -> bool:
            if "manual_drive" in name:
                robot.halt("while they think")
            return True

    assert "halted after it was asked for" in robot.drive(0.5, tool_context=Operator())["reason"]
    assert robot.link.called == []  # type: ignore[attr-defined]
    assert {m["throttle"] for m in sent(robot)} == {0.0}
    robot.disconnect()


def test_drive_tool_states_the_turning_radius_and_the_car_has_no_pose() -> None:
    robot = car()
    assert not hasattr(robot, "get_pose")
    assert robot.min_radius_m == pytest.approx(0.164 / math.tan(0.5236))
    specs = {tool.tool_name: tool.tool_spec for tool in robot.tools}
    assert set(specs) == {"drive_racer", "stop_racer", "status_racer", "get_scan_racer"}
    assert "0.28 m" in specs["drive_racer"]["description"]


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("wheelbase_m", 0),
        ("max_speed", float("nan")),
        ("max_steering_rad", 2.0),
        ("init_services", [{"service": "/a"}]),
        ("init_services", ["/a"]),
        ("init_services", [{"service": "a b", "type": "p/srv/S"}]),
    ],
)
def test_invalid_car_argument_is_refused_by_name(option: str, value: object) -> None:
    with pytest.raises(ValidationError, match=option):
        car(**{option: value})
