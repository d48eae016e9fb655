"""A mesh under mutual TLS over a network that parts and loses."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.mesh_peer import MeshPeer
from fixtures.network_lab import NetworkLab, Side, Weather, missing
from fixtures.waiting import eventually

from strands_robots.mesh.transport import config

pytestmark = pytest.mark.system

PORT = 7447


@pytest.fixture
def lab() -> Iterator[NetworkLab]:
    if why := missing():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(why)
    with NetworkLab() as made:
        yield made


class Site:
    """An arm, a simulation and a remote console, all connected to the arm."""

    def __init__(self, lab: NetworkLab, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack = folder, stack
        config.make_authority(folder / "keys")
        here = f"tls/{lab.here.address}:{PORT}"
        self.arm = self._join("arm-1", "arm", lab.here, ZENOH_LISTEN=here)
        self.sim = self._join("sim-1", "world", lab.here, ZENOH_CONNECT=here)
        self.console = self._join("console", "none", lab.there, ZENOH_CONNECT=here)
        self.console.sees("arm-1", "sim-1")
        self.arm.sees("console", "sim-1")
        self.sim.sees("console", "arm-1")

    def _join(self, peer_id: str, robot: str, side: Side, **settings: str) -> MeshPeer:
        issued = config.issue_certificate(self._folder / "keys", peer_id, (side.address,))
        state = self._folder / peer_id
        state.mkdir(mode=0o700)
        approved = {"STRANDS_ROBOT_COMMAND_ALLOW": "start@arm-1,teleop_receive@arm-1"}
        given = {"STRANDS_STATE_DIR": str(state), **approved, **issued.settings(), **settings}
        peer = MeshPeer(peer_id, robot, given, side.within)
        self._stack.callback(peer.close)
        return peer

    def answers(self) -> None:
        """Wait until the arm answers the console."""
        eventually(lambda: self.console.ask("ping", "arm-1", 1.0)["status"] == "ok", what="the arm answers")


@pytest.fixture
def site(lab: NetworkLab, tmp_path: Path) -> Iterator[Site]:
    with ExitStack() as stack:
        yield Site(lab, tmp_path, stack)
        # Processes say goodbye, which needs a network.
        lab.weather = Weather()


def test_a_short_partition_costs_an_answer_and_no_binding(site: Site, lab: NetworkLab) -> None:
    bound = site.console.ask("zid", "arm-1")
    lab.weather.parted = True
    assert site.console.ask("ping", "arm-1", 0.5)["status"] == "timeout"
    assert site.sim.ask("ping", "arm-1")["status"] == "ok"
    lab.weather.parted = False
    site.answers()
    assert site.console.ask("zid", "arm-1") == bound
    assert lab.dropped > 0


def test_long_partition_removes_peers_and_heals_by_itself(site: Site, lab: NetworkLab) -> None:
    site.arm.ask("start", "wave")
    lab.weather.parted = True
    eventually(lambda: site.console.ask("reachable") == [], what="the remote side is out of reach")
    eventually(lambda: site.arm.ask("reachable") == ["sim-1"])
    assert site.sim.ask("ping", "arm-1")["status"] == "ok"
    # A stop of the remote side reaches no peer now, reports that, and is repeated when the link is back.
    assert site.console.ask("estop")[1] == []
    assert site.arm.ask("moving") is True
    lab.weather.parted = False
    for peer in (site.arm, site.sim):
        eventually(lambda peer=peer: peer.ask("epoch") == site.console.ask("epoch"), within=40)
    eventually(lambda: site.arm.ask("moving") is False, what="it stands still")
    site.answers()


def test_commands_stops_and_streams_come_through_loss_delay_and_jitter(site: Site, lab: NetworkLab) -> None:
    lab.weather = Weather(delay_s=0.03, jitter_s=0.02, loss=0.1)
    for _ in range(10):
        assert site.console.ask("ping", "arm-1")["status"] == "ok"
    start = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 60}
    assert site.console.ask("send", "arm-1", start, 20)["result"]["status"] == "success"
    assert site.console.ask("send", "arm-1", {"action": "stop"}, 20)["result"]["ok"] is True
    assert site.arm.ask("follow", "console") is None
    site.console.ask("lead")
    eventually(lambda: len(site.arm.ask("actions")) >= 50, what="fifty frames are applied")
    sent = site.console.ask("rest")
    moved = [action["shoulder.pos"] for action in site.arm.ask("actions")]
    assert moved == sorted(moved)
    assert site.arm.ask("unfollow")["frames_received"] <= sent["frames"]
    assert {"arm-1", "sim-1"} <= set(site.console.ask("reachable"))
    site.arm.ask("start", "wave")
    site.sim.ask("start", "wave")
    answers = site.console.ask("estop")[1]
    assert {answer["responder_id"] for answer in answers} == {"arm-1", "sim-1"}
    assert site.arm.ask("epoch") == site.sim.ask("epoch") == site.console.ask("epoch")
    eventually(lambda: site.arm.ask("moving") is False and site.sim.ask("moving") == [])
    assert lab.dropped > 0
