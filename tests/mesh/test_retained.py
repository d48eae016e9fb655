"""What a broker stored and delivers at a subscription: recorded, so nothing of it moves a robot or vouches for one."""

from __future__ import annotations

import json
import logging
from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, received

from strands_robots.mesh.transport import Sample

WAVE = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 60}
STORED = [
    WAVE,
    {**WAVE, "action": "execute"},
    {"action": "step", "steps": 1},
    {"action": "reset"},
    {"action": "status"},
    {"action": "ping"},
    {"action": "teleop_receive", "source_peer_id": "leader-1"},
    {"action": 5},
    "start",
    None,
]


def deliver(peers: Fleet, key: str, body: dict[str, Any], *, retained: bool = True) -> None:
    """Hand a message to those who subscribe, as MQTT does."""
    sample = Sample(key, json.dumps(body).encode(), None, sessionless=True, retained=retained)
    peers.bus.deliver(peers.stranger(), sample)


def command(peers: Fleet, what: object, turn: int = 1) -> dict[str, Any]:
    return {"sender_id": "console", "turn_id": f"{turn:032x}", "timestamp": peers.clock(), "command": what}


@pytest.mark.parametrize("key", ["strands/sim-1/cmd", "strands/broadcast"])
@pytest.mark.parametrize("what", STORED)
def test_stored_command_is_refused_by_name_and_not_answered(
    peers: Fleet, caplog: pytest.LogCaptureFixture, key: str, what: object
) -> None:
    world = World("left")
    peers.join(world, "sim-1", "sim")
    answers = received(peers, "strands/console/response/**")
    with caplog.at_level(logging.WARNING):
        deliver(peers, key, command(peers, what))
        eventually(lambda: peers.events("command_refused") or peers.events("command_rejected"))
    assert world.running == {}
    assert answers == []
    assert "of console on" in caplog.text and "the broker stored it" in caplog.text


def test_stored_stop_halts(peers: Fleet) -> None:
    arm = Arm()
    peers.join(arm, "sim-1", "sim")
    deliver(peers, "strands/sim-1/cmd", command(peers, {"action": "stop"}))
    eventually(lambda: arm.halts)
    assert arm.gate.refusal("start") is None, "a plain stop locks nothing"


def test_flood_of_stored_commands_is_a_line_a_second(peers: Fleet, caplog: pytest.LogCaptureFixture) -> None:
    peers.join(Arm(), "sim-1", "sim")
    with caplog.at_level(logging.WARNING):
        for number in range(500):
            deliver(peers, "strands/sim-1/cmd", command(peers, WAVE, number))
    assert 1 <= sum("the broker stored it" in each.message for each in caplog.records) < 50


def test_stored_check_in_shows_no_living_controller(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_CHECKIN_TIMEOUT_S", "30")
    peers.join(Arm(), "sim-1", "sim")
    body = {"peer_id": "console", "estop_id": "ab" * 16, "t": peers.clock()}
    deliver(peers, "strands/console/checkin", body)
    eventually(lambda: peers.events("checkin_rejected"))
    assert peers.events("checkin_rejected")[0]["reason"] == "the broker stored it"
