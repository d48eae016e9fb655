"""Hostile and mistaken messages at whole devices: who may stop, what is played again, who may resume."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.child import Child
from fixtures.waiting import eventually
from tests.integration.safety.conftest import Stage

from strands_robots.device_connect import FleetClient
from strands_robots.device_connect.stop_link import stop_link
from strands_robots.safety import ed25519
from strands_robots.safety.orders import new_epoch, signed_bytes
from strands_robots.safety.resume import sign
from strands_robots.safety.statements import Purpose
from strands_robots.safety.stop_link import ESTOP, StopLink, notification

Send = Callable[..., bool]


@pytest.fixture
def link(stage: Stage) -> Iterator[StopLink]:
    """A link of the test's own, on which anybody may be named as the source."""
    made = stop_link(stage.link)
    made.open((), lambda event, source, payload: None, lambda up: None)
    yield made
    made.close()


def held(robots: Child, name: str = "arm-1") -> list[str]:
    """The epochs that hold the robot."""
    epochs: list[str] = robots.ask("facts")[name]["epochs"]
    return epochs


def halts(robots: Child) -> int:
    """Count the halts of the robot: a moment after it was locked, on a thread of its own."""
    count: int = robots.ask("facts")["arm-1"]["halts"]
    return count


def events(robots: Child, name: str) -> list[dict[str, Any]]:
    """Return the records of this name from the audit, which verifies."""
    records, verifies = robots.ask("audit")
    assert verifies
    return [each["payload"] for each in records if each["event"] == name]


def stop_as(link: StopLink, robots: Child, source: str) -> str:
    """Send stops of ``source`` until one holds the robot and has halted it; its epoch."""
    epoch, before = new_epoch(), halts(robots)

    def holds() -> bool:
        link.publish(source, ESTOP, notification(ESTOP, {"estop_id": epoch, "t": time.time()}))
        return epoch in held(robots)

    eventually(holds, what=f"a stop of {source}")
    eventually(lambda: halts(robots) > before, what=f"the halt of {source}")
    return epoch


def test_the_allowlist_takes_globs_ignores_blanks_and_minds_the_case(stage: Stage, link: StopLink) -> None:
    robots = stage.robots("arm-1", DEVICE_CONNECT_ESTOP_ALLOW="safety-*, ,Guard")
    eventually(lambda: link.up)
    stop_as(link, robots, "safety-7")
    stop_as(link, robots, "Guard")
    robots.ask("clear")
    robots.ask("move")
    strangers = {"SAFETY-7", "Safety-7", "guard", "safety", "asafety-7"}

    def all_refused() -> bool:
        for source in strangers:
            link.publish(source, ESTOP, notification(ESTOP, {"estop_id": new_epoch()}))
        return strangers <= {each["source"] for each in events(robots, "estop_refused")}

    eventually(all_refused)
    # What was sent after all of them has arrived, and holds alone.
    assert robots.ask("facts")["arm-1"]["moving"]
    last = stop_as(link, robots, "safety-8")
    assert held(robots) == [last]


def test_a_blank_allowlist_is_no_list(stage: Stage, link: StopLink) -> None:
    robots = stage.robots("arm-1", DEVICE_CONNECT_ESTOP_ALLOW=" , ")
    eventually(lambda: link.up)
    epoch = stop_as(link, robots, "anybody")
    assert eventually(lambda: [e for e in events(robots, "remote_estop_engaged") if e["estop_id"] == epoch])


def test_a_recorded_stop_played_again_after_its_resume_holds_nobody(stage: Stage, link: StopLink) -> None:
    robots = stage.robots("arm-1")
    eventually(lambda: link.up)
    recorded = notification(ESTOP, {"estop_id": new_epoch(), "t": time.time()})

    def holds() -> bool:
        link.publish("safety-1", ESTOP, recorded)
        return bool(held(robots))

    eventually(holds, what="the first time")
    eventually(lambda: halts(robots))
    robots.ask("clear")
    robots.ask("move")
    for _ in range(20):
        link.publish("safety-1", ESTOP, recorded)
    # One that is new passes the same way after them.
    last = stop_as(link, robots, "safety-2")
    assert held(robots) == [last]


def test_a_signed_stop_comes_through_ten_thousand_forged_ones_a_second(stage: Stage) -> None:
    key = Ed25519PrivateKey.generate()
    public = ed25519.encode(ed25519.public_half(key))
    robots = stage.robots("arm-1", DEVICE_CONNECT_ESTOP_ALLOW="safety-*", DEVICE_CONNECT_ESTOP_PUBLIC_KEYS=public)
    hand, forger = stage.controller("safety-1", key.private_bytes_raw().hex()), stage.controller("forger")
    stage.meet(hand, "arm-1")
    robots.ask("clear")
    robots.ask("move")
    before = robots.ask("facts")["arm-1"]
    forger.ask("forge", ["forger", "safety-9", "safety-1"], 10_000.0, 3.0)
    eventually(lambda: {"forger", "safety-9"} <= {each["source"] for each in events(robots, "estop_refused")})
    during = robots.ask("facts")["arm-1"]
    assert during["moving"]
    assert during["halts"] == before["halts"]
    epoch = new_epoch()
    assert hand.ask("stop", ["arm-1"], 30.0, epoch)["ok"]
    assert held(robots) == [epoch]
    # Told of once in a while, not each time.
    assert len(events(robots, "estop_refused")) < 20


def test_a_signature_does_not_pass_from_one_source_or_stop_to_another(stage: Stage, link: StopLink) -> None:
    key = Ed25519PrivateKey.generate()
    public = ed25519.encode(ed25519.public_half(key))
    robots = stage.robots("arm-1", DEVICE_CONNECT_ESTOP_PUBLIC_KEYS=public)
    eventually(lambda: link.up)

    def signed(source: str, **changed: Any) -> bytes:
        fields: dict[str, Any] = {"estop_id": new_epoch(), "t": time.time(), "nonce": new_epoch()}
        signature = key.sign(signed_bytes(Purpose.EMERGENCY_STOP, source, fields))
        return notification(ESTOP, {**fields, "sig": ed25519.encode(signature), **changed})

    true = signed("safety-1")

    def all_refused() -> bool:
        link.publish("safety-2", ESTOP, true)
        link.publish("safety-3", ESTOP, signed("safety-3", estop_id=new_epoch()))
        link.publish("safety-4", ESTOP, signed("safety-4", t=time.time() + 1))
        return {"safety-2", "safety-3", "safety-4"} == {each["source"] for each in events(robots, "estop_refused")}

    eventually(all_refused)
    assert held(robots) == []

    def holds() -> bool:
        link.publish("safety-1", ESTOP, true)
        return bool(held(robots))

    eventually(holds, what="the true one")
    assert len(held(robots)) == 1


def test_wrong_resumes_free_no_robot_and_five_of_them_start_a_back_off(stage: Stage) -> None:
    key, stranger = Ed25519PrivateKey.generate(), Ed25519PrivateKey.generate()
    public = ed25519.encode(ed25519.public_half(key))
    robots = stage.robots("arm-1", "arm-2", STRANDS_MESH_RESUME_PUBLIC_KEY=public)
    hand = stage.controller()
    stage.meet(hand, "arm-1", "arm-2")
    robots.ask("clear")
    old, now = new_epoch(), new_epoch()
    assert hand.ask("stop", ["arm-1", "arm-2"], 20.0, old)["ok"]
    robots.ask("clear")
    assert hand.ask("stop", ["arm-1", "arm-2"], 20.0, now)["ok"]
    with FleetClient(stage.link, "operator") as fleet:

        def resume(name: str, assertion: dict[str, Any]) -> bool:
            return bool(fleet.call(name, "resume", {"assertion": assertion})["status"] == "success")

        (good,) = sign(key, now, ["arm-1", "arm-2"])
        assert resume("arm-1", good)
        assert not robots.ask("facts")["arm-1"]["locked"]
        assert not robots.ask("facts")["arm-1"]["moving"]
        (for_another,) = sign(key, now, ["arm-1"])
        (of_before,) = sign(key, old, ["arm-2"])
        (of_a_stranger,) = sign(stranger, now, ["arm-2"])
        wrong = [for_another, of_before, of_a_stranger, {**good, "t": good["t"] + 1}, {"v": 1}]
        outcomes = [resume("arm-2", each) for each in wrong]
        assert outcomes == [False] * 5
        # Five refusals: now even the good one has to wait.
        assert not resume("arm-2", good)
        assert hand.ask("stop", ["arm-1"], 20.0)["ok"]
        assert not resume("arm-1", good)
    assert held(robots, "arm-2")[0] == now
    denied = [each["why"] for each in events(robots, "resume_denied")]
    for part in ("not among the targets", "epoch is not held", "made the signature", "backing off"):
        assert any(part in why for why in denied), part
    assert len(events(robots, "resume_ok")) == 1
