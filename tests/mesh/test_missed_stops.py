"""A robot that was away asks which stops it missed, and judges each answer as a stop that comes directly."""

from __future__ import annotations

import base64
import json
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet, received

from strands_robots.mesh import estop_retry, safety, stop_link
from strands_robots.mesh.core import Mesh
from strands_robots.safety import ed25519
from strands_robots.safety.missed_stops import LISTEN_S
from strands_robots.safety.orders import signed_stop
from strands_robots.safety.process import AWAKE, PAUSE_S
from strands_robots.safety.scope import Scope
from strands_robots.safety.statements import Purpose


@pytest.fixture(autouse=True)
def brief(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Collect answers for a moment only, and look at links often."""
    monkeypatch.setattr(safety, "COLLECT_S", 0.2)
    monkeypatch.setattr(stop_link, "LOOK_HZ", 50.0)
    monkeypatch.setattr(estop_retry, "SPREAD_S", 0.0)


@pytest.fixture
def signing_key(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The key of the consoles that may stop robots, which these demand."""
    key = ed25519.signing_key(b"7" * 32)
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", ed25519.encode(ed25519.public_half(key)))
    monkeypatch.setenv("STRANDS_ESTOP_REQUIRE_SIGNED", "true")
    return key


def cut(peers: Fleet, name: str) -> None:
    peers.bus.partition(peers.transports[name])


def back(peers: Fleet, name: str) -> None:
    peers.bus.partition(peers.transports[name], cut=False)


def stopped_without(peers: Fleet, name: str, key: Any = None, **stop: Any) -> tuple[Mesh, Mesh]:
    """A console stops arm-1 while another arm is cut off, and is gone; return both arms."""
    first = peers.join(Arm("arm-1"), "arm-1")
    away = peers.join(Arm(name), name)
    console = peers.join(None, "console")
    cut(peers, name)
    peers.clock.pass_(1)
    console.emergency_stop(key, **stop)
    console.close()
    eventually(lambda: first.lockout_epoch, what="the stop of arm-1")
    assert away.lockout_epoch is None
    return first, away


def answer(stops: list[dict[str, Any]]) -> dict[str, Any]:
    return {"nonce": "1" * 32, "stops": stops, "more": 0}


def row(source: str, envelope: dict[str, Any]) -> dict[str, Any]:
    event = base64.urlsafe_b64encode(json.dumps(envelope).encode()).decode().rstrip("=")
    return {"source": source, "event": event, "age_s": 1.0}


def envelope_of(peers: Fleet, source: str, epoch: str) -> dict[str, Any]:
    return {"peer_id": source, "t": peers.clock(), "estop_id": epoch, "source_zid": "ff"}


def answered_by_a_stranger(peers: Fleet, asks: str, stops: list[dict[str, Any]], count: int = 1) -> None:
    """Have a stranger answer the next question of ``asks`` first, and often."""
    stranger = peers.stranger()

    def flood() -> None:
        for number in range(1, count):
            stranger.put(f"strands/stranger-{number}/missed/answer", answer(stops))

    def reply(sample: Any) -> None:
        stranger.put("strands/stranger-0/missed/answer", answer(stops))
        # On a thread of its own, as from another process: this one is the asker's.
        threading.Thread(target=flood, name="stranger", daemon=True).start()

    stranger.declare_subscriber(f"strands/{asks}/missed/ask", reply)


def settled(asked: list[Any]) -> None:
    """Wait until a question was asked and nothing that answers it counts any more."""
    eventually(lambda: asked, what="the question")
    time.sleep(LISTEN_S + 0.1)


def test_robot_that_was_cut_off_is_locked_by_the_original_and_no_stop_is_published_again(peers: Fleet) -> None:
    sent = list[bytes]()
    peers.stranger().declare_subscriber("strands/safety/estop", lambda sample: sent.append(sample.payload))
    first, away = stopped_without(peers, "arm-2", reason="a hand")
    before, answers = len(sent), received(peers, "strands/*/missed/answer")
    back(peers, "arm-2")
    eventually(lambda: away.lockout_epoch == first.lockout_epoch, what="the lock of the robot that is back")
    assert len(sent) == before
    assert away._adapter.lockouts()[0]["reason"] == "a hand"
    event = answers[0]["stops"][0]["event"]
    assert base64.urlsafe_b64decode(event + "=" * (-len(event) % 4)) == sent[0]


@pytest.mark.parametrize("stayed", [False, True], ids=["its only link", "one of several"])
def test_return_of_a_link_holds_motions_where_none_was_left(peers: Fleet, stayed: bool) -> None:
    first, away = stopped_without(peers, "arm-2")
    assert away.robot is not None
    gate = away.robot.gate
    before = gate.holds
    peers.bus.partition(peers.transports["arm-2"], cut=False, stayed=stayed)
    eventually(lambda: away.lockout_epoch == first.lockout_epoch, what="the lock of the robot that is back")
    assert (gate.holds > before) is not stayed


def test_robot_that_did_not_run_asks(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, asked = peers.join(Arm("arm-1"), "arm-1"), received(peers, "strands/arm-1/missed/ask")
    assert mesh.robot is not None
    clock = AWAKE._clock
    monkeypatch.setattr(AWAKE, "_clock", lambda: clock() + PAUSE_S + 1.0)
    eventually(lambda: asked, what="the question")
    assert asked[0]["devices"] == ["arm-1"]
    monkeypatch.undo()
    AWAKE._last = clock()


def test_newcomer_asks_nothing(peers: Fleet) -> None:
    stopped_without(peers, "arm-2")
    asked = received(peers, "strands/*/missed/ask")
    late = peers.join(Arm("arm-3"), "arm-3")
    for _ in range(3):
        peers.meet()
    time.sleep(0.3)
    assert (asked, late.lockout_epoch) == ([], None)


def test_robot_that_leaves_the_mesh_and_joins_again_asks(peers: Fleet) -> None:
    robots = [peers.join(Arm(name), name, keep=True) for name in ("arm-1", "arm-2")]
    first, away = robots
    console = peers.join(None, "console")
    entry = away._adapter._entry
    assert entry is not None
    eventually(lambda: not entry.unrecorded, what="the record of the robot on the disk")
    away.stop()
    console.emergency_stop()
    console.close()
    asked = received(peers, "strands/arm-2/missed/ask")
    away.start()
    eventually(lambda: asked, what="the question")
    eventually(lambda: away.lockout_epoch == first.lockout_epoch, what="the lock of the robot that is back")


def test_resumed_robot_is_not_locked_again_by_the_answers(peers: Fleet) -> None:
    first, other = peers.join(Arm("arm-1"), "arm-1"), peers.join(Arm("arm-2"), "arm-2")
    console = peers.join(None, "console")
    console.emergency_stop()
    eventually(lambda: other.lockout_epoch)
    peers.planes["arm-2"].clear_local("operator")
    asked = received(peers, "strands/arm-2/missed/ask")
    cut(peers, "arm-2")
    back(peers, "arm-2")
    settled(asked)
    assert (first.lockout_epoch is None, other.lockout_epoch) == (False, None)


def test_console_that_stands_answers_with_what_it_sent(peers: Fleet) -> None:
    away, console = peers.join(Arm("arm-1"), "arm-1"), peers.join(None, "console")
    cut(peers, "arm-1")
    console.emergency_stop()
    back(peers, "arm-1")
    eventually(lambda: away.lockout_epoch, what="the lock of the only robot")


def test_console_passes_on_nothing_of_others(peers: Fleet) -> None:
    away, bystander = peers.join(Arm("arm-1"), "arm-1"), peers.join(None, "console-2")
    console = peers.join(None, "console")
    cut(peers, "arm-1")
    console.emergency_stop()
    console.close()
    assert bystander.lockout_epoch is not None
    asked = received(peers, "strands/arm-1/missed/ask")
    back(peers, "arm-1")
    settled(asked)
    assert away.lockout_epoch is None


@pytest.mark.parametrize(
    "stops", [[], [{"source": 5}], [{"source": "x", "event": "####", "age_s": 0.0}]], ids=["none", "no row", "garbage"]
)
def test_stranger_that_answers_first_hides_no_stop(peers: Fleet, stops: list[dict[str, Any]]) -> None:
    first, away = stopped_without(peers, "arm-2")
    answered_by_a_stranger(peers, "arm-2", stops)
    back(peers, "arm-2")
    eventually(lambda: away.lockout_epoch == first.lockout_epoch, what="the lock, whatever a stranger says")


def test_ten_thousand_answers_of_strangers_hide_no_stop(peers: Fleet) -> None:
    first, away = stopped_without(peers, "arm-2")
    answered_by_a_stranger(peers, "arm-2", [], count=10_000)
    back(peers, "arm-2")
    eventually(lambda: away.lockout_epoch == first.lockout_epoch, what="the lock, however many say none")


def test_unsigned_and_badly_signed_answers_lock_nothing_where_signatures_are_demanded(
    peers: Fleet, signing_key: Any
) -> None:
    away = peers.join(Arm("arm-1"), "arm-1")
    forged = {**envelope_of(peers, "console", "a" * 32), "nonce": "2" * 32, "sig": "A" * 86}
    plain = envelope_of(peers, "console", "b" * 32)
    answered_by_a_stranger(peers, "arm-1", [row("console", forged), row("console", plain)])
    asked = received(peers, "strands/arm-1/missed/ask")
    cut(peers, "arm-1")
    back(peers, "arm-1")
    settled(asked)
    assert away.lockout_epoch is None


def test_signed_stop_is_passed_on_with_its_signature(peers: Fleet, signing_key: Any) -> None:
    first, away = stopped_without(peers, "arm-2", signing_key)
    back(peers, "arm-2")
    eventually(lambda: away.lockout_epoch == first.lockout_epoch, what="the lock by a signed stop")


def test_source_that_may_not_stop_locks_nothing_and_an_unsigned_claim_of_one_that_may_neither(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_ALLOW", "console")
    away = peers.join(Arm("arm-1"), "arm-1")
    rows = [
        row("thief", envelope_of(peers, "thief", "a" * 32)),
        row("console", envelope_of(peers, "console", "b" * 32)),
    ]
    answered_by_a_stranger(peers, "arm-1", rows)
    asked = received(peers, "strands/arm-1/missed/ask")
    cut(peers, "arm-1")
    back(peers, "arm-1")
    settled(asked)
    assert away.lockout_epoch is None


def test_answer_whose_source_is_not_that_of_the_envelope_locks_nothing(peers: Fleet) -> None:
    away = peers.join(Arm("arm-1"), "arm-1")
    answered_by_a_stranger(peers, "arm-1", [row("console", envelope_of(peers, "thief", "a" * 32))])
    asked = received(peers, "strands/arm-1/missed/ask")
    cut(peers, "arm-1")
    back(peers, "arm-1")
    settled(asked)
    assert away.lockout_epoch is None


def test_stop_of_one_cell_locks_no_robot_of_another_that_asks(peers: Fleet) -> None:
    first, away = peers.join(Arm("arm-1"), "arm-1"), peers.join(Arm("arm-2"), "arm-2")
    console = peers.join(None, "console")
    for mesh, cell in ((first, "cell-1"), (away, "cell-2")):
        mesh._adapter._cell = cell
        entry = mesh._adapter._entry
        assert entry is not None
        entry.cells = frozenset({cell})
    peers.meet()
    cut(peers, "arm-2")
    console.emergency_stop(scope=Scope(cell="cell-1"))
    console.close()
    eventually(lambda: first.lockout_epoch)
    asked = received(peers, "strands/arm-2/missed/ask")
    back(peers, "arm-2")
    settled(asked)
    assert away.lockout_epoch is None


def test_stop_of_robots_by_name_locks_one_of_them_that_was_away_and_no_other(peers: Fleet) -> None:
    first, named, other = (peers.join(Arm(name), name) for name in ("arm-1", "arm-2", "arm-3"))
    console = peers.join(None, "console")
    for each in ("arm-2", "arm-3"):
        cut(peers, each)
    console.emergency_stop(scope=Scope.named(["arm-1", "arm-2"]))
    console.close()
    eventually(lambda: first.lockout_epoch)
    asked = received(peers, "strands/arm-3/missed/ask")
    for each in ("arm-2", "arm-3"):
        back(peers, each)
    eventually(lambda: named.lockout_epoch == first.lockout_epoch, what="the lock of the named robot that is back")
    settled(asked)
    assert other.lockout_epoch is None


def test_unproven_scope_of_a_missed_stop_is_every_robot_where_signatures_are_demanded(
    peers: Fleet, signing_key: Any
) -> None:
    body = {**envelope_of(peers, "console", "a" * 32), "nonce": "2" * 32}
    signed = signed_stop(signing_key, Purpose.EMERGENCY_STOP, "console", body)
    scoped = {**signed, "scope": {"only": ["arm-9"]}}
    away = peers.join(Arm("arm-1"), "arm-1")
    answered_by_a_stranger(peers, "arm-1", [{**row("console", scoped), "age_s": 0.0}])
    cut(peers, "arm-1")
    back(peers, "arm-1")
    eventually(lambda: away.lockout_epoch == "a" * 32, what="the lock by a stop whose scope nobody signed")


def test_peer_of_an_older_release_gets_the_stop_again_when_it_is_back(peers: Fleet, tmp_path: Path) -> None:
    older = peers.stranger()

    def beat() -> None:
        older.put("strands/old-1/presence", {"robot_id": "old-1", "timestamp": peers.clock()})

    first, console = peers.join(Arm("arm-1"), "arm-1"), peers.join(None, "console")
    beat()
    peers.clock.pass_(20)
    peers.meet()
    console.emergency_stop()
    console.close()
    eventually(lambda: first.lockout_epoch)
    repeated = received(peers, "strands/safety/estop")
    peers.clock.pass_(5)
    beat()
    eventually(lambda: repeated, what="the stop, for the older peer")
    assert repeated[0]["estop_id"] == first.lockout_epoch
