"""Stops of one robot or one cell on the in-memory mesh."""

from __future__ import annotations

from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, received

from strands_robots.mesh import estop_retry, safety
from strands_robots.mesh.core import Mesh
from strands_robots.safety import ed25519
from strands_robots.safety.orders import REQUIRE_SIGNED, new_epoch
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.statements import Purpose


@pytest.fixture(autouse=True)
def standing_console(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of these peers stands still, so that none would ever have been there for long."""
    monkeypatch.setattr(estop_retry, "DISCOVERY_S", 0.0)


def join(peers: Fleet, name: str, cell: str = "") -> tuple[Arm, Mesh]:
    arm, parts = Arm(name), peers.parts(name)
    parts.cell = cell
    mesh = Mesh(arm, name, parts=parts)
    peers.meshes.append(mesh)
    mesh.start()
    peers.meet()
    return arm, mesh


def locked(peers: Fleet) -> set[str]:
    return {mesh.peer_id for mesh in peers.meshes if mesh.robot is not None and mesh.lockout_epoch is not None}


ONLY_ARM_1 = Scope.named(["arm-1"])


def test_stop_of_one_robot_goes_to_it_alone_and_locks_it(peers: Fleet) -> None:
    console = peers.join(None, "console")
    (inside, mesh), (outside, _) = join(peers, "arm-1"), join(peers, "arm-2")
    published = received(peers, "strands/safety/estop")
    commands = received(peers, "strands/*/cmd")
    (answer,) = console.emergency_stop(scope=ONLY_ARM_1)
    assert answer["responder_id"] == "arm-1"
    assert locked(peers) == {"arm-1"}
    assert inside.halts and not outside.halts
    assert answer["result"]["locked"] is True
    assert answer["result"]["estop_id"] == mesh.lockout_epoch
    assert published == []
    assert {each["target_id"] for each in commands} == {"arm-1"}
    recorded = peers.events("emergency_stop")[-1]
    assert (recorded["scope"], recorded["silent"]) == ({"only": ["arm-1"]}, [])
    assert mesh._adapter.lockouts()[0]["scope"] == {"only": ["arm-1"]}


def test_robot_whose_token_has_not_come_is_locked_all_the_same(peers: Fleet) -> None:
    """It looks like an older peer for a moment, and says by its heartbeat that it is none."""
    console = peers.join(None, "console")
    arm, mesh = join(peers, "arm-1")
    console._context.registry.update(
        "arm-1", "robot", "", {"locked": False}, session=mesh._context.session_id(), older=True
    )
    (answer,) = console.emergency_stop(scope=ONLY_ARM_1)
    assert (answer["result"]["locked"], locked(peers)) == (True, {"arm-1"})
    assert arm.halts


def test_stop_of_a_cell_reaches_it_and_robots_without_one(peers: Fleet) -> None:
    console = peers.join(None, "console")
    robots = {name: join(peers, name, cell)[0] for name, cell in (("a", "cell-1"), ("b", "cell-2"), ("c", ""))}
    published = received(peers, "strands/safety/estop")
    replies = console.emergency_stop(scope=Scope(cell="cell-1"))
    assert {each["responder_id"] for each in replies} == {"a", "c"}
    assert locked(peers) == {"a", "c"}
    assert not robots["b"].halts
    assert published and all(each["scope"] == {"cell": "cell-1"} for each in published)


@pytest.mark.parametrize("scope", [Scope.named(["arm-9"]), Scope(cell="cell-9")], ids=str)
def test_stop_for_nobody_that_is_there_stops_every_robot(
    peers: Fleet, scope: Scope, caplog: pytest.LogCaptureFixture
) -> None:
    console = peers.join(None, "console")
    join(peers, "arm-1", "cell-1"), join(peers, "arm-2")
    widened, epoch = list[bool](), new_epoch()
    replies = console.emergency_stop(scope=scope, estop_id=epoch, on_widened=lambda: widened.append(True))
    assert {each["responder_id"] for each in replies} == {"arm-1", "arm-2"}
    assert locked(peers) == {"arm-1", "arm-2"}
    assert {mesh.lockout_epoch for mesh in peers.meshes if mesh.robot is not None} == {epoch}
    assert widened == [True]
    assert "EVERY ROBOT IS STOPPED" in caplog.text


def test_known_robot_that_is_silent_is_named_and_no_other_is_stopped(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(safety, "COLLECT_S", 0.5)
    console = peers.join(None, "console")
    other, _ = join(peers, "arm-2")
    assert console.emergency_stop(scope=ONLY_ARM_1, remembers=lambda scope: scope == ONLY_ARM_1) == []
    assert peers.events("emergency_stop")[-1]["silent"] == ["arm-1"]
    assert not other.halts and locked(peers) == set()


def test_robot_out_of_reach_is_stopped_and_locked_when_it_is_back(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(safety, "COLLECT_S", 0.5)
    monkeypatch.setattr(estop_retry, "RETRY_EVERY_S", 0.05)
    console = peers.join(None, "console")
    _, mesh = join(peers, "arm-1")
    peers.bus.partition(peers.transports["arm-1"])
    assert console.emergency_stop(scope=ONLY_ARM_1, remembers=lambda scope: True) == []
    peers.clock.pass_(1)
    peers.bus.partition(peers.transports["arm-1"], cut=False)
    peers.meet()
    eventually(lambda: mesh.lockout_epoch is not None)


def test_wider_repeat_of_the_same_stop_locks_the_others(peers: Fleet) -> None:
    console, epoch = peers.join(None, "console"), new_epoch()
    join(peers, "arm-1", "cell-1"), join(peers, "arm-2", "cell-2")
    console.emergency_stop(scope=Scope(cell="cell-1"), estop_id=epoch)
    assert locked(peers) == {"arm-1"}
    console.emergency_stop(estop_id=epoch)
    assert locked(peers) == {"arm-1", "arm-2"}
    console.emergency_stop(scope=Scope(cell="cell-1"), estop_id=epoch)
    assert locked(peers) == {"arm-1", "arm-2"}


def test_robot_that_issues_a_stop_of_another_moves_on(peers: Fleet) -> None:
    own, mesh = join(peers, "arm-2")
    join(peers, "arm-1")
    replies = mesh.emergency_stop(scope=ONLY_ARM_1)
    assert [each["responder_id"] for each in replies] == ["arm-1"]
    assert not own.halts and locked(peers) == {"arm-1"}


def test_stop_of_a_robot_of_a_world_locks_its_world(peers: Fleet) -> None:
    console = peers.join(None, "console")
    world = peers.join(World("left", "right"), "sim", "sim")
    eventually(lambda: console.get_peer("sim__left") is not None or peers.meet())
    replies = console.emergency_stop(scope=Scope.named(["sim__left"]))
    assert [each["responder_id"] for each in replies] == ["sim__left"]
    assert world.lockout_epoch is not None


def test_plain_stop_is_carried_out_whatever_its_envelope_says(peers: Fleet) -> None:
    arm, mesh = join(peers, "arm-1")
    stranger = peers.stranger()
    for number, envelope in enumerate((1, "x", [], {}, {"peer_id": "a"}, {"peer_id": "b", "t": 1, "estop_id": "no"})):
        request: dict[str, Any] = {"sender_id": "a", "turn_id": f"turn-{number}", "timestamp": peers.clock()}
        stranger.put("strands/arm-1/cmd", {**request, "command": {"action": "stop", "estop": envelope}})
        eventually(lambda number=number: len(arm.halts) == number + 1)
    assert mesh.lockout_epoch is None


def test_scope_that_is_not_proven_is_every_robot_where_signatures_are_demanded(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = Ed25519PrivateKey.generate()
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", ed25519.encode(ed25519.public_half(key)))
    monkeypatch.setenv(REQUIRE_SIGNED, "true")
    console = peers.join(None, "console")
    _, mesh = join(peers, "arm-1", "cell-1")
    rules = mesh._adapter.rules
    body = console._safety._signed(
        {"peer_id": "console", "estop_id": new_epoch(), "scope": {"cell": "cell-2"}}, Purpose.EMERGENCY_STOP, key
    )
    assert rules.source_refusal("console") is None
    assert rules.signature_refusal("console", body, Purpose.EMERGENCY_STOP) is None
    assert rules.scope("console", body) == Scope(cell="cell-2")
    assert rules.scope("console", {**body, "scope_sig": ""}) == EVERY_ROBOT
    assert rules.scope("console", {**body, "scope": {"cell": "cell-3"}}) == EVERY_ROBOT
    console.emergency_stop(key, scope=ONLY_ARM_1)
    assert locked(peers) == {"arm-1"}


@pytest.mark.parametrize("scope", [EVERY_ROBOT, Scope(cell="cell-1"), ONLY_ARM_1], ids=str)
@pytest.mark.parametrize("signs", [False, True])
def test_reason_of_a_stop_is_kept_by_the_robots_that_it_locks(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, scope: Scope, signs: bool
) -> None:
    key = Ed25519PrivateKey.generate() if signs else None
    if key is not None:
        monkeypatch.setenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", ed25519.encode(ed25519.public_half(key)))
        monkeypatch.setenv(REQUIRE_SIGNED, "true")
    console = peers.join(None, "console")
    _, mesh = join(peers, "arm-1", "cell-1")
    # The longest that a face lets through.
    reason = "\N{WAVING HAND SIGN}" * 200
    console.emergency_stop(key, reason=reason, scope=scope)
    assert [each["reason"] for each in mesh._adapter.lockouts()] == [reason]


def test_reason_that_is_too_long_is_cut_and_the_stop_leaves(peers: Fleet) -> None:
    console = peers.join(None, "console")
    _, mesh = join(peers, "arm-1", "cell-1")
    console.emergency_stop(reason="a hand " * 2000)
    assert mesh._adapter.lockouts()[0]["reason"] == ("a hand " * 2000)[:200]


def test_stop_without_a_reason_states_none(peers: Fleet) -> None:
    console = peers.join(None, "console")
    _, mesh = join(peers, "arm-1")
    published = received(peers, "strands/safety/estop")
    console.emergency_stop()
    assert published and all("reason" not in each for each in published)
    assert mesh._adapter.lockouts()[0]["reason"] == "fleet e-stop"
