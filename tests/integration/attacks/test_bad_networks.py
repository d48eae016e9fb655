"""Stops over a link that loses a tenth and takes 200 ms, and two controllers on the two sides of a partition."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.nats_server import NatsServer
from fixtures.network_lab import NetworkLab, Weather, missing
from fixtures.stop_controller import controller
from fixtures.waiting import eventually
from tests.integration.safety.conftest import Stage

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.safety.orders import new_epoch

pytestmark = pytest.mark.system

ARM = ["arm-1"]
STOPS = 5


@pytest.fixture
def lab() -> Iterator[NetworkLab]:
    if why := missing():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(why)
    with NetworkLab() as made:
        yield made


@pytest.fixture(params=["zenoh", "nats"])
def links(request: pytest.FixtureRequest, lab: NetworkLab) -> Iterator[tuple[LinkConfig, LinkConfig, LinkConfig]]:
    """Links of the robot, of what is on its side of the network, and of what is on the other side."""
    with ExitStack() as stack:
        if request.param == "nats":
            server = stack.enter_context(NatsServer(host=lab.here.address, within=lab.here.within))
            link = LinkConfig(transport="nats", connect=(server.url,))
            yield link, link, link
        else:
            here = f"tcp/{lab.here.address}:7447"
            reached = LinkConfig(mode="peer", connect=(here,), multicast=False)
            yield LinkConfig(mode="peer", listen=(here,), multicast=False), reached, reached


@pytest.fixture
def stage(links: tuple[LinkConfig, LinkConfig, LinkConfig], lab: NetworkLab, tmp_path: Path) -> Iterator[Stage]:
    folder = tmp_path / "robots"
    folder.mkdir(mode=0o700)
    made = Stage(links[0], folder, links[2], lab)
    yield made
    # Processes say goodbye, which needs a network.
    lab.weather = Weather()
    made.close()


def test_every_stop_comes_through_a_tenth_of_loss_and_200_ms_of_delay(stage: Stage, lab: NetworkLab) -> None:
    robots, hand = stage.robots(*ARM), stage.controller()
    stage.meet(hand, *ARM)
    lab.weather = Weather(delay_s=0.2, loss=0.1)
    epochs = []
    for _ in range(STOPS):
        robots.ask("clear")
        robots.ask("move")
        epochs.append(new_epoch())
        report = hand.ask("stop", ARM, 60.0, epochs[-1])
        assert report["ok"], report
        assert report["elapsed_ms"] > 400, "the delay was there"
        eventually(lambda: not robots.ask("facts")["arm-1"]["moving"])
        assert epochs[-1] in robots.ask("facts")["arm-1"]["epochs"]
    assert lab.dropped > 0


def test_stops_of_two_controllers_on_both_sides_of_a_partition_both_count(
    stage: Stage, lab: NetworkLab, links: tuple[LinkConfig, LinkConfig, LinkConfig]
) -> None:
    robots, there = stage.robots(*ARM), stage.controller("safety-2")
    with controller(links[1], "safety-1", within=lab.here.within) as here:
        for hand in (here, there):
            stage.meet(hand, *ARM)
        robots.ask("clear")
        robots.ask("move")
        lab.weather = Weather(parted=True)
        cut_off, reached = new_epoch(), new_epoch()
        there.ask("begin", ARM, 60.0, cut_off)
        eventually(lambda: there.ask("unconfirmed")[1] == ARM, what="the far stop is unconfirmed, by name")
        assert robots.ask("facts")["arm-1"]["moving"]
        assert here.ask("stop", ARM, 20.0, reached)["ok"]
        eventually(lambda: not robots.ask("facts")["arm-1"]["moving"])
        assert robots.ask("facts")["arm-1"]["epochs"] == [reached]
        lab.weather = Weather()
        assert there.ask("result")["ok"]
        assert sorted(robots.ask("facts")["arm-1"]["epochs"]) == sorted([reached, cut_off]), "each needs its resume"
        assert here.ask("stop", ARM, 20.0, reached)["ok"], "a stop of one side answers for no other"
