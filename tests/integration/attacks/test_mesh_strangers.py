"""Strangers on the mesh of one machine, without certificates, move no real hardware.

A thousand tries of each kind: ``make bench ARGS=attacks``.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.mesh_strangers import APPROVED, WAVE, Stranger, stranger_on
from fixtures.waiting import eventually
from tests.integration.mesh.networks import OverZenoh, network

from strands_robots.mesh.session import SESSION_PEERS_MAX

TRIES = 15
KINDS = ["unsigned", "copied source", "wrong key", "another purpose", "replay", "ghosts and a stolen name"]


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
def stranger(net: OverZenoh) -> Iterator[Stranger]:
    with stranger_on(net.port, net.folder) as opened:
        yield opened


@pytest.mark.parametrize("kind", KINDS)
def test_stranger_moves_no_hardware(net: OverZenoh, stranger: Stranger, kind: str) -> None:
    assert list(stranger.kinds()) == KINDS
    arm, console = net.peers["arm-1"], net.peers["console"]
    stranger.capture(lambda: console.ask("send", "arm-1", WAVE, 20))
    assert console.ask("send", "arm-1", {"action": "stop"}, 20)["type"] == "response"
    assert arm.ask("started") == ["wave"]
    assert stranger.attack(kind, TRIES) == []
    assert (arm.ask("started"), arm.ask("moving")) == (["wave"], False)
    assert console.ask("send", "arm-1", WAVE, 20)["result"]["status"] == "success"
    assert arm.ask("started") == ["wave", "wave"]


def test_flood_of_names_takes_no_living_peers_place_and_hides_no_frozen_robot(
    net: OverZenoh, stranger: Stranger
) -> None:
    arm, console = net.peers["arm-1"], net.peers["console"]
    bound = {"arm-1": console.ask("zid", "arm-1"), "console": arm.ask("zid", "console")}
    with stranger_on(net.port, net.folder) as another:
        for each in (stranger, another):
            assert each.attack("ghosts and a stolen name", 30) == []
    assert {"arm-1": console.ask("zid", "arm-1"), "console": arm.ask("zid", "console")} == bound
    assert len(console.ask("peers")) <= SESSION_PEERS_MAX + 1, "those that state no session share one bound"
    assert "presence_left_out" in console.ask("audited")
    assert "presence_identity_conflict" in console.ask("audited")
    arm.signal(signal.SIGSTOP)  # type: ignore[attr-defined]
    try:
        console.ask("estop")
        assert "arm-1" in eventually(lambda: console.ask("silent"))
    finally:
        arm.signal(signal.SIGCONT)  # type: ignore[attr-defined]
    eventually(lambda: arm.ask("epoch"), what="it is locked when it wakes")
