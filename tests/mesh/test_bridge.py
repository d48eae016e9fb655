"""Two legs as one transport, on two in-memory buses."""

from __future__ import annotations

import json
import threading
from typing import Any

import pytest
from fixtures.waiting import eventually
from tests.mesh.peers import Clock

from strands_robots.mesh.transport import TransportError
from strands_robots.mesh.transport import bridge as bridges
from strands_robots.mesh.transport.bridge import BridgeTransport, LocalPeers, SeenCommands
from strands_robots.mesh.transport.memory import MemoryBus, MemoryTransport


class Down(MemoryTransport):
    """A leg that does not connect."""

    def connect(self) -> None:
        raise TransportError("no broker")


@pytest.fixture
def buses() -> tuple[MemoryBus, MemoryBus]:
    return MemoryBus(), MemoryBus()


def bridge(buses: tuple[MemoryBus, MemoryBus]) -> BridgeTransport:
    made = BridgeTransport(MemoryTransport(buses[0]), MemoryTransport(buses[1], sessionless=True))
    made.connect()
    return made


def on(bus: MemoryBus) -> MemoryTransport:
    transport = MemoryTransport(bus)
    transport.connect()
    return transport


def repairing() -> list[threading.Thread]:
    """The threads that bring up what is missing on a leg of a bridge."""
    return [each for each in threading.enumerate() if each.name == "mesh-bridge-repair"]


def test_presence_goes_both_ways_and_state_stays_local(buses: tuple[MemoryBus, MemoryBus]) -> None:
    both, local, cloud = bridge(buses), on(buses[0]), on(buses[1])
    received: list[tuple[str, str]] = []
    local.declare_subscriber("strands/**", lambda sample: received.append(("local", sample.key)))
    cloud.declare_subscriber("strands/**", lambda sample: received.append(("cloud", sample.key)))
    both.put("strands/a/presence", {"x": 1})
    both.put("strands/a/state", {"x": 1})
    assert received == [("local", "strands/a/presence"), ("cloud", "strands/a/presence"), ("local", "strands/a/state")]


def test_a_command_that_comes_by_both_legs_is_served_once(buses: tuple[MemoryBus, MemoryBus]) -> None:
    both, local, cloud = bridge(buses), on(buses[0]), on(buses[1])
    served: list[str] = []
    both.declare_subscriber("strands/a/cmd", lambda sample: served.append(sample.key))
    body = {"sender_id": "x", "turn_id": "t", "command": {"action": "stop"}, "timestamp": 1.0}
    local.put("strands/a/cmd", body)
    cloud.put("strands/a/cmd", {**body, "timestamp": 2.0})
    assert len(served) == 1
    cloud.put("strands/a/cmd", {**body, "turn_id": "u"})
    assert len(served) == 2


def test_stop_goes_to_the_broker_without_its_session(
    buses: tuple[MemoryBus, MemoryBus],
) -> None:
    both, local, cloud = bridge(buses), on(buses[0]), on(buses[1])
    received: dict[str, dict[str, Any]] = {}
    local.declare_subscriber("strands/safety/estop", lambda sample: received.update(local=json.loads(sample.payload)))
    cloud.declare_subscriber("strands/safety/estop", lambda sample: received.update(cloud=json.loads(sample.payload)))
    both.put("strands/safety/estop", {"peer_id": "a", "t": 1.0, "source_zid": both.session_id})
    assert received == {
        "local": {"peer_id": "a", "t": 1.0, "source_zid": both.session_id},
        "cloud": {"peer_id": "a", "t": 1.0},
    }


def test_message_of_a_local_peer_is_dropped_from_the_cloud_leg(buses: tuple[MemoryBus, MemoryBus]) -> None:
    both, local, cloud = bridge(buses), on(buses[0]), on(buses[1])
    received: list[tuple[str, str | None]] = []
    both.declare_subscriber("strands/*/presence", lambda sample: received.append((sample.key, sample.session)))
    for number, peer in enumerate(["a", "b"]):
        if number == 0:
            local.put(f"strands/{peer}/presence", {"x": 1})
        cloud.put(f"strands/{peer}/presence", {"x": 1})
    assert received == [("strands/a/presence", local.session_id), ("strands/b/presence", cloud.session_id)]


def test_peer_silent_on_the_local_leg_is_no_longer_local() -> None:
    clock = Clock()
    local = LocalPeers(clock)
    local.note("a")
    assert "a" in local
    clock.pass_(4)
    assert "a" not in local
    for number in range(2000):
        local.note(f"p{number}")
    assert "p0" not in local


def test_bridge_is_connected_while_either_leg_is(buses: tuple[MemoryBus, MemoryBus]) -> None:
    half = BridgeTransport(MemoryTransport(buses[0]), Down(buses[1]))
    half.connect()
    assert half.is_alive()
    half.put("strands/a/presence", {"x": 1})
    half.close()
    with pytest.raises(TransportError):
        half.put("strands/a/presence", {"x": 1})
    with pytest.raises(TransportError, match="neither leg"):
        BridgeTransport(Down(buses[0]), Down(buses[1])).connect()


class Late(MemoryTransport):
    """A leg that connects from the third time on."""

    tries = 0

    def connect(self) -> None:
        self.tries += 1
        if self.tries < 3:
            raise TransportError("not yet")
        super().connect()


def test_leg_down_at_start_later_gets_subscribers_and_stops(
    buses: tuple[MemoryBus, MemoryBus], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bridges, "RETRY_S", 0.02)
    late = Late(buses[1], sessionless=True)
    both = BridgeTransport(MemoryTransport(buses[0]), late)
    both.connect()
    cloud = on(buses[1])
    received: list[str] = []
    stops: list[dict[str, Any]] = []
    first = both.declare_subscriber("strands/a/cmd", lambda sample: received.append(sample.key))
    dropped = both.declare_subscriber("strands/b/cmd", lambda sample: received.append(sample.key))
    dropped.undeclare()
    cloud.declare_subscriber("strands/safety/estop", lambda sample: stops.append(json.loads(sample.payload)))
    for count in (0, 2):
        stop = {"peer_id": "a", "t": 1.0, "estop_id": "e" * 32, "source_zid": both.session_id, "peers_silent": count}
        both.put("strands/safety/estop", stop)
    eventually(lambda: stops)
    assert stops == [{"peer_id": "a", "t": 1.0, "estop_id": "e" * 32, "peers_silent": 2}]
    for name in ("b", "a"):
        body = {"sender_id": "x", "turn_id": name, "command": {"action": "stop"}}
        eventually(late.is_alive)
        cloud.put(f"strands/{name}/cmd", body)
    assert received == ["strands/a/cmd"]
    eventually(lambda: not repairing())
    first.undeclare()
    both.close()


def test_a_bridge_that_is_closed_while_a_leg_is_down_leaves_no_thread(buses: tuple[MemoryBus, MemoryBus]) -> None:
    half = BridgeTransport(MemoryTransport(buses[0]), Down(buses[1]))
    half.connect()
    assert repairing()
    half.close()
    eventually(lambda: not repairing())


def test_an_unknown_topic_in_the_setting_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_BRIDGE_TOPICS", "presence, everything")
    with pytest.raises(TransportError, match="everything"):
        BridgeTransport(MemoryTransport(MemoryBus()), MemoryTransport(MemoryBus()))


def test_seen_commands_are_bounded_by_age_and_number() -> None:
    clock = Clock()
    seen = SeenCommands(clock)
    message = b'{"sender_id":"x","turn_id":"t","command":{}}'
    assert seen.first(message) is True
    assert seen.first(message) is False
    clock.pass_(121)
    assert seen.first(message) is True
    assert seen.first(b"no json") is True
    for number in range(10_001):
        seen.first(b'{"sender_id":"x","turn_id":"%d","command":{}}' % number)
    assert seen.first(message) is True


def test_bridge_is_cut_off_where_neither_leg_reaches_anyone(
    buses: tuple[MemoryBus, MemoryBus], monkeypatch: pytest.MonkeyPatch
) -> None:
    both = bridge(buses)
    monkeypatch.setattr(both._local, "anchored", lambda: False)
    assert not both.cut_off(), "the broker's peers are in reach"
    both._cloud.close()
    assert both.cut_off()
