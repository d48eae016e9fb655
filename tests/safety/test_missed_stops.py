"""Robots that were away ask which stops they missed, and others answer with the originals."""

from __future__ import annotations

import json
import random
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.stop_bus import NETWORK, BusLink, BusMachine, StopBus, stop_message
from fixtures.waiting import eventually

from strands_robots.audit import flush_audit, read_audit_log
from strands_robots.safety import ed25519, missed_stops
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.lockout import MAX_EPOCHS
from strands_robots.safety.missed_stops import (
    ANSWER_MAX_BYTES,
    ANSWERS_ENOUGH,
    STOPS_MAX_BYTES,
    Answerer,
    AnswerSlots,
    answer_fields,
    waiting_s,
)
from strands_robots.safety.network_key import DEVICE_CONNECT, NetworkKey
from strands_robots.safety.orders import StopRules, new_epoch, params_of
from strands_robots.safety.persistence import (
    ORIGINAL_MAX_BYTES,
    STOPS_MAX,
    LockoutStore,
    Original,
    Originals,
    ResumedEpochs,
)
from strands_robots.safety.resume import clear_here
from strands_robots.safety.stop_link import ANSWER, ESTOP, QUESTION, VERDICT, notification
from strands_robots.state_files import uptime

Join = Callable[..., BusMachine]

SETTLED_S = 0.5
"""Longer than an answer takes in which nothing may come."""


@pytest.fixture
def bus() -> StopBus:
    return StopBus()


@pytest.fixture
def join(bus: StopBus) -> Iterator[Join]:
    made: list[BusMachine] = []

    def one(*names: str, **options: Any) -> BusMachine:
        made.append(BusMachine(bus, *names, **options))
        return made[-1]

    yield one
    for each in made:
        each.close()


@pytest.fixture
def estop_key() -> Ed25519PrivateKey:
    return Ed25519PrivateKey.generate()


@pytest.fixture
def signed_only(estop_key: Ed25519PrivateKey) -> Callable[[], StopRules]:
    return lambda: StopRules(allow=(), keys=(ed25519.public_half(estop_key),))


@pytest.fixture
def operator(monkeypatch: pytest.MonkeyPatch) -> Ed25519PrivateKey:
    key = Ed25519PrivateKey.generate()
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", ed25519.encode(ed25519.public_half(key)))
    return key


def locked_and_cut_off(bus: StopBus, join: Join, key: Ed25519PrivateKey | None = None, **options: Any) -> Any:
    """Return a machine that is locked by a stop, one that was cut off meanwhile, and the stop."""
    there, away = join("there", **options), join("away", **options)
    away.link.change(False)
    epoch = bus.stop(key=key)
    eventually(there.epochs)
    return there, away, epoch


def asks(bus: StopBus) -> int:
    return len(bus.of(QUESTION))


def given(bus: StopBus) -> list[dict[str, Any]]:
    return [params_of(payload) for _, payload in bus.of(ANSWER)]


def told(bus: StopBus) -> set[Any]:
    """Return the ids of the stops in all answers."""
    stops = [each for answer in given(bus) for each in answer["stops"]]
    return {params_of(ed25519.decode_up_to(each["event"], ORIGINAL_MAX_BYTES) or b"").get("estop_id") for each in stops}


def answered(bus: StopBus, before: int = 0) -> None:
    eventually(lambda: len(bus.of(ANSWER)) > before, what="an answer")


def audit_of(event: str) -> list[dict[str, Any]]:
    flush_audit()
    return [each for each in read_audit_log() if each["event"] == event]


def forged(stops: list[dict[str, Any]], nonce: str = "") -> bytes:
    return notification(ANSWER, {"nonce": nonce or new_epoch(), "stops": stops, "more": 0})


def row(source: str, payload: bytes, age_s: object = 0.1) -> dict[str, Any]:
    return {"source": source, "event": ed25519.encode(payload), "age_s": age_s}


def answer_first(bus: StopBus, *payloads: bytes | int, source: str = "stranger") -> None:
    """Have a stranger answer each question before anybody else."""

    def on_event(event: str, asker: str, payload: bytes | int) -> None:
        for number, each in enumerate(payloads):
            bus.send(source if len(payloads) < 100 else f"{source}-{number}", ANSWER, each)

    BusLink(bus).open((QUESTION,), on_event, lambda up: None)


def test_robot_that_was_cut_off_locks_by_the_stop_that_it_missed(bus: StopBus, join: Join) -> None:
    _, away, epoch = locked_and_cut_off(bus, join)
    assert away.epochs() == ()
    away.link.change(True)
    eventually(away.epochs)
    assert away.epochs() == (epoch,)
    assert away.robots["away"].refuses()
    eventually(lambda: audit_of("missed_stop_learnt"))
    record = audit_of("missed_stop_learnt")[0]
    assert record["peer_id"] == "away"
    assert record["payload"]["answerer"] == "there"
    assert audit_of("missed_stops_answered")[0]["payload"]["epochs"] == [epoch]


def test_robot_that_did_not_run_for_a_while_asks(bus: StopBus, join: Join) -> None:
    there, away = join("there"), join("away")
    away.link.up = False  # it does not even see that the link went
    epoch = bus.stop()
    eventually(there.epochs)
    away.link.up = True
    away.listener.awake()
    eventually(away.epochs)
    assert away.epochs() == (epoch,)


def test_link_that_goes_and_comes_for_ever_holds_the_motions_less_and_less() -> None:
    pace = missed_stops.HoldPace()
    assert [now for now in range(200) if pace.take(float(now))] == [0, 5, 15, 35, 75, 135, 195]
    assert not pace.take(200.0)
    assert [pace.take(now) for now in (270.0, 274.0, 276.0)] == [True, False, True], "after a time without returns"


def test_return_of_the_link_holds_the_motions_once_its_question_left(bus: StopBus, join: Join) -> None:
    away = join("away")
    gate = away.robots["away"].gate
    before = gate.holds
    away.link.change(False)
    away.link.change(True)
    eventually(lambda: gate.holds > before)
    assert asks(bus) == 1
    for _ in range(3):
        away.link.change(False)
        away.link.change(True)
    eventually(lambda: asks(bus) >= 2)
    assert gate.holds == before + 1


def test_return_of_one_peer_of_several_asks_and_holds_nothing(bus: StopBus, join: Join) -> None:
    there, away = join("there"), join("away")
    away.link.up = False
    epoch = bus.stop()
    eventually(there.epochs)
    before = away.robots["away"].gate.holds
    away.link.change(True)
    eventually(away.epochs)
    assert away.epochs() == (epoch,)
    assert away.robots["away"].gate.holds == before


def test_answer_holds_the_original_verbatim_and_never_goes_to_the_topics_of_stops(bus: StopBus, join: Join) -> None:
    _, away, _ = locked_and_cut_off(bus, join)
    original = bus.of(ESTOP)[0][1]
    away.link.change(True)
    eventually(away.epochs)
    (stop,) = given(bus)[0]["stops"]
    assert ed25519.decode_up_to(stop["event"], ORIGINAL_MAX_BYTES) == original
    assert 0 <= stop["age_s"] < 60
    assert len(bus.of(ESTOP)) == 1


def test_robot_that_learnt_a_stop_answers_the_next_one_with_its_true_age(bus: StopBus, join: Join) -> None:
    third = join("third")
    third.link.change(False)
    there, away, epoch = locked_and_cut_off(bus, join)
    away.link.change(True)
    eventually(away.epochs)
    there.plane.clear_local("test")
    third.link.change(True)
    eventually(third.epochs)
    assert third.epochs() == (epoch,)


def test_stranger_s_false_age_of_a_stop_is_not_passed_on_once_a_true_one_came(
    bus: StopBus, join: Join, tmp_path: Path
) -> None:
    LockoutStore(tmp_path).save_resumed({"simulation:away": ResumedEpochs({}, uptime() - 3600)})
    there, away = join("there"), join("away", folder=tmp_path, was_here=True)
    away.link.change(False)
    epoch, payload = stop_message("safety-1")
    bus.send("safety-1", ESTOP, payload)
    eventually(there.epochs)
    answer_first(bus, forged([row("safety-1", payload, 3000.0)]))
    away.link.change(True)
    eventually(lambda: away.epochs() == (epoch,))
    kept = away.plane.originals
    eventually(lambda: [each for each in kept(NETWORK.text) if uptime() - each.received < 60.0], what="the true age")


def test_newcomer_does_not_ask_and_is_not_locked(bus: StopBus, join: Join) -> None:
    there = join("there")
    bus.stop()
    eventually(there.epochs)
    newcomer = join("newcomer")
    time.sleep(SETTLED_S)
    assert asks(bus) == 0
    assert newcomer.epochs() == ()


def test_robot_that_was_here_before_its_start_asks_unless_its_state_was_reset(
    bus: StopBus, join: Join, tmp_path: Path
) -> None:
    there = join("there")
    known, reset = tmp_path / "known", tmp_path / "reset"
    LockoutStore(known).save_resumed({"simulation:back": ResumedEpochs({}, uptime() - 300)})
    epoch = bus.stop()
    eventually(there.epochs)
    join("reset", folder=reset, was_here=True)
    time.sleep(SETTLED_S)
    assert asks(bus) == 0
    back = join("back", folder=known, was_here=True)
    eventually(back.epochs)
    assert back.epochs() == (epoch,)


def test_stop_from_before_the_robot_s_time_does_not_lock_it(bus: StopBus, join: Join) -> None:
    there = join("there")
    bus.stop()
    eventually(there.epochs)
    time.sleep(0.01)
    younger = join("younger")
    younger.listener.awake()
    answered(bus)
    time.sleep(SETTLED_S)
    assert younger.epochs() == ()


@pytest.mark.parametrize("how", ["key", "local"])
def test_robot_never_locks_again_by_an_epoch_that_it_was_resumed_from(
    bus: StopBus, join: Join, operator: Ed25519PrivateKey, tmp_path: Path, how: str
) -> None:
    there, away = join("there"), join("away", folder=tmp_path)
    first = bus.stop()
    eventually(away.epochs)
    if how == "key":
        assert away.resume(operator, "away", first)
    else:
        assert away.plane.clear_local("test")
    # So many stops that the plane itself has forgotten the first.
    there.link.change(False)
    for _ in range(400):
        epoch = bus.stop()
        eventually(lambda epoch=epoch: epoch in away.epochs(), every=0.001)  # type: ignore[misc]
        away.plane.clear_local("test")
    there.link.change(True)
    away.listener.awake()
    answered(bus)
    time.sleep(SETTLED_S)
    assert away.epochs() == ()
    away.close()
    back = join("away", folder=tmp_path, was_here=True)
    before = len(bus.of(ANSWER))
    back.listener.awake()
    answered(bus, before)
    time.sleep(SETTLED_S)
    assert back.epochs() == ()


@pytest.mark.parametrize("running", [True, False], ids=["running", "not running"])
def test_robot_that_was_cleared_of_a_flood_locks_by_none_of_its_stops_again(
    bus: StopBus, join: Join, state_directory: Path, running: bool
) -> None:
    robot = join("arm-1", folder=state_directory)
    latch = robot.entries[0].latch
    for _ in range(MAX_EPOCHS + 1):
        latch.engage(new_epoch(), "stranger", "")
    there = join("there")
    # One halt answers for all stops of a quarter of a second, and only the first of them is noted.
    flood = [bus.stop(f"safety-{number}") for number in range(10)]
    eventually(lambda: len(there.epochs()) == len(flood))
    eventually(lambda: {params_of(sent)["estop_id"] for name, sent in bus.of(VERDICT) if name == "arm-1"} >= {*flood})
    forgotten = next(each for each in flood if not latch.knows(each))
    eventually(lambda: not robot.entries[0].unsaved)
    if running:
        robot.plane.clear_local("the operator")
    robot.close()
    if not running:
        assert clear_here("the operator", ["arm-1"], 0.1) == {"arm-1": "cleared on disk"}
    back = join("arm-1", folder=state_directory, was_here=True)
    assert back.epochs() == ()
    back.link.change(False)
    fresh = join("fresh")
    later = bus.stop()
    eventually(fresh.epochs)
    back.link.change(True)
    eventually(lambda: forgotten in told(bus) and later in told(bus), what="both answers")
    eventually(back.epochs)
    time.sleep(SETTLED_S)
    assert back.epochs() == (later,)


def test_answerer_that_was_restarted_still_answers(bus: StopBus, join: Join, tmp_path: Path) -> None:
    also = join("also", folder=tmp_path)
    there, away, epoch = locked_and_cut_off(bus, join)
    eventually(lambda: also.epochs() and not also.entries[0].unsaved)
    there.plane.clear_local("test")
    also.close()
    assert join("also", folder=tmp_path).epochs() == (epoch,)
    away.link.change(True)
    eventually(away.epochs)
    assert away.epochs() == (epoch,)


def test_local_clearance_of_a_robot_that_does_not_run_keeps_its_epochs_resumed(
    bus: StopBus, join: Join, state_directory: Path
) -> None:
    machine = join("arm-1", folder=state_directory)
    epoch = bus.stop()
    eventually(lambda: not machine.entries[0].unsaved and machine.epochs())
    machine.close()
    assert clear_here("the operator", ["arm-1"], 0.1) == {"arm-1": "cleared on disk"}
    kept = LockoutStore(state_directory).load("simulation:arm-1")
    assert not kept.state.locked
    assert kept.resumed is not None
    assert epoch in kept.resumed.epochs


def test_another_network_is_neither_asked_nor_answered(bus: StopBus, join: Join) -> None:
    other = NetworkKey(DEVICE_CONNECT, ("127.0.0.1:7447",), "other")
    there, away = join("there"), join("away")
    away.link.change(False)
    bus.stop()
    eventually(there.epochs)
    # The robot is on both networks: it is locked, and its stop is not passed on from one to the other.
    assert there.plane.originals(other.text) == []
    away.link.change(True)
    eventually(away.epochs)


def test_signed_stop_locks_and_unsigned_ones_in_an_answer_do_not_where_signatures_are_demanded(
    bus: StopBus, join: Join, estop_key: Ed25519PrivateKey, signed_only: Callable[[], StopRules]
) -> None:
    _, away, epoch = locked_and_cut_off(bus, join, estop_key, rules=signed_only)
    unsigned = stop_message("safety-1")[1]
    wrong = stop_message("safety-1", Ed25519PrivateKey.generate())[1]
    answer_first(bus, forged([row("safety-1", unsigned), row("safety-1", wrong)]))
    away.link.change(True)
    eventually(away.epochs)
    time.sleep(SETTLED_S)
    assert away.epochs() == (epoch,)


def test_stops_that_do_not_count_hide_no_later_one_of_the_same_answer(
    bus: StopBus, join: Join, estop_key: Ed25519PrivateKey, signed_only: Callable[[], StopRules]
) -> None:
    there, away = join("there"), join("away", rules=signed_only)
    away.link.change(False)
    unsigned = [bus.stop() for _ in range(missed_stops.REFUSED_MAX - 1)]
    epoch = bus.stop(key=estop_key)
    eventually(lambda: {*unsigned, epoch} <= set(there.epochs()), what="all of them lock where every source may stop")
    away.link.change(True)
    eventually(lambda: away.epochs() == (epoch,))


def test_unsigned_stop_in_an_answer_does_not_lock_where_only_some_may_stop(bus: StopBus, join: Join) -> None:
    _, away, _ = locked_and_cut_off(bus, join, rules=lambda: StopRules(allow=("safety-*",), keys=()))
    away.link.change(True)
    answered(bus)
    time.sleep(SETTLED_S)
    assert away.epochs() == ()


@pytest.mark.parametrize(
    "answers",
    [
        [forged([])],
        [b"", b"{", b"[" * 60_000, b"\xff" * 1000, notification(ANSWER, {"stops": "x"})],
        [8 * 2**20],
        [forged([row("safety-1", b"x"), row("", b"{}"), row("safety-1", b"{}", "old"), {"source": 1}, 7] * 20)],
        [forged([row("safety-1", stop_message("x")[1], bad) for bad in (-1, True, "1", 1e30, float("nan"))])],
        [forged([]) for _ in range(10_000)],
    ],
    ids=["none", "garbage", "8 MB", "stops that are none", "ages that are none", "10,000 answers"],
)
def test_stranger_who_answers_first_hides_nothing_and_locks_nothing(
    bus: StopBus,
    join: Join,
    estop_key: Ed25519PrivateKey,
    signed_only: Callable[[], StopRules],
    answers: list[bytes | int],
) -> None:
    _, away, epoch = locked_and_cut_off(bus, join, estop_key, rules=signed_only)
    answer_first(bus, *answers)
    away.link.change(True)
    eventually(away.epochs)
    time.sleep(SETTLED_S)
    assert away.epochs() == (epoch,)


@pytest.mark.parametrize("signed", [True, False])
def test_false_age_of_a_true_original_hides_no_later_answer(
    bus: StopBus, join: Join, signed_only: Callable[[], StopRules], estop_key: Ed25519PrivateKey, signed: bool
) -> None:
    options: dict[str, Any] = {"rules": signed_only} if signed else {}
    _, away, epoch = locked_and_cut_off(bus, join, key=estop_key if signed else None, **options)
    source, payload = bus.of(ESTOP)[0]
    answer_first(bus, forged([row(source, payload, 1e6)]), forged([row(source, payload, 5e5)]))
    away.link.change(True)
    eventually(away.epochs)
    assert away.epochs() == (epoch,)


def test_recorded_stop_that_was_resumed_locks_nobody_again(
    bus: StopBus, join: Join, operator: Ed25519PrivateKey, estop_key: Ed25519PrivateKey,
    signed_only: Callable[[], StopRules],
) -> None:  # fmt: skip
    away = join("away", rules=signed_only)
    epoch = bus.stop(key=estop_key)
    eventually(away.epochs)
    recorded = bus.of(ESTOP)[0][1]
    assert isinstance(recorded, bytes)
    assert away.resume(operator, "away", epoch)
    answer_first(bus, forged([row("safety-1", recorded, 0.0)]))
    away.listener.awake()
    answered(bus)
    time.sleep(SETTLED_S)
    assert away.epochs() == ()


def test_stop_without_an_id_of_its_own_is_not_passed_on(bus: StopBus, join: Join) -> None:
    there = join("there")
    bus.send("safety-1", ESTOP, json.dumps({"method": ESTOP, "params": {}}).encode())
    eventually(there.epochs)
    assert there.plane.originals("device-connect default 127.0.0.1:7447") == []


def test_stop_too_long_to_be_passed_on_locks_all_the_same(bus: StopBus, join: Join) -> None:
    there = join("there")
    bus.stop(padding="x" * ORIGINAL_MAX_BYTES)
    eventually(there.epochs)
    assert there.plane.originals("device-connect default 127.0.0.1:7447") == []


def test_scope_of_a_missed_stop_is_judged_as_that_of_a_direct_one(bus: StopBus, join: Join) -> None:
    there, away, other = join("there"), join("away"), join("other")
    away.link.change(False), other.link.change(False)
    epoch = bus.stop(scope={"only": ["there", "away"]})
    eventually(there.epochs)
    away.link.change(True), other.link.change(True)
    eventually(away.epochs)
    time.sleep(SETTLED_S)
    assert away.epochs() == (epoch,)
    assert other.epochs() == ()


def test_flood_of_questions_gets_a_bounded_number_of_answers(bus: StopBus, join: Join) -> None:
    there = join("there")
    bus.stop()
    eventually(there.epochs)
    started = time.monotonic()
    for number in range(10_000):
        bus.send(f"stranger-{number % 100}", QUESTION, notification(QUESTION, {"nonce": new_epoch()}))
    answered(bus)
    time.sleep(SETTLED_S)
    assert len(bus.of(ANSWER)) <= 2 + (time.monotonic() - started) / missed_stops.ANSWER_EVERY_S


def test_question_that_cannot_be_answered_is_dropped_and_the_next_one_answered(
    bus: StopBus, join: Join, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, away, epoch = locked_and_cut_off(bus, join)
    tries, take = list[float](), AnswerSlots.take

    def fail(*_: Any) -> Any:
        tries.append(time.monotonic())
        raise RuntimeError("a step that fails")

    monkeypatch.setattr(AnswerSlots, "take", fail)
    away.link.change(True)
    eventually(lambda: tries)
    time.sleep(SETTLED_S)
    assert len(tries) == 1
    monkeypatch.setattr(AnswerSlots, "take", take)
    away.listener.awake()
    eventually(away.epochs)
    assert away.epochs() == (epoch,)


def test_answerers_with_known_keys_fall_silent_once_three_have_answered(bus: StopBus, join: Join) -> None:
    many = [join(f"there-{number}") for number in range(20)]
    away = join("away")
    away.link.change(False)
    bus.stop()
    eventually(lambda: all(each.epochs() for each in many))
    away.link.change(True)
    eventually(away.epochs)
    time.sleep(SETTLED_S)
    assert len(bus.of(ANSWER)) <= 6


def test_answers_without_a_key_that_is_known_silence_nobody() -> None:
    answerer, original = Answerer(lambda: 0.5), Original(new_epoch(), "safety-1", b"{}", "", 0.0)
    answerer.ask("a" * 32, 0.0)
    for number in range(ANSWERS_ENOUGH - 1):
        answerer.given("a" * 32, f"arm-{number}", [original.epoch])
        answerer.given("a" * 32, f"arm-{number}", [original.epoch])
    answerer.given("b" * 32, "arm-9", [original.epoch])  # an answer to no question that waits
    assert answerer.take([original], 1.0) == [original]


def test_stop_that_the_given_answers_lacked_is_answered_all_the_same() -> None:
    answerer = Answerer(lambda: 0.5)
    told, untold = (Original(new_epoch(), "safety-1", b"{}", "", 0.0) for _ in range(2))
    answerer.ask("a" * 32, 0.0)
    for number in range(ANSWERS_ENOUGH):
        answerer.given("a" * 32, f"arm-{number}", [told.epoch])
    assert answerer.take([told, untold], 1.0) == [untold]


def test_of_many_answerers_few_wait_shortly() -> None:
    chance = random.Random(7)
    counts = []
    for _ in range(200):
        due = sorted(waiting_s(chance.random()) for _ in range(400))
        # An answer is heard 3 ms after it was sent.
        sent: list[float] = []
        for moment in due:
            if sum(each + 0.003 <= moment for each in sent) < ANSWERS_ENOUGH:
                sent.append(moment)
        counts.append(len(sent))
    assert max(due) <= missed_stops.WAIT_MAX_S
    assert sum(counts) / len(counts) <= 4
    assert sorted(counts)[int(0.95 * len(counts))] <= 6


def test_answer_is_bounded_and_the_newest_stops_of_each_source_come_first() -> None:
    def original(source: str, number: int, size: int = 100) -> Original:
        return Original(new_epoch(), source, bytes(size), "", float(number))

    flood = [original("stranger", number, ORIGINAL_MAX_BYTES) for number in range(50, 200)]
    true = original("safety-1", 3)
    fields = answer_fields("a" * 32, [true, *flood])
    assert len(notification(ANSWER, fields)) <= ANSWER_MAX_BYTES
    assert [each["source"] for each in fields["stops"]].count("safety-1") == 1
    assert fields["more"] == 151 - len(fields["stops"])
    small = [original("safety-1", number) for number in range(100)]
    ages = [each["age_s"] for each in answer_fields("a" * 32, small)["stops"]]
    assert len(ages) == STOPS_MAX
    assert ages == sorted(ages, reverse=True)
    assert sum(missed_stops.encoded_length(each) for each in small[:STOPS_MAX]) < STOPS_MAX_BYTES


def test_originals_are_bounded_and_forgotten_with_their_lockout() -> None:
    originals, now = Originals(), uptime()
    epochs = [new_epoch() for _ in range(200)]
    for number, epoch in enumerate(epochs):
        originals.add(Original(epoch, "stranger", b"x", "net", now + number))
        originals.keep(frozenset(epochs))
    assert [each.epoch for each in originals.of(frozenset(epochs), "net")] == epochs[-STOPS_MAX:]
    assert originals.of(frozenset(epochs), "other") == []
    originals.keep(frozenset())
    assert originals.of(frozenset(epochs)) == []


def test_original_is_looked_for_while_other_threads_add_and_keep() -> None:
    originals, over = Originals(), threading.Event()
    interval = sys.getswitchinterval()

    def change() -> None:
        while not over.is_set():
            originals.add(Original(new_epoch(), "safety-1", b"x", "n", 0.0))
            originals.keep(["none"])

    threads = [threading.Thread(target=change) for _ in range(2)]
    sys.setswitchinterval(1e-5)
    try:
        for each in threads:
            each.start()
        for _ in range(20_000):
            assert not originals.has("another", "n")
    finally:
        over.set()
        for each in threads:
            each.join()
        sys.setswitchinterval(interval)


def test_controller_answers_with_its_stop_until_all_who_must_answer_have(bus: StopBus, join: Join) -> None:
    there, away = join("there"), join("away")
    controller = SafetyController("safety-1", lambda: BusLink(bus))
    try:
        away.link.change(False)
        report = controller.stop(["there", "away"], deadline_s=0.3)
        assert report.silent == ("away",)
        there.plane.clear_local("test")
        away.link.change(True)
        eventually(away.epochs)
        assert away.epochs() == (report.estop_id,)
        away.plane.clear_local("test")
        before = len(bus.of(ANSWER))
        assert controller.stop(["there", "away"], deadline_s=5.0).ok
        there.plane.clear_local("test"), away.plane.clear_local("test")
        third = join("third")
        third.listener.awake()
        eventually(lambda: len(bus.of(ANSWER)) > before)
        assert [each["epoch"] for each in map(stated, given(bus)[before:])] == [report.estop_id]
    finally:
        controller.close()


def stated(answer: dict[str, Any]) -> dict[str, Any]:
    (stop,) = answer["stops"]
    payload = ed25519.decode_up_to(stop["event"], ORIGINAL_MAX_BYTES)
    assert payload is not None
    return {"epoch": params_of(payload)["estop_id"]}
