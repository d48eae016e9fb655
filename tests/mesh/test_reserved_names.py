"""Words that are levels of the topics: no peer of ours takes one, and none of another release commands by one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, received

from strands_robots import Robot
from strands_robots.device_connect import init_device_connect_sync
from strands_robots.device_connect.backends import loopback_config
from strands_robots.mesh import init_mesh
from strands_robots.mesh.transport import config
from strands_robots.utils import RESERVED_DEVICE_IDS, RESERVED_IDS, own_device_id, peer_id

WAVE = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 60}


@pytest.mark.parametrize("name", RESERVED_IDS)
def test_no_peer_takes_a_level_of_the_topics_on_either_network(tmp_path: Path, name: str) -> None:
    domain = f"peer_id must not be .*{name}"
    with pytest.raises(ValueError, match=domain):
        init_mesh(ToyRobot(), name)
    with pytest.raises(ValueError, match=domain):
        Robot("so100", peer_id=name)
    config.make_authority(tmp_path)
    with pytest.raises(ValueError, match=domain):
        config.issue_certificate(tmp_path, name)
    with pytest.raises(ValueError, match=domain):
        config.named_rules([name])


@pytest.mark.parametrize("name", RESERVED_DEVICE_IDS)
def test_no_device_takes_a_level_of_the_subjects(name: str) -> None:
    with pytest.raises(ValueError, match=f"peer_id must not be .*{name}"):
        init_device_connect_sync(ToyRobot(), name, link=loopback_config())


@pytest.mark.parametrize("name", ["safety-1", "Safety", "broadcaster", "safety__left", "safety_1"])
def test_a_name_that_only_resembles_one_is_taken(name: str) -> None:
    assert peer_id("peer_id", name) == own_device_id("peer_id", name) == name


@pytest.fixture
def approved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")


def command(peers: Fleet, sender: str, what: dict[str, Any], turn: int) -> dict[str, Any]:
    head = {"sender_id": sender, "turn_id": f"{turn:032x}", "timestamp": peers.clock(), "target_id": "sim-1"}
    return {**head, "command": what}


@pytest.mark.parametrize("name", RESERVED_IDS)
def test_foreign_peer_of_such_a_name_is_not_listed_and_moves_nothing_yet_stops(
    peers: Fleet, approved: None, name: str
) -> None:
    arm = Arm()
    mesh = peers.join(arm, "sim-1", "sim")
    below = received(peers, f"strands/{name}/**")
    stranger = peers.stranger()
    stranger.put(f"strands/{name}/presence", {"robot_id": name, "timestamp": peers.clock()})
    eventually(lambda: peers.events("presence_rejected"))
    assert name not in mesh.peers_by_id
    stranger.put("strands/sim-1/cmd", command(peers, name, WAVE, 1))
    eventually(lambda: peers.events("command_refused"))
    assert arm.started == []
    halts = len(arm.halts)
    stranger.put("strands/sim-1/cmd", command(peers, name, {"action": "stop"}, 2))
    eventually(lambda: len(arm.halts) > halts, what="the stop is carried out")
    assert [each for each in below if "responder_id" in each] == [], "nothing is answered below the safety topics"
    session = stranger.session_id
    stop = {"peer_id": name, "t": peers.clock(), "estop_id": "ab" * 16, "source_zid": session}
    stranger.put("strands/safety/estop", stop)
    eventually(lambda: arm.gate.refusal("start"), what="its emergency stop locks")


def test_such_a_name_is_no_target(peers: Fleet) -> None:
    console = peers.join(None, "console")
    sent = received(peers, "strands/safety/**")
    for name in RESERVED_IDS:
        assert "target must be a peer id" in str(console.send(name, {"action": "ping"}))
    assert sent == []
