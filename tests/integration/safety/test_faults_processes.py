"""Brokers that die in mid-stop, stops that come again after a crash: whole devices, in processes of their own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.child import Child
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually
from fixtures.zenoh_router import ZenohRouter
from tests.integration.safety.conftest import Stage

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.persistence import LockoutStore


def recorded(robots: Child, epoch: str) -> list[dict[str, Any]]:
    """Return the audit records of this stop; the log verifies."""
    records, verifies = robots.ask("audit")
    assert verifies
    return [each["payload"] for each in records if each["payload"].get("estop_id") == epoch]


def test_a_stop_played_again_after_a_crash_holds_only_where_it_was_never_resumed(stage: Stage) -> None:
    robots, hand = stage.robots("arm-1"), stage.controller()
    stage.meet(hand, "arm-1")
    robots.ask("clear")
    resumed, held = new_epoch(), new_epoch()
    assert hand.ask("stop", ["arm-1"], 20.0, resumed)["ok"]
    robots.ask("clear")
    assert hand.ask("stop", ["arm-1"], 20.0, held)["ok"]
    # A verdict waits neither for a slow disk nor for the record; a kill -9 before the disk has it is another test's.
    stored = LockoutStore(stage.folder)
    eventually(lambda: [each.state.epochs for each in stored.load_all().values()] == [(held,)])
    assert eventually(lambda: recorded(robots, held))
    robots.kill()
    again = stage.robots("arm-1")
    stage.meet(hand, "arm-1")
    assert again.ask("facts")["arm-1"]["epochs"][0] == held
    again.ask("clear")
    again.ask("move")
    replayed = hand.ask("stop", ["arm-1"], 30.0, resumed)
    assert "resumed before" in replayed["refused"]["arm-1"]["why"]
    facts = again.ask("facts")["arm-1"]
    assert facts["moving"]
    assert not facts["locked"]
    assert recorded(again, held)


def test_two_controllers_at_once_hold_a_whole_device_twice(stage: Stage) -> None:
    robots, hands = stage.robots("arm-1", "arm-2"), [stage.controller("safety-1"), stage.controller("safety-2")]
    for hand in hands:
        stage.meet(hand, "arm-1", "arm-2")
    robots.ask("clear")
    robots.ask("move")
    epochs = [new_epoch(), new_epoch()]
    for hand, epoch in zip(hands, epochs, strict=True):
        hand.ask("begin", ["arm-1", "arm-2"], 20.0, epoch)
    assert all(hand.ask("result")["ok"] for hand in hands)
    assert all(set(facts["epochs"]) == set(epochs) for facts in robots.ask("facts").values())
    eventually(lambda: not any(facts["moving"] for facts in robots.ask("facts").values()), what="both loops over")
    for epoch in epochs:
        assert eventually(lambda epoch=epoch: len(recorded(robots, epoch)) >= 2)  # type: ignore[misc]


@pytest.fixture(params=["zenoh router", "nats"])
def broker(request: pytest.FixtureRequest) -> Iterator[ZenohRouter | NatsServer]:
    with NatsServer() if request.param == "nats" else ZenohRouter() as running:
        yield running


@pytest.fixture
def brokered(broker: ZenohRouter | NatsServer, tmp_path: Path) -> Iterator[Stage]:
    folder = tmp_path / "robots"
    folder.mkdir(mode=0o700)
    if isinstance(broker, NatsServer):
        made = Stage(LinkConfig(transport="nats", connect=(broker.url,)), folder)
    else:
        made = Stage(LinkConfig(connect=(broker.endpoint,), mode="client"), folder)
    yield made
    made.close()


def test_a_broker_killed_in_mid_stop_is_told_and_the_stop_arrives_when_it_is_back(
    broker: ZenohRouter | NatsServer, brokered: Stage
) -> None:
    robots, hand = brokered.robots("arm-1"), brokered.controller()
    brokered.meet(hand, "arm-1")
    robots.ask("clear")
    robots.ask("move")
    broker.kill()
    eventually(lambda: hand.ask("lost_at"), what="the loss of the link told")
    epoch = new_epoch()
    hand.ask("begin", ["arm-1"], 60.0, epoch)
    # The stop is under way and has nowhere to go: said by name, and kept.
    assert eventually(lambda: hand.ask("unconfirmed")[1]) == ["arm-1"]
    assert robots.ask("facts")["arm-1"]["moving"]
    broker.start()
    assert hand.ask("result")["ok"]
    facts = robots.ask("facts")["arm-1"]
    assert facts["epochs"] == [epoch]
    eventually(lambda: not robots.ask("facts")["arm-1"]["moving"], what="the loop over")
    assert eventually(lambda: recorded(robots, epoch))


FORKED = """
import os
from fixtures.devices import RecordingDevice
from strands_robots.hardware import HardwareRobot
robot = HardwareRobot(RecordingDevice(), "arm")
robot.connect()
assert robot.halt("parent").stopped
child = os.fork()
assert robot.halt("both").stopped
if child:
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
"""


def test_forked_process_halts_its_robots() -> None:
    subprocess.run([sys.executable, "-c", FORKED], timeout=60, check=True)
