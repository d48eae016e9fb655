"""Stops of one robot or one cell: what a scope takes out of a stop, and what makes it a stop of all."""

from __future__ import annotations

import itertools
import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.planes import own_plane
from fixtures.recording_robot import RecordingRobot
from fixtures.waiting import eventually

from strands_robots.audit import read_audit_log
from strands_robots.safety import ed25519
from strands_robots.safety.lockout import Lockout
from strands_robots.safety.orders import LISTENER, StopOrder, StopRules, new_epoch, scope_bytes, signed_stop
from strands_robots.safety.persistence import LockoutStore, hardware_key
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.scope import EVERY_ROBOT, ONLY_MAX, Scope, own_cell
from strands_robots.safety.statements import Purpose, covered
from strands_robots.utils import ValidationError

Add = Callable[..., RecordingRobot]

UNREADABLE = [
    None,
    True,
    0,
    1.5,
    "arm-1",
    ["arm-1"],
    {},
    {"only": []},
    {"only": "arm-1"},
    {"only": {"arm-1": 1}},
    {"only": None},
    {"only": [None]},
    {"only": [True]},
    {"only": [1]},
    {"only": [""]},
    {"only": ["*"]},
    {"only": ["arm 1"]},
    {"only": ["arm-1", ["arm-2"]]},
    {"only": ["a" * 129]},
    {"only": [f"arm-{n}" for n in range(ONLY_MAX + 1)]},
    {"cell": ""},
    {"cell": None},
    {"cell": ["cell-1"]},
    {"cell": True},
    {"cell": "c" * 129},
    {"cell": "*"},
    {"only": ["arm-1"], "cell": "cell-1"},
    {"only": ["arm-1"], "cell": None},
    {"only": ["arm-1"], "more": 1},
    {"Only": ["arm-1"]},
    {"except": ["arm-1"]},
]


@pytest.mark.parametrize("value", UNREADABLE, ids=lambda value: json.dumps(value)[:40])
def test_scope_that_cannot_be_read_is_every_robot(value: object) -> None:
    assert Scope.read(value) == EVERY_ROBOT
    assert StopRules(allow=(), keys=()).scope("safety-1", {"scope": value}) is EVERY_ROBOT
    assert EVERY_ROBOT.covers("arm-1", ()) and EVERY_ROBOT.covers("arm-1", {"cell-9"})


def test_scope_by_name_covers_these_robots_alone() -> None:
    scope = Scope.read({"only": ["arm-1", "arm-2", "arm-1"]})
    assert [scope.covers(name, ()) for name in ("arm-1", "arm-2", "arm-3", "")] == [True, True, False, False]
    assert Scope.read(scope.value()) == scope
    assert len(Scope.named(f"arm-{n}" for n in range(ONLY_MAX)).only) == ONLY_MAX
    assert Scope.named(["arm-1", "*"]) == Scope.named([]) == EVERY_ROBOT


def test_scope_of_a_cell_covers_it_and_robots_without_one() -> None:
    scope = Scope.read({"cell": "cell-1"})
    assert scope.covers("arm-1", {"cell-1"}) and scope.covers("arm-1", {"cell-2", "cell-1"})
    assert scope.covers("arm-1", frozenset())
    assert not scope.covers("arm-1", {"cell-2"})
    assert scope.names("arm-1", "cell-1") and not scope.names("arm-1", "")


def test_cell_of_the_environment_has_to_be_an_identifier(monkeypatch: pytest.MonkeyPatch) -> None:
    assert own_cell(None) == own_cell("") == ""
    monkeypatch.setenv("STRANDS_CELL", "cell-1")
    assert (own_cell(None), own_cell("cell-2"), own_cell("")) == ("cell-1", "cell-2", "")
    monkeypatch.setenv("STRANDS_CELL", "cell 1")
    with pytest.raises(ValidationError, match="cell"):
        own_cell(None)


# Signatures.

KEY = Ed25519PrivateKey.generate()
PUBLIC = KEY.public_key().public_bytes_raw()


def stop(scope: object = None, **fields: Any) -> dict[str, Any]:
    """A signed stop of safety-1, with its scope if it is given one."""
    stated: dict[str, Any] = {"estop_id": new_epoch(), "nonce": new_epoch(), "t": time.time(), "pressed_at": 1.0}
    stated |= {"reason": "smoke", **fields} | ({} if scope is None else {"scope": scope})
    return signed_stop(KEY, Purpose.EMERGENCY_STOP, "safety-1", stated)


def scope_of(params: dict[str, Any], rules: StopRules | None = None) -> Scope:
    order = (rules or StopRules(allow=(), keys=[PUBLIC])).order("safety-1", params, LISTENER, b"")
    assert isinstance(order, StopOrder), order
    return order.scope


ONLY = {"only": ["arm-1"]}


def test_signed_scope_counts() -> None:
    assert scope_of(stop(ONLY)) == Scope.named(["arm-1"])
    assert scope_of(stop({"cell": "cell-1"})) == Scope(cell="cell-1")
    assert scope_of(stop()) == EVERY_ROBOT
    assert scope_of(json.loads(json.dumps(stop(ONLY)))) == Scope.named(["arm-1"])


@pytest.mark.parametrize("field", ["estop_id", "nonce", "t", "pressed_at"])
def test_scope_of_another_stop_counts_as_every_robot(field: str) -> None:
    one = stop(ONLY)
    other = stop(ONLY, **{name: one[name] for name in ("estop_id", "nonce", "t", "pressed_at") if name != field})
    if field == "pressed_at":
        other = stop(ONLY, **{name: one[name] for name in ("estop_id", "nonce", "t")}, pressed_at=2.0)
    assert scope_of({**one, "scope_sig": other["scope_sig"]}) == EVERY_ROBOT
    assert scope_of({**stop(), "scope": ONLY, "scope_sig": one["scope_sig"]}) == EVERY_ROBOT


@pytest.mark.parametrize(
    "altered",
    [
        {"scope_sig": None},
        {"scope_sig": "AAAA"},
        {"scope_sig": ed25519.encode(bytes(64))},
        {"scope": {"only": ["arm-2"]}},
        {"scope": {"only": ["arm-1", "arm-2"]}},
        {"scope": {"cell": "cell-1"}},
    ],
    ids=str,
)
def test_scope_without_its_own_signature_counts_as_every_robot(altered: dict[str, Any]) -> None:
    assert scope_of({**stop(ONLY), **altered}) == EVERY_ROBOT


def test_signature_of_another_purpose_source_or_key_is_none_of_the_scope() -> None:
    good = stop(ONLY)
    fields = {name: good[name] for name in ("estop_id", "nonce", "t", "pressed_at", "scope")}
    for purpose in set(Purpose) - {Purpose.STOP_SCOPE}:
        sig = ed25519.encode(KEY.sign(covered(purpose, "safety-1", fields)))
        assert scope_of({**good, "scope_sig": sig}) == EVERY_ROBOT
    of_another = ed25519.encode(KEY.sign(scope_bytes("safety-2", good)))
    assert scope_of({**good, "scope_sig": of_another}) == EVERY_ROBOT
    stranger = ed25519.encode(Ed25519PrivateKey.generate().sign(scope_bytes("safety-1", good)))
    assert scope_of({**good, "scope_sig": stranger}) == EVERY_ROBOT
    assert scope_of({**good, "scope_sig": good["sig"]}) == EVERY_ROBOT


def test_signature_of_the_scope_makes_no_stop_of_its_own() -> None:
    good = stop(ONLY)
    refused = StopRules(allow=(), keys=[PUBLIC]).order("safety-1", {**good, "sig": good["scope_sig"]}, LISTENER, b"")
    assert not isinstance(refused, StopOrder)


def test_unsigned_scope_counts_where_unsigned_stops_do() -> None:
    rules = StopRules(allow=(), keys=())
    assert scope_of({"estop_id": new_epoch(), "scope": ONLY}, rules) == Scope.named(["arm-1"])
    # A check of signatures that the network's rules do not demand may be left out, but not failed.
    signed = StopRules(allow=(), keys=[PUBLIC])
    unsigned = {name: value for name, value in stop(ONLY).items() if name not in ("sig", "scope_sig")}
    assert signed.scope("safety-1", unsigned, demanded=False) == Scope.named(["arm-1"])
    assert signed.scope("safety-1", unsigned) == EVERY_ROBOT
    assert signed.scope("safety-1", {**unsigned, "scope_sig": "AAAA"}, demanded=False) == EVERY_ROBOT
    for nonce in (None, [[]], {"a": float("nan")}, 10**400):
        assert signed.scope("safety-1", {**stop(ONLY), "nonce": nonce}) == EVERY_ROBOT


def test_stop_that_is_too_long_to_be_read_stops_every_robot() -> None:
    order = StopRules(allow=(), keys=()).order("safety-1", {}, LISTENER, 2**24)
    assert isinstance(order, StopOrder)
    assert order.scope is EVERY_ROBOT


# Robots of one process.


def order(scope: Scope = EVERY_ROBOT, epoch: str = "", **fields: Any) -> StopOrder:
    return StopOrder(epoch or new_epoch(), "safety-1", "smoke", scope=scope, **fields)


def carried_out(plane: SafetyPlane, given: StopOrder) -> set[str]:
    """The robots that answered a stop."""
    return set(plane.emergency_stop(given))


PATHS = ["lane", "runtime", "mesh"]


@pytest.mark.parametrize("path", PATHS)
def test_robot_outside_of_the_scope_answers_nothing_and_moves_on(plane: SafetyPlane, add: Add, path: str) -> None:
    inside, outside = add("arm-1"), add("arm-2")
    for robot in (inside, outside):
        robot.start()
    eventually(lambda: inside.device.times and outside.device.times)
    reports = plane.emergency_stop(order(Scope.named(["arm-1"]), path=path))
    assert {name: each.stopped for name, each in reports.items()} == {"arm-1": True}
    assert reports["arm-1"].fields()["scope"] == {"only": ["arm-1"]}
    assert inside.refuses() and not outside.refuses()
    assert (len(inside.halts), len(outside.halts)) == (1, 0)
    written = len(outside.device.times)
    eventually(lambda: len(outside.device.times) > written + 20)
    assert plane.robots["arm-2"].latch.seen == ()


def test_robot_at_50_hz_beside_a_stopped_one_keeps_its_permit_and_its_pace(plane: SafetyPlane, add: Add) -> None:
    add("arm-1")
    outside = add("arm-2", hz=50.0)
    outside.start()
    permit = outside.gate.permit("execute")
    eventually(lambda: len(outside.device.times) > 5)
    generation = outside.gate.generation
    for _ in range(50):
        carried_out(plane, order(Scope.named(["arm-1"])))
        plane.clear_local("test")
    assert permit.valid and outside.moving and outside.gate.generation == generation
    before = len(outside.device.times)
    eventually(lambda: len(outside.device.times) > before + 5)


@pytest.mark.parametrize("path", PATHS)
def test_wider_repeat_locks_those_that_the_first_left_out(plane: SafetyPlane, add: Add, path: str) -> None:
    robots = {name: add(name) for name in ("arm-1", "arm-2", "arm-3")}
    epoch = new_epoch()
    assert carried_out(plane, order(Scope.named(["arm-1"]), epoch, path=path)) == {"arm-1"}
    assert carried_out(plane, order(Scope.named(["arm-1", "arm-2"]), epoch, path=path)) == {"arm-1", "arm-2"}
    assert carried_out(plane, order(EVERY_ROBOT, epoch, path=path)) == set(robots)
    assert all(robot.refuses() and len(robot.halts) == 1 for robot in robots.values())
    assert {name: each.epochs for name, each in plane.robots.items()} == dict.fromkeys(robots, (epoch,))


@pytest.mark.parametrize(("first", "second"), [*itertools.permutations(PATHS, 2)])
def test_wider_repeat_counts_while_the_narrow_one_is_under_way(
    plane: SafetyPlane, add: Add, first: str, second: str
) -> None:
    go = threading.Event()
    slow, other = add("arm-1", before_halt=lambda: go.wait(20)), add("arm-2")
    epoch = new_epoch()
    run = plane.begin(order(Scope.named(["arm-1"]), epoch, path=first))
    assert run is not None
    assert not plane.under_way(epoch)
    assert plane.begin(order(EVERY_ROBOT, epoch, path=second)) is not None
    assert other.refuses() and slow.refuses()
    go.set()
    assert run.wait(20)


def test_narrower_repeat_frees_no_robot(plane: SafetyPlane, add: Add) -> None:
    robots = [add("arm-1"), add("arm-2")]
    epoch = new_epoch()
    carried_out(plane, order(EVERY_ROBOT, epoch))
    assert carried_out(plane, order(Scope.named(["arm-1"]), epoch)) == {"arm-1"}
    assert all(robot.refuses() for robot in robots)


def test_wider_repeat_locks_no_robot_that_was_resumed(plane: SafetyPlane, add: Add) -> None:
    resumed, other = add("arm-1"), add("arm-2")
    epoch = new_epoch()
    carried_out(plane, order(Scope.named(["arm-1"]), epoch))
    plane.clear_local("ann")
    carried_out(plane, order(EVERY_ROBOT, epoch))
    assert other.refuses() and not resumed.refuses()


def test_stop_of_a_cell_leaves_the_other_cells_alone(plane: SafetyPlane) -> None:
    robots = {name: RecordingRobot() for name in ("in-1", "in-2", "nowhere", "both")}
    plane.register("in-1", robots["in-1"], cell="cell-1")
    plane.register("in-2", robots["in-2"], cell="cell-2")
    plane.register("nowhere", robots["nowhere"])
    for cell in ("cell-1", "cell-2"):
        plane.register("both", robots["both"], cell=cell)
    assert carried_out(plane, order(Scope(cell="cell-1"))) == {"in-1", "nowhere", "both"}
    assert not robots["in-2"].refuses()
    for robot in robots.values():
        robot.close()


def test_scope_names_a_robot_by_its_name_on_the_network(plane: SafetyPlane) -> None:
    one, other = RecordingRobot(), RecordingRobot()
    plane.register("lab.arm-1", one, wire_id="arm-1")
    plane.register("arm-2", other)
    assert carried_out(plane, order(Scope.named(["lab.arm-1"]))) == set()
    assert carried_out(plane, order(Scope.named(["arm-1"]))) == {"lab.arm-1"}
    for robot in (one, other):
        robot.close()


def test_flood_of_scoped_stops_for_others_leaves_no_trace(plane: SafetyPlane, add: Add) -> None:
    robot = add("arm-1")
    for n in range(500):
        assert plane.begin(order(Scope.named([f"other-{n}"]))) is None
    assert not robot.refuses() and plane.robots["arm-1"].latch.seen == ()


# What is kept and told.


def test_lockout_refusal_and_audit_name_the_scope(plane: SafetyPlane, add: Add) -> None:
    robot = add("arm-1")
    carried_out(plane, order(Scope.named(["arm-1"])))
    (lockout,) = plane.lockouts()["arm-1"]
    assert lockout.fields()["scope"] == {"only": ["arm-1"]}
    assert Lockout.of(lockout.fields()) == lockout
    refusal = robot.gate.lockout("execute")
    assert refusal is not None
    assert refusal["scope"] == {"only": ["arm-1"]}
    assert "for arm-1 only" in str(refusal["reason"])
    records = eventually(lambda: [each for each in read_audit_log() if each["event"] == "emergency_stop"])
    assert records[-1]["payload"]["scope"] == {"only": ["arm-1"]}


def test_lockout_of_every_robot_is_told_as_before(plane: SafetyPlane, add: Add) -> None:
    robot = add("arm-1")
    carried_out(plane, order())
    (lockout,) = plane.lockouts()["arm-1"]
    refusal = robot.gate.lockout("execute")
    assert refusal is not None and "scope" not in refusal and "scope" not in lockout.fields()


def test_scope_outlives_the_process_and_yesterdays_files_still_lock(tmp_path: Path) -> None:
    store, key = LockoutStore(tmp_path), hardware_key("arm", "1")
    with own_plane(None, store) as before:
        robot = RecordingRobot()
        before.register("arm-1", robot, key=key, cell="cell-1")
        carried_out(before, order(Scope(cell="cell-1")))
        robot.close()
    (lockout,) = store.load(key).state.all
    assert lockout.scope == Scope(cell="cell-1")
    # A release that knows no scope reads four fields and writes four.
    file = store.file(key)
    record = json.loads(file.read_text())
    assert {"epoch", "source", "reason", "at"} < record["holds"][0].keys()
    for scope in (None, {}, {"only": []}, [1], "all"):
        record["holds"][0]["scope"] = scope
        file.write_text(json.dumps(record))
        assert store.load(key).state.locked
        assert store.load(key).state.all[0].scope == EVERY_ROBOT
    del record["holds"][0]["scope"]
    file.write_text(json.dumps(record))
    assert store.load(key).state.epochs == (lockout.epoch,)
