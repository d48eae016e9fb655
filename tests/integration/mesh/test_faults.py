"""Peers in processes that are killed, restarted and suspended."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Sequence
from typing import Any

import psutil
import pytest
import zenoh
from fixtures.mesh_peer import MeshPeer
from fixtures.waiting import accepts, eventually
from tests.integration.mesh.conftest import Join


def meet(peers: Sequence[MeshPeer], within: float = 20.0) -> None:
    """Wait until each has all the others in reach."""
    for peer in peers:
        peer.sees(*(other.peer_id for other in peers if other is not peer), within=within)


def all_answer_all(peers: Sequence[MeshPeer]) -> None:
    for peer in peers:
        for other in peers:
            if other is not peer:
                eventually(
                    lambda peer=peer, other=other: peer.ask("ping", other.peer_id, 0.5)["status"] == "ok",
                    within=20,
                    what=f"{other.peer_id} answers {peer.peer_id}",
                )


def listened_on(peer: MeshPeer) -> set[int]:
    """The TCP ports that the peer's process listens on."""
    links = psutil.Process(peer.pid).net_connections("tcp")
    return {link.laddr.port for link in links if link.status == psutil.CONN_LISTEN}


def test_two_peers_outlive_a_restart_of_the_other_and_of_their_own_session(join: Join) -> None:
    hub, child = join("hub", "none"), join("child")
    meet([hub, child])
    child.close()
    eventually(lambda: hub.ask("reachable") == [])
    child = join("child")
    meet([hub, child])
    for each in (child, hub):
        assert each.ask("restart") is True
        meet([hub, child])
        all_answer_all([hub, child])


def test_five_peers_lose_their_hub_and_get_it_back(join: Join, port: int) -> None:
    hub = join("hub", "none")
    others = [join("console", "none"), join("arm-1", "arm"), join("sim-1"), join("sim-2")]
    meet([hub, *others])
    all_answer_all([hub, *others])
    sessions = {each.peer_id: others[0].ask("zid", each.peer_id) for each in others[1:]}
    hub.kill()
    eventually(lambda: accepts(port), what="a survivor takes the port")
    all_answer_all(others)

    def broadcast() -> list[str]:
        return sorted(each["responder_id"] for each in others[0].ask("broadcast", {"action": "ping"}, 0.7))

    eventually(lambda: broadcast() == ["arm-1", "sim-1", "sim-2"])
    # No session was reopened: every peer is still bound to the one that it announced itself from.
    assert {each.peer_id: others[0].ask("zid", each.peer_id) for each in others[1:]} == sessions
    back = join("hub", "none")
    meet([back, *others])
    all_answer_all([back, *others])
    # The relay that took over ends as well, and those that are left find each other once more.
    [relay] = [each for each in others if port in listened_on(each)]
    relay.kill()
    left = [back, *(other for other in others if other is not relay)]
    eventually(lambda: accepts(port), what="the next survivor takes the port")
    all_answer_all(left)


def test_suspended_robot_is_reported_silent_and_stops_when_it_continues(join: Join) -> None:
    console, arm = join("console", "none"), join("arm-1", "arm")
    meet([console, arm])
    arm.ask("start", "wave")
    arm.signal(signal.SIGSTOP)
    answers = console.ask("estop")[1]
    assert answers == []
    arm.signal(signal.SIGCONT)
    eventually(lambda: arm.ask("epoch") == console.ask("epoch"))
    eventually(lambda: arm.ask("moving") is False, what="it stands still")


def test_stop_arrives_when_a_suspended_hub_continues(join: Join, port: int) -> None:
    hub = join("hub", "none")
    console, arm = join("console", "none"), join("arm-1", "arm")
    meet([hub, console, arm])
    arm.ask("start", "wave")
    hub.signal(signal.SIGSTOP)
    stopped = time.monotonic()
    assert console.ask("ping", "arm-1", 0.5)["status"] == "timeout"
    # Beyond the link's lease of 4 s, so that nothing waits in the hub's buffers.
    time.sleep(max(0.0, 5.0 - (time.monotonic() - stopped)))
    answers = console.ask("estop")[1]
    assert answers == []
    assert arm.ask("epoch") is None
    hub.signal(signal.SIGCONT)
    eventually(lambda: arm.ask("epoch") == console.ask("epoch"), within=20)
    eventually(lambda: arm.ask("moving") is False, what="it stands still")
    meet([hub, console, arm])
    all_answer_all([hub, console, arm])


def test_a_suspended_hub_that_is_killed_is_replaced(join: Join, port: int) -> None:
    hub = join("hub", "none")
    console, sim = join("console", "none"), join("sim-1")
    meet([hub, console, sim])
    hub.signal(signal.SIGSTOP)
    assert console.ask("ping", "sim-1", 0.3)["status"] == "timeout"
    hub.kill()
    eventually(lambda: accepts(port), what="a survivor takes the port")
    all_answer_all([console, sim])


def test_stated_endpoints_connect_in_any_order_and_outlive_the_listener(join: Join, port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{port}"
    one, two = join("sim-1", ZENOH_CONNECT=endpoint), join("sim-2", ZENOH_CONNECT=endpoint)
    console = join("console", "none", ZENOH_LISTEN=endpoint)
    # Those that are connected to a third hear each other through it.
    meet([console, one, two])
    all_answer_all([console, one, two])
    console.kill()
    console = join("console", "none", ZENOH_LISTEN=endpoint)
    meet([console, one, two])
    all_answer_all([console, one, two])
    one.ask("start", "wave")
    assert {each["responder_id"] for each in two.ask("estop")[1]} == {"console", "sim-1", "sim-2"}
    eventually(lambda: one.ask("moving") == [], what="it stands still")


@pytest.mark.parametrize("mode", ["peer", "client", "router"])
def test_a_bare_session_of_any_mode_takes_part_through_the_listener(join: Join, port: int, mode: str) -> None:
    endpoint = f"tcp/127.0.0.1:{port}"
    console = join("console", "none", ZENOH_LISTEN=endpoint)
    sim = join("sim-1", ZENOH_CONNECT=endpoint)
    config: dict[str, Any] = {"mode": mode, "namespace": "strands", "connect": {"endpoints": [endpoint]}}
    config["scouting"] = {"multicast": {"enabled": False}}
    if mode != "client":
        config["listen"] = {"endpoints": ["tcp/127.0.0.1:0"]}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as bare:
        received: list[str] = []
        bare.declare_subscriber("strands/*/presence", lambda sample: received.append(str(sample.key_expr)))
        eventually(lambda: {"strands/console/presence", "strands/sim-1/presence"} <= set(received))

        def seen() -> bool:
            heartbeat = {"robot_id": "bare", "robot_type": "robot", "timestamp": time.time()}
            source = zenoh.SourceInfo(bare.id, 0)
            bare.put("strands/bare/presence", json.dumps(heartbeat).encode(), source_info=source)
            return all("bare" in peer.ask("reachable") for peer in (console, sim))

        eventually(seen)
        assert sim.ask("zid", "bare") == console.ask("zid", "bare") == str(bare.id.zid)
