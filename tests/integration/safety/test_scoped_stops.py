"""Stops of one robot or one cell between real processes, on Zenoh and NATS."""

from __future__ import annotations

import json
import secrets
import signal
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.child import Child
from fixtures.waiting import eventually
from tests.integration.safety.conftest import Stage

from strands_robots.device_connect.stop_link import stop_link
from strands_robots.safety import ed25519
from strands_robots.safety.orders import new_epoch, signed_stop
from strands_robots.safety.statements import Purpose
from strands_robots.safety.stop_link import ESTOP, VERDICT, notification


def locked(*processes: Child) -> set[str]:
    return {name for each in processes for name, facts in each.ask("facts").items() if facts["epochs"]}


def goes_on(process: Child, *names: str) -> None:
    """Wait until each of these robots has written many more actions."""
    before = {name: process.ask("facts")[name]["writes"] for name in names}
    eventually(lambda: all(process.ask("facts")[name]["writes"] > before[name] + 20 for name in names))


def free(hand: Child, *processes: Child) -> None:
    """Meet every robot, so that none is unknown, and free them again."""
    names = [name for each in processes for name in each.ask("facts")]
    eventually(lambda: hand.ask("stop", names, 5.0)["ok"], what="the first stop")
    for each in processes:
        each.ask("clear")


@pytest.mark.parametrize("signed", [False, True], ids=["unsigned", "signed"])
def test_stop_of_one_robot_leaves_the_others_of_its_process_moving(stage: Stage, signed: bool) -> None:
    seed = secrets.token_bytes(32)
    public = ed25519.encode(ed25519.public_half(Ed25519PrivateKey.from_private_bytes(seed)))
    keys = {"DEVICE_CONNECT_ESTOP_PUBLIC_KEYS": public} if signed else {}
    one, other = stage.robots("arm-1", "arm-2", **keys), stage.robots("arm-3", **keys)
    hand = stage.controller(seed=seed.hex() if signed else "")
    free(hand, one, other)
    one.ask("move"), other.ask("move")
    report = hand.ask("stop_some", {"only": ["arm-1"]}, 20.0)
    assert (report["ok"], set(report["stopped"]), report["widened"]) == (True, {"arm-1"}, False)
    assert locked(one, other) == {"arm-1"}
    goes_on(one, "arm-2")
    goes_on(other, "arm-3")

    def last_scope() -> dict[str, Any] | None:
        stops = [each for each in one.ask("audit")[0] if each["event"] == "remote_estop_engaged"]
        return stops[-1]["payload"].get("scope")  # type: ignore[no-any-return]

    # A robot answers before the stop is on record.
    eventually(lambda: last_scope() == {"only": ["arm-1"]}, what="the record of the stop with its scope")
    assert one.ask("audit")[1], "the audit verifies"


def test_scope_whose_signature_is_missing_stops_every_robot_where_stops_are_signed(stage: Stage) -> None:
    key = Ed25519PrivateKey.generate()
    public = ed25519.encode(ed25519.public_half(key))
    robots = stage.robots("arm-1", "arm-2", DEVICE_CONNECT_ESTOP_PUBLIC_KEYS=public)
    seed = key.private_bytes_raw().hex()
    free(stage.controller(seed=seed), robots)
    link = stop_link(stage.link)
    link.open((), lambda event, source, payload: None, lambda up: None)
    stated: dict[str, Any] = {"estop_id": new_epoch(), "nonce": new_epoch(), "t": 1.0, "scope": {"only": ["arm-1"]}}
    stop = signed_stop(key, Purpose.EMERGENCY_STOP, "safety-1", stated)
    other = signed_stop(key, Purpose.EMERGENCY_STOP, "safety-1", {**stated, "nonce": new_epoch()})
    try:

        def stopped() -> bool:
            link.publish("safety-1", ESTOP, notification(ESTOP, {**stop, "scope_sig": other["scope_sig"]}))
            return locked(robots) == {"arm-1", "arm-2"}

        eventually(stopped)
    finally:
        link.close()


def test_stop_of_a_cell_reaches_it_and_robots_without_one(stage: Stage) -> None:
    cells = {cell: stage.robots(f"in-{cell or 'none'}", STRANDS_CELL=cell) for cell in ("cell-1", "cell-2", "")}
    hand = stage.controller()
    free(hand, *cells.values())
    cells["cell-2"].ask("move")
    report = eventually(
        lambda: (
            found
            if {*(found := hand.ask("stop_some", {"cell": "cell-1"}, 1.0))["stopped"]} == {"in-cell-1", "in-none"}
            else None
        )
    )
    assert report["widened"] is False
    assert report["stopped"]["in-cell-1"]["facts"]["cell"] == "cell-1"
    assert locked(*cells.values()) == {"in-cell-1", "in-none"}
    goes_on(cells["cell-2"], "in-cell-2")


@pytest.mark.parametrize("scope", [{"only": ["arm-9"]}, {"cell": "cell-9"}], ids=json.dumps)
def test_stop_for_nobody_that_is_there_stops_every_robot(stage: Stage, scope: dict[str, Any]) -> None:
    robots = stage.robots("arm-1", "arm-2", STRANDS_CELL="cell-1")
    hand = stage.controller()
    free(hand, robots)
    robots.ask("move")
    report = hand.ask("stop_some", scope, 3.0, "", False)
    assert (report["widened"], report["ok"], set(report["stopped"])) == (True, False, {"arm-1", "arm-2"})
    assert locked(robots) == {"arm-1", "arm-2"}


def test_wider_repeat_of_one_stop_locks_the_others_under_its_epoch(stage: Stage) -> None:
    robots = stage.robots("arm-1", "arm-2")
    hand, epoch = stage.controller(), new_epoch()
    free(hand, robots)
    assert hand.ask("stop_some", {"only": ["arm-1"]}, 20.0, epoch)["ok"]
    assert locked(robots) == {"arm-1"}
    assert hand.ask("stop", ["arm-1", "arm-2"], 20.0, epoch)["ok"]
    facts = robots.ask("facts")
    assert [facts[name]["epochs"] for name in ("arm-1", "arm-2")] == [[epoch], [epoch]]


def test_robot_that_reads_no_scope_stops_and_is_in_the_report(stage: Stage) -> None:
    robots, hand = stage.robots("arm-1", "arm-2"), stage.controller()
    free(hand, robots)
    yesterday = stop_link(stage.link)

    def answer(event: str, source: str, payload: bytes | int) -> None:
        assert isinstance(payload, bytes)
        verdict = {"device_id": "yesterday", "estop_id": json.loads(payload)["params"]["estop_id"], "stopped": True}
        yesterday.publish("yesterday", VERDICT, notification(VERDICT, verdict))

    yesterday.open((ESTOP,), answer, lambda up: None)
    try:
        eventually(lambda: "yesterday" in hand.ask("stop_some", {"only": ["arm-1"]}, 0.5)["stopped"])
        assert locked(robots) == {"arm-1"}
    finally:
        yesterday.close()


def test_robot_outside_of_the_scope_that_was_away_is_not_locked_by_it(stage: Stage) -> None:
    inside, away = stage.robots("arm-1"), stage.robots("arm-2")
    hand, scoped, everyone = stage.controller(), new_epoch(), new_epoch()
    free(hand, inside, away)
    away.signal(signal.SIGSTOP)
    try:
        assert hand.ask("stop_some", {"only": ["arm-1"]}, 20.0, scoped)["ok"]
        # What it learns of this one shows that it was told of what it missed.
        hand.ask("stop", ["arm-1", "arm-2"], 1.0, everyone)
    finally:
        away.signal(signal.SIGCONT)
    eventually(lambda: away.ask("facts")["arm-2"]["epochs"])
    assert away.ask("facts")["arm-2"]["epochs"] == [everyone]
    assert inside.ask("facts")["arm-1"]["epochs"] == [scoped, everyone]
