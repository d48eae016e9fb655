"""A leader arm is asked again, connected in one piece and let go whatever happened to its cable."""

from __future__ import annotations

import pytest

from strands_robots.hardware import LeaderArm


class Device:
    """A leader that loses some answers."""

    def __init__(self, lost: int = 0, *, gone: bool = False) -> None:
        self.lost, self.gone = lost, gone
        self.is_connected = False

    def connect(self, calibrate: bool = True) -> None:
        assert not calibrate, "nobody is asked at a prompt"
        self.is_connected = True

    def disconnect(self) -> None:
        if self.gone:
            raise ConnectionError("no status packet")
        self.is_connected = False

    def get_action(self) -> dict[str, float]:
        self.lost -= 1
        if self.lost >= 0:
            raise ConnectionError("no status packet")
        return {"pan.pos": 1.0}


def test_a_lost_answer_is_asked_for_again_and_three_are_an_error() -> None:
    with LeaderArm(Device(lost=2)) as arm:
        assert arm.is_connected
        assert arm.get_action() == {"pan.pos": 1.0}
    with LeaderArm(Device(lost=3)) as arm, pytest.raises(ConnectionError):
        arm.get_action()


def test_an_arm_whose_cable_is_out_is_let_go() -> None:
    with LeaderArm(Device(gone=True)) as arm:
        assert arm.get_teleop_events() is None
