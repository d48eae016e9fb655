"""The signed part of a robot's answer to ``getStatus``."""

from __future__ import annotations

from fixtures.toy_robots import ToyRobot

from strands_robots.device_connect.device_stops import SafetyRegistration
from strands_robots.safety.statements import Purpose, own_key


def test_answer_to_a_nonce_signs_the_cell(robot: ToyRobot) -> None:
    registration = SafetyRegistration("arm-1", robot, None, None, cell="cell-1")
    try:
        answer = registration.facts("a" * 32)
        statement = answer["statement"]
        assert answer["cell"] == statement["cell"] == "cell-1"
        assert own_key(Purpose.LOCKOUT_STATE, "arm-1", statement) is not None
        assert own_key(Purpose.LOCKOUT_STATE, "arm-1", {**statement, "cell": "cell-2"}) is None
    finally:
        registration.leave()
