"""Presence, the registry of peers, and the binding of a peer to its session."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Clock, Fleet

from strands_robots.mesh import presence, topics
from strands_robots.mesh.core import Mesh, get_local_robots, init_mesh
from strands_robots.mesh.presence import PresenceListener, PresencePublisher
from strands_robots.mesh.scheduler import AuditThrottle
from strands_robots.mesh.session import Context, PeerRegistry
from strands_robots.mesh.transport import TransportError
from strands_robots.mesh.transport import bridge as bridges
from strands_robots.mesh.transport.bridge import BridgeTransport
from strands_robots.mesh.transport.memory import MemoryBus, MemoryTransport
from strands_robots.mesh.wire_identity import Identity
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.utils import ValidationError


def heartbeat(peers: Fleet, peer: str, **fields: Any) -> dict[str, Any]:
    return {"robot_id": peer, "robot_type": "robot", "hostname": "host", "timestamp": peers.clock(), **fields}


def test_peers_see_each_other_with_their_descriptions(peers: Fleet) -> None:
    arm = peers.join(Arm("so100"), "arm-1")
    sim = peers.join(World("left", "right"), "sim-1", "sim")
    # A robot that a busy machine has not read yet is announced by its name alone.
    eventually(lambda: "world" in (arm.get_peer("sim-1") or {}))
    eventually(lambda: "action_keys" in (sim.get_peer("arm-1") or {}))
    row = arm.get_peer("sim-1")
    assert row is not None
    assert (row["type"], row["world"], row["sim_robots"], row["reachable"]) == ("sim", True, ["left", "right"], True)
    assert sim.peers_by_id["arm-1"]["tool_name"] == "so100"
    assert sim.peers_by_id["arm-1"]["action_keys"] == ["shoulder.pos"]
    assert [peer["peer_id"] for peer in arm.peers] == ["sim-1"]
    assert arm.get_peer("arm-1") is None


def test_a_live_peers_name_cannot_be_taken_by_another_session(peers: Fleet) -> None:
    console = peers.join(None, "console")
    peers.join(Arm(), "arm-1")
    bound = console.peer_wire_zid("arm-1")
    thief = peers.stranger()
    thief.put("strands/arm-1/presence", heartbeat(peers, "arm-1"))
    assert console.peer_wire_zid("arm-1") == bound
    assert peers.events("presence_identity_conflict")
    # Else a heartbeat of its own may come between.
    peers.bus.partition(peers.transports["arm-1"])
    peers.clock.pass_(10.5)
    thief.put("strands/arm-1/presence", heartbeat(peers, "arm-1"))
    assert console.peer_wire_zid("arm-1") == thief.session_id


def test_a_peer_whose_session_ended_is_out_of_reach_at_once_and_may_restart(peers: Fleet) -> None:
    console = peers.join(None, "console")
    arm = peers.join(Arm(), "arm-1")
    assert console.peers_by_id["arm-1"]["reachable"]
    arm.stop()
    assert not console.peers_by_id["arm-1"]["reachable"]
    again = peers.stranger()
    again.put("strands/arm-1/presence", heartbeat(peers, "arm-1"))
    assert console.peer_wire_zid("arm-1") == again.session_id
    assert console.peers_by_id["arm-1"]["reachable"]


@pytest.mark.parametrize("stamp", [-61.0, 6.0, None, "now", True])
def test_a_heartbeat_that_is_not_fresh_is_dropped(peers: Fleet, stamp: object) -> None:
    console = peers.join(None, "console")
    shifted = peers.clock() + stamp if isinstance(stamp, float) else stamp
    peers.stranger().put("strands/x/presence", {"robot_id": "x", "timestamp": shifted})
    assert console.peers == []


def test_local_facts_are_written_over_what_a_heartbeat_claims(peers: Fleet) -> None:
    console = peers.join(None, "console")
    body = heartbeat(peers, "x", age=-5, reachable=False, peer_id="console", type="console")
    peers.stranger().put("strands/x/presence", body)
    row = console.peers_by_id["x"]
    assert row["age"] == 0
    assert row["reachable"] is True
    assert row["type"] == "robot"


def test_silent_peer_is_pruned_or_listed_as_out_of_reach() -> None:
    clock, retention = Clock(), [0.0]
    registry = PeerRegistry(clock=clock, most=lambda: 2, retention=lambda: retention[0])
    assert registry.update("a", "robot", "h", {}) is True
    assert registry.update("a", "robot", "h", {}) is False
    clock.pass_(11)
    retention[0] = 60
    assert registry.prune() == []
    assert registry.all()[0]["reachable"] is False
    assert registry.get("a", max_age_s=5) is None
    retention[0] = 0
    assert registry.prune() == ["a"]
    for name in "bcd":
        registry.update(name, "robot", "h", {})
    assert {row["peer_id"] for row in registry.all()} == {"b", "c"}  # living rows stay; the newcomer is left out


@pytest.mark.parametrize("peer", ["", "broadcast", "safety", "-a", "a/b", "a*", "a b", "x" * 129, None, 5])
def test_a_bad_peer_id_is_refused(peer: object) -> None:
    with pytest.raises(ValueError, match="peer_id"):
        Mesh(None, peer)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["", None, 5, True, "a\nb", "x" * 101])
def test_peer_type_that_is_no_text_is_refused(kind: object) -> None:
    with pytest.raises(ValueError, match="peer_type"):
        Mesh(None, "watcher", kind)  # type: ignore[arg-type]


def test_the_kill_switch_overrides_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH", "no")
    assert init_mesh(Arm(), "arm-1") is None
    monkeypatch.delenv("STRANDS_MESH")
    assert init_mesh(Arm(), "arm-1", mesh=False) is None


def test_init_mesh_names_joins_and_lists_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_BACKEND", "memory")
    mesh = init_mesh(Arm("my arm"), mesh=True)
    assert mesh is not None
    try:
        assert mesh.alive
        assert mesh.peer_id.startswith("my-arm-")
        assert get_local_robots() == {mesh.peer_id: mesh}
    finally:
        mesh.close()
    assert get_local_robots() == {}
    assert not mesh.alive


def test_peer_of_this_process_that_left_is_out_of_reach_of_its_others_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_BACKEND", "memory")
    # No token is looked at meanwhile, as where the session is over with the peer.
    monkeypatch.setattr(PresenceListener, "judge_tokens", lambda *_: None)
    one, two = init_mesh(None, "one"), init_mesh(None, "two")
    assert one is not None
    assert two is not None
    try:
        eventually(lambda: (one.get_peer("two") or {}).get("reachable"))
        two.close()
        assert not (one.get_peer("two") or {}).get("reachable")
    finally:
        one.close()
        two.close()


def test_a_peer_that_cannot_join_is_not_alive(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_BACKEND", "pigeon")
    mesh = init_mesh(None, "console")
    assert mesh is not None
    assert not mesh.alive
    with pytest.raises(RuntimeError, match="not on the mesh"):
        mesh.emergency_stop()
    assert mesh.subscribe("strands/**") is None
    mesh.close()


@pytest.mark.parametrize(
    ("given", "refused"),
    [
        ((print, "strands/*/state"), "topic must be a key expression"),
        (("", print), "topic must be a key expression"),
        (("strands/*/state", "states"), "callback must be callable"),
        (("strands/*/state", print, print), "name must be text"),
    ],
)
def test_arguments_of_a_subscription_in_another_order_are_refused_by_name(
    peers: Fleet, given: tuple[Any, ...], refused: str
) -> None:
    console = peers.join(None, "console")
    with pytest.raises(ValidationError, match=refused):
        console.subscribe(*given)
    with pytest.raises(ValidationError, match="on_sample must be callable"):
        console.subscribe("strands/*/state", on_sample="states")  # type: ignore[arg-type]
    assert console.subscribe("strands/*/state", name="") == "strands/*/state"


def test_subscriptions_deliver_objects_and_end_when_the_mesh_stops(peers: Fleet) -> None:
    one, two = peers.join(None, "one"), peers.join(None, "two")
    received: list[tuple[str, dict[str, Any], str | None]] = []
    name = one.subscribe("strands/**", on_sample=lambda key, data, zid: received.append((key, data, zid)), name="all")
    assert name == "all"
    assert one.subscribe("strands/two/note") == "strands/two/note"
    two.publish("strands/two/note", {"x": 1})
    eventually(lambda: one.inbox["strands/two/note"])
    assert ("strands/two/note", {"x": 1}, peers.transports["two"].session_id) in received
    assert one.inbox["strands/two/note"] == [("strands/two/note", {"x": 1})]
    one.unsubscribe("all")
    with pytest.raises(ValueError, match="not both"):
        one.subscribe("x", lambda key, data: None, on_sample=lambda key, data, zid: None)
    one.stop()
    assert one.inbox == {}
    one.start()
    assert one.alive


class Linked(MemoryTransport):
    """A session that depends on a hub, which a test takes away and gives back."""

    lost_at = -math.inf
    up = True

    def lost_link_at(self) -> float:
        return self.lost_at

    def anchored(self) -> bool:
        return self.up


def watched(bus: MemoryBus) -> tuple[Linked, PresenceListener, Callable[[], None], PeerRegistry]:
    """A watcher on such a session that knows arm-1 of session ``aa``."""
    transport, registry = Linked(bus), PeerRegistry()
    transport.connect()
    registry.update("arm-1", "robot", "host", {}, session="aa")
    context = Context("console", registry, AuditThrottle("console"), Identity(), transport=transport)
    listener = PresenceListener.joined_by(context)
    return transport, listener, lambda: listener.left_by(context), registry


def reachable(registry: PeerRegistry) -> bool:
    return bool(registry.all()[0]["reachable"])


def test_token_lost_with_our_own_link_is_not_judged_until_the_link_is_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(presence, "RETURN_S", 0.2)
    monkeypatch.setattr(presence, "SAME_LOSS_S", 20.0)
    transport, listener, leave, registry = watched(MemoryBus())
    key = topics.token("arm-1", "aa")
    transport.up, transport.lost_at = False, time.monotonic()
    listener.on_token(key, alive=False)
    listener.judge_tokens()
    transport.up = True
    listener.judge_tokens()
    assert reachable(registry)
    listener.on_token(key, alive=True)
    time.sleep(0.25)
    listener.judge_tokens()
    assert reachable(registry)
    leave()


def test_peer_whose_token_does_not_return_with_the_link_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presence, "RETURN_S", 0.05)
    monkeypatch.setattr(presence, "SAME_LOSS_S", 20.0)
    transport, listener, leave, registry = watched(MemoryBus())
    transport.lost_at = time.monotonic()
    listener.on_token(topics.token("arm-1", "aa"), alive=False)
    listener.judge_tokens()
    assert reachable(registry)
    time.sleep(0.06)
    listener.judge_tokens()
    assert not reachable(registry)
    assert registry.conflicts("arm-1", "bb") is None
    leave()


class Late(MemoryTransport):
    """A leg that connects when a test lets it."""

    up = False

    def connect(self) -> None:
        if not self.up:
            raise TransportError("not yet")
        super().connect()


def test_bridge_declares_and_watches_tokens_when_its_local_leg_comes_up_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(bridges, "RETRY_S", 0.02)
    bus, registry, shown = MemoryBus(), PeerRegistry(), list[tuple[str, bool]]()
    late, other = Late(bus), MemoryTransport(bus)
    both = BridgeTransport(late, MemoryTransport(MemoryBus(), sessionless=True))
    both.connect()
    other.connect()
    other.watch_tokens(topics.token("*", "*"), lambda key, there: shown.append((key, there)))
    registry.update("arm-1", "robot", "host", {}, session="aa")
    context = Context("console", registry, AuditThrottle("console"), Identity(), transport=both)
    publisher = PresencePublisher(context, "robot", dict)
    publisher.start()
    publisher.announce()
    late.up = True
    eventually(lambda: both.session_id)
    assert publisher.listener is not None
    publisher.listener.judge_tokens()
    for _ in range(2):
        publisher.announce()
    assert shown == [(topics.token("console", str(both.session_id)), True)]
    other.declare_token(topics.token("arm-1", "aa")).undeclare()
    publisher.listener.judge_tokens(0.0)
    assert not reachable(registry)
    shown.clear()
    publisher.stop()
    assert [there for _, there in shown] == [False]
    both.close()


def test_a_row_that_is_refreshed_without_a_session_keeps_the_living_peers_binding() -> None:
    clock = Clock()
    registry = PeerRegistry(clock=clock)
    registry.update("arm-1", "robot", "h", {}, session="aa", certificate=("c" * 64, "arm-1"))
    registry.update("arm-1", "robot", "h", {"task_status": "idle"})
    assert registry.session_of("arm-1") == "aa"
    assert registry.certificate_of("arm-1") == ("c" * 64, "arm-1")
    registry.lost("arm-1", "aa")
    registry.update("arm-1", "robot", "h", {})
    assert registry.session_of("arm-1") is None


def test_peer_that_fails_to_join_releases_the_session(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    first = Mesh(None, "console", parts=peers.parts("console"))
    transport = peers.transports["console"]
    declare = transport.declare_subscriber

    def refuse(key: str, callback: Any) -> Any:
        if key == "strands/broadcast":
            raise TransportError("no more subscribers")
        return declare(key, callback)

    monkeypatch.setattr(transport, "declare_subscriber", refuse)
    with pytest.raises(TransportError):
        first.start()
    assert "console" not in get_local_robots()
    assert transport.session_id is None
    monkeypatch.undo()
    first.start()
    assert first.alive
    first.close()


def test_id_of_a_peer_that_was_never_started_is_free_for_another_robot(
    peers: Fleet, caplog: pytest.LogCaptureFixture
) -> None:
    other, parts = peers.parts("arm-1"), peers.parts("arm-1")
    forgotten = Mesh(Arm(), "arm-1", parts=replace(other, plane=parts.plane))
    joined = Mesh(Arm(), "arm-1", parts=parts)
    assert "no emergency stop halts the one of this id that never joined" in caplog.text
    peers.meshes += [forgotten, joined]
    joined.start()
    assert joined.alive
    with pytest.raises(ValidationError, match=r"arm-1.*taken by another robot"):
        forgotten.start()
    assert not forgotten.alive
    with pytest.raises(ValidationError, match=r"arm-1.*taken by another robot"):
        Mesh(Arm(), "arm-1", parts=parts)
    assert joined.alive


def test_id_is_free_again_after_a_join_that_failed(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = peers.parts("arm-1")
    for problem in (lambda: None, refuse):
        failed = Mesh(Arm(), "arm-1", parts=replace(parts, acquire=problem))
        peers.meshes.append(failed)
        with suppress(TransportError):
            failed.start()
        assert not failed.alive
    with monkeypatch.context() as broken:
        broken.setattr(peers.transports["arm-1"], "declare_subscriber", lambda *_: refuse())
        failed = Mesh(Arm(), "arm-1", parts=parts)
        with pytest.raises(TransportError):
            failed.start()
    joined = Mesh(Arm(), "arm-1", parts=parts)
    peers.meshes.append(joined)
    joined.start()
    assert joined.alive


def refuse() -> Any:
    raise TransportError("no link")


def test_id_of_a_locked_robot_stays_its_own_though_it_never_joined(peers: Fleet) -> None:
    parts = peers.parts("arm-1")
    locked = Mesh(Arm(), "arm-1", parts=parts)
    peers.meshes.append(locked)
    assert parts.plane is not None
    parts.plane.emergency_stop(StopOrder(new_epoch(), "console", "smoke"))
    assert locked.lockout_epoch is not None
    with pytest.raises(ValidationError, match="taken by another robot"):
        Mesh(Arm(), "arm-1", parts=parts)
    assert locked.lockout_epoch is not None
