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
    both, near, far = bridge(buses), on(buses[0]), on(buses[1])
    heard: list[tuple[str, str]] = []
    near.declare_subscriber("strands/**", lambda sample: heard.append(("near", sample.key)))
    far.declare_subscriber("strands/**", lambda sample: heard.append(("far", sample.key)))
    both.put("strands/a/presence", {"x": 1})
    both.put("strands/a/state", {"x": 1})
    assert heard == [("near", "strands/a/presence"), ("far", "strands/a/presence"), ("near", "strands/a/state")]


def test_a_command_that_comes_by_both_legs_is_served_once(buses: tuple[MemoryBus, MemoryBus]) -> None:
    both, near, far = bridge(buses), on(buses[0]), on(buses[1])
    served: list[str] = []
    both.declare_subscriber("strands/a/cmd", lambda sample: served.append(sample.key))
    body = {"sender_id": "x", "turn_id": "t", "command": {"action": "stop"}, "timestamp": 1.0}
    near.put("strands/a/cmd", body)
    far.put("strands/a/cmd", {**body, "timestamp": 2.0})
    assert len(served) == 1
    far.put("strands/a/cmd", {**body, "turn_id": "u"})
    assert len(served) == 2


def test_stop_goes_to_the_broker_without_its_session(
    buses: tuple[MemoryBus, MemoryBus],
) -> None:
    both, near, far = bridge(buses), on(buses[0]), on(buses[1])
    heard: dict[str, dict[str, Any]] = {}
    near.declare_subscriber("strands/safety/estop", lambda sample: heard.update(near=json.loads(sample.payload)))
    far.declare_subscriber("strands/safety/estop", lambda sample: heard.update(far=json.loads(sample.payload)))
    both.put("strands/safety/estop", {"peer_id": "a", "t": 1.0, "source_zid": both.session_id})
    assert heard == {
        "near": {"peer_id": "a", "t": 1.0, "source_zid": both.session_id},
        "far": {"peer_id": "a", "t": 1.0},
    }


def test_message_of_a_local_peer_is_dropped_from_the_cloud_leg(buses: tuple[MemoryBus, MemoryBus]) -> None:
    both, near, far = bridge(buses), on(buses[0]), on(buses[1])
    heard: list[tuple[str, str | None]] = []
    both.declare_subscriber("strands/*/presence", lambda sample: heard.append((sample.key, sample.session)))
    for number, peer in enumerate(["a", "b"]):
        if number == 0:
            near.put(f"strands/{peer}/presence", {"x": 1})
        far.put(f"strands/{peer}/presence", {"x": 1})
    assert heard == [("strands/a/presence", near.session_id), ("strands/b/presence", far.session_id)]


def test_peer_silent_on_the_local_leg_is_no_longer_local() -> None:
    clock = Clock()
    near = LocalPeers(clock)
    near.note("a")
    assert "a" in near
    clock.pass_(4)
    assert "a" not in near
    for number in range(2000):
        near.note(f"p{number}")
    assert "p0" not in near


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
    far = on(buses[1])
    heard: list[str] = []
    stops: list[dict[str, Any]] = []
    kept = both.declare_subscriber("strands/a/cmd", lambda sample: heard.append(sample.key))
    dropped = both.declare_subscriber("strands/b/cmd", lambda sample: heard.append(sample.key))
    dropped.undeclare()
    far.declare_subscriber("strands/safety/estop", lambda sample: stops.append(json.loads(sample.payload)))
    for count in (0, 2):
        stop = {"peer_id": "a", "t": 1.0, "estop_id": "e" * 32, "source_zid": both.session_id, "peers_silent": count}
        both.put("strands/safety/estop", stop)
    eventually(lambda: stops)
    assert stops == [{"peer_id": "a", "t": 1.0, "estop_id": "e" * 32, "peers_silent": 2}]
    for name in ("b", "a"):
        body = {"sender_id": "x", "turn_id": name, "command": {"action": "stop"}}
        eventually(late.is_alive)
        far.put(f"strands/{name}/cmd", body)
    assert heard == ["strands/a/cmd"]
    eventually(lambda: not repairing())
    kept.undeclare()
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
