"""Stops over a network that parts, loses and delays: namespaces and TAP devices, both transports."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from fixtures.child import Child
from fixtures.nats_server import NatsServer
from fixtures.network_lab import NetworkLab, Weather, missing
from fixtures.stop_controller import controller
from fixtures.stop_robots import robots
from fixtures.waiting import eventually
from tests.integration.safety.conftest import Stage

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.safety.orders import new_epoch

pytestmark = pytest.mark.system

GONE_S = 16.0


@pytest.fixture
def lab() -> Iterator[NetworkLab]:
    if why := missing():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(why)
    with NetworkLab() as made:
        yield made


@pytest.fixture(params=["zenoh", "nats"])
def far(request: pytest.FixtureRequest, lab: NetworkLab, tmp_path: Path) -> Iterator[Stage]:
    """Robots here, with the broker where there is one, and controllers there."""
    folder = tmp_path / "robots"
    folder.mkdir(mode=0o700)
    with ExitStack() as stack:
        if request.param == "nats":
            server = stack.enter_context(NatsServer(host=lab.here.address, within=lab.here.within))
            near = there = LinkConfig(transport="nats", connect=(server.url,))
        else:
            here = f"tcp/{lab.here.address}:7447"
            near = LinkConfig(mode="peer", listen=(here,), multicast=False)
            there = LinkConfig(mode="peer", connect=(here,), multicast=False)
        made = Stage(near, folder, there, lab)
        stack.callback(made.close)
        yield made
        # Processes say goodbye, which needs a network.
        lab.weather = Weather()


def moving(far: Stage, **settings: str) -> tuple[Child, Child]:
    """A robot that moves and a controller that has reached it and checks in."""
    robots, hand = far.robots("arm-1", **settings), far.controller()
    hand.ask("check_in", 0.2)
    far.meet(hand, "arm-1")
    eventually(lambda: robots.ask("checked_in") == ["safety-1"], what="a check-in at the listener")
    robots.ask("clear")
    robots.ask("move")
    return robots, hand


def facts(robots: Child) -> dict[str, Any]:
    found: dict[str, Any] = robots.ask("facts")["arm-1"]
    return found


def engaged(robots: Child, epoch: str) -> bool:
    """The audit verifies and holds this stop."""
    records, verifies = robots.ask("audit")
    assert verifies
    return any(each["event"] == "remote_estop_engaged" and each["payload"]["estop_id"] == epoch for each in records)


def test_a_robot_in_reach_is_stopped_while_the_hosts_of_others_are_gone(lab: NetworkLab, tmp_path: Path) -> None:
    here = f"tcp/{lab.here.address}:7447"
    near = LinkConfig(mode="peer", listen=(here,), multicast=False)
    dialling = LinkConfig(mode="peer", connect=(here,), multicast=False)
    with ExitStack() as stack:
        for name, link, side in (
            ("arm-1", near, lab.here),
            ("arm-2", dialling, lab.there),
            ("arm-3", dialling, lab.there),
        ):
            state = tmp_path / name
            state.mkdir(mode=0o700)
            environment = {"STRANDS_STATE_DIR": str(state)}
            child = stack.enter_context(robots(link, name, environment=environment, within=side.within))
            eventually(lambda child=child: child.ask("ready"), what="the e-stop link")  # type: ignore[misc]
        hand = stack.enter_context(controller(dialling, "safety-1", within=lab.here.within))
        assert hand.ask("up", 30.0)
        eventually(lambda: hand.ask("stop", ["arm-1", "arm-2", "arm-3"], 5.0)["ok"], what="the first stop")
        stack.callback(lambda: setattr(lab, "weather", Weather()))
        lab.weather.parted = True
        # Links are given up after 4 and 10 s; a thread of Zenoh's that closed one would wait 10 s more.
        gone = time.monotonic() + GONE_S
        while time.monotonic() < gone:
            report = hand.ask("stop", ["arm-1"], 5.0)
            assert report["ok"], str(report)


@pytest.mark.parametrize("parted_s", [0.5, 4.5], ids=["briefly", "beyond the lease"])
def test_a_partition_is_told_and_the_stop_arrives_when_it_heals(far: Stage, lab: NetworkLab, parted_s: float) -> None:
    robots, hand = moving(far)
    lab.weather.parted = True
    epoch = new_epoch()
    hand.ask("begin", ["arm-1"], 60.0, epoch)
    age_ms, unconfirmed, _ = eventually(lambda: (told := hand.ask("unconfirmed"))[1] and told)
    assert unconfirmed == ["arm-1"]
    assert age_ms >= 100
    # The length of the fault, not a wait for its end: the longer one outlasts the e-stop link's lease of 4 s.
    time.sleep(parted_s)
    assert lab.dropped > 0
    assert facts(robots)["moving"]
    lab.weather.parted = False
    report = hand.ask("result")
    assert report["ok"], str(report)
    assert facts(robots)["epochs"] == [epoch]
    eventually(lambda: not facts(robots)["moving"])
    assert eventually(lambda: engaged(robots, epoch))


def test_stops_come_through_delay_jitter_and_loss_one_after_another(far: Stage, lab: NetworkLab) -> None:
    robots, hand = moving(far)
    lab.weather = Weather(delay_s=0.03, jitter_s=0.02, loss=0.1)
    for _ in range(4):
        epoch = new_epoch()
        assert hand.ask("stop", ["arm-1"], 30.0, epoch)["ok"]
        assert epoch in facts(robots)["epochs"]
        assert not facts(robots)["moving"] or eventually(lambda: not facts(robots)["moving"])
        robots.ask("clear")
        robots.ask("move")
    assert lab.dropped > 0


def test_a_robot_that_needs_a_controller_stops_by_itself_when_it_is_cut_off(far: Stage, lab: NetworkLab) -> None:
    robots, _ = moving(far, STRANDS_CHECKIN_TIMEOUT_S="3.0")
    assert facts(robots)["moving"]
    lab.weather.parted = True
    eventually(lambda: facts(robots)["locked"], what="the robot locked by itself")
    eventually(lambda: not facts(robots)["moving"])

    def lapses() -> list[dict[str, Any]]:
        stops = [each["payload"] for each in robots.ask("audit")[0] if each["event"] == "emergency_stop"]
        return [each for each in stops if each["road"] == "check-in" and "safety-1" in each["reason"]]

    assert eventually(lapses)[0]["stopped"] is True
