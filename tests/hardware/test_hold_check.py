"""Stops of foreign drivers that cannot be held by the positions that they tell."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.devices import RecordingDevice

from strands_robots.hardware import HardwareRobot
from strands_robots.hardware.hold_check import HoldCheck


class TurnedDevice(RecordingDevice):
    """The targets of its pan have the other sign than its positions."""

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        taken = {key: -value if key == "pan.pos" else value for key, value in action.items()}
        return super().send_action(taken)


class BlindDevice(RecordingDevice):
    """It tells where pan and lift are, and of the grip only what it was told."""

    def __init__(self) -> None:
        super().__init__()
        self.told: dict[str, float] = {"grip.pos": 99.0, "age_ms": 4.0}

    @property
    def observation_features(self) -> dict[str, Any]:
        return {"pan.pos": float, "lift.pos": float}

    def get_observation(self) -> dict[str, Any]:
        return super().get_observation() | self.told


def connected(device: RecordingDevice) -> HardwareRobot:
    robot = HardwareRobot(device, "arm")
    robot.connect()
    return robot


def test_joint_whose_targets_are_turned_is_not_said_to_be_stopped_nor_moved_again() -> None:
    device = TurnedDevice()
    robot = connected(device)
    robot.get_state()
    assert robot.send_action({"pan.pos": 11.0, "lift.pos": 5.0})["status"] == "success"
    for _ in range(2):
        written = len(device.writes)
        verdict = robot.halt("test")
        assert verdict.stopped is not True
        assert "was at 10, was told 11 and took -11" in str(verdict.envelope())
        assert all("pan.pos" not in write.action for write in device.writes[written:])


def test_joint_that_tells_no_position_is_not_said_to_be_stopped() -> None:
    device = BlindDevice()
    robot = connected(device)
    assert robot.get_state()["joints"] == {"pan.pos": 10.0, "lift.pos": 10.0}
    assert robot.halt("nothing was told").stopped is True
    robot.send_action({"grip.pos": 20.0})
    verdict = robot.halt("test")
    assert verdict.stopped is not True
    assert "does not say where grip.pos is; only a hold() of its own" in str(verdict.envelope())
    assert device.positions["grip.pos"] == 20.0


def test_hold_of_its_own_stops_any_device(monkeypatch: pytest.MonkeyPatch) -> None:
    device = BlindDevice()
    monkeypatch.setattr(device, "hold", device.told.clear, raising=False)
    robot = connected(device)
    robot.send_action({"grip.pos": 20.0})
    assert robot.halt("test").stopped is True
    assert device.told == {}


class ArmOnBase(RecordingDevice):
    """It needs the speed of its base in every action, as LeRobot's LeKiwi does."""

    def __init__(self) -> None:
        super().__init__()
        self.positions["x.vel"] = 0.0

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        return super().send_action({**action, "x.vel": action["x.vel"]})


def test_base_that_an_action_does_not_name_is_told_to_stand() -> None:
    device = ArmOnBase()
    robot = connected(device)
    assert robot.send_action({"pan.pos": 11.0})["status"] == "success"
    assert device.writes[-1].action == {"pan.pos": 11.0, "x.vel": 0.0}
    assert robot.send_action({"x.vel": 0.2})["status"] == "success"
    assert device.writes[-1].action == {"x.vel": 0.2}
    assert robot.halt("test").stopped is True


def test_driver_that_bounds_a_step_or_a_range_may_take_something_else() -> None:
    check = HoldCheck("arm")
    check.note(
        {"pan": 90.0, "lift": 120.0, "grip": -0.5},
        {"pan": 15.0, "lift": 100.0, "grip": 0.0},
        {"pan": 10.0, "lift": 95.0, "grip": 0.2},
    )
    assert not check.turned
    assert check.problem({"pan": 10.0, "lift": 95.0, "grip": 0.2}, moving=["pan", "lift", "grip"]) == ""
    assert "where lift is" in check.problem({"pan": 10.0, "grip": 0.2}, moving=["pan", "lift", "grip"])
    check.held()
    assert check.problem({}, moving=["pan", "lift", "grip"]) == ""
