"""Strangers on the mesh of one machine, without certificates, move no real hardware."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from fixtures.waiting import eventually
from tests.integration.mesh.networks import OverZenoh, network

from strands_robots.mesh.console_keys import INPUT, MOTION, ConsoleSigner

TIMES = 15
WAVE = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 60}
APPROVED = {"STRANDS_ROBOT_COMMAND_ALLOW": "start@arm-1,teleop_receive@arm-1"}


@pytest.fixture
def net(tmp_path: Path) -> Iterator[OverZenoh]:
    with network("zenoh", tmp_path, APPROVED) as made:
        assert isinstance(made, OverZenoh)
        for peer_id, robot in {"console": "none", "arm-1": "arm"}.items():
            made.join(peer_id, robot)
        made.peers["console"].sees("arm-1")
        made.peers["arm-1"].sees("console")
        yield made


@pytest.fixture
def stranger(net: OverZenoh) -> Iterator[zenoh.Session]:
    with session(net) as opened:
        yield opened


def session(net: OverZenoh) -> zenoh.Session:
    endpoints = {"endpoints": [f"tcp/127.0.0.1:{net.port}"]}
    config = {"mode": "client", "namespace": "strands", "connect": endpoints}
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def source_of(stranger: zenoh.Session, victim: str) -> Any:
    """The source that the victim puts on its messages, to be copied."""
    received: list[Any] = []
    listening = stranger.declare_subscriber(f"strands/{victim}/presence", received.append)
    source = eventually(lambda: received and received[0].source_info, what=f"a heartbeat of {victim}")
    listening.undeclare()
    return source


def command(**more: Any) -> dict[str, Any]:
    head = {"sender_id": "console", "turn_id": uuid.uuid4().hex, "timestamp": time.time(), "target_id": "arm-1"}
    return {**head, "command": WAVE, **more}


@pytest.mark.parametrize("signature", ["none", "own key", "another purpose"])
def test_stranger_with_a_copied_source_moves_no_hardware(
    net: OverZenoh, stranger: zenoh.Session, signature: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, source = net.peers["arm-1"], source_of(stranger, "console")
    if signature == "another purpose":
        monkeypatch.setenv("STRANDS_STATE_DIR", str(net.folder / "console"))  # what the console signed for a stream
    signer, purpose = ConsoleSigner(), INPUT if signature == "another purpose" else MOTION
    for _ in range(TIMES):
        body = command() if signature == "none" else signer.sign(command(), purpose)
        stranger.put("strands/arm-1/cmd", json.dumps(body), source_info=source)
    eventually(lambda: "wire_motion_refused" in arm.ask("audited"))
    # It is served after the forged ones, so none of them is still on its way.
    assert net.peers["console"].ask("send", "arm-1", {"action": "status"}, 20)["type"] == "response"
    assert arm.ask("moving") is False
    assert net.peers["console"].ask("send", "arm-1", WAVE, 20)["result"]["status"] == "success"
