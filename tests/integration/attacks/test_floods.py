"""Floods at a process of robots: every true stop is answered, none is green that is not, and memory stays."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.nats_server import NatsServer
from fixtures.plane_process import planned
from fixtures.stop_controller import controller
from fixtures.waiting import eventually

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.safety import ed25519
from strands_robots.safety.orders import new_epoch

STOPS, PATIENCE_S = 10, 20.0
ARM = ["arm-1"]


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as made:
        yield made


@pytest.fixture
def link(stack: ExitStack) -> LinkConfig:
    return LinkConfig(transport="nats", connect=(stack.enter_context(NatsServer()).url,))


def test_true_stops_in_a_flood_of_fresh_ids_are_answered_recorded_and_cost_no_memory(
    stack: ExitStack, link: LinkConfig
) -> None:
    robots = stack.enter_context(planned(ARM, link))
    hand, flooder = (stack.enter_context(controller(link, name)) for name in ("safety-1", "flooder"))
    first = new_epoch()
    eventually(lambda: hand.ask("stop", ARM, 5.0, first)["ok"])
    before = robots.ask("memory_mb")
    flooder.ask("flood", 1, 4000.0, 60.0)
    eventually(lambda: len(robots.ask("facts")["arm-1"]["epochs"]) == 65, what="the flood fills the latch")
    for _ in range(STOPS):
        report = hand.ask("stop", ARM, PATIENCE_S)
        assert report["ok"], report
    assert robots.ask("memory_mb") < 1.2 * before
    assert robots.ask("facts")["arm-1"]["epochs"][0] == first
    # On a busy machine the count is written some seconds after the stops that it counts.
    records = eventually(lambda: with_count(robots.ask("audit")[0]), what="the stops of the flood are counted")
    assert robots.ask("audit")[1]
    engaged = [each["payload"]["estop_id"] for each in records if each["event"] == "remote_estop_engaged"]
    assert engaged[0] == first
    assert len(engaged) <= 65


def with_count(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the records, if one of them counts stops."""
    return records if any(each["event"] == "estops_counted" for each in records) else []


@pytest.mark.parametrize("forged", ["other names", "the controller's name"])
def test_signed_stops_come_through_forged_ones_which_stop_no_robot(
    stack: ExitStack, link: LinkConfig, forged: str
) -> None:
    key = Ed25519PrivateKey.generate()
    public = ed25519.encode(ed25519.public_half(key))
    robots = stack.enter_context(planned(ARM, link, DEVICE_CONNECT_ESTOP_PUBLIC_KEYS=public))
    hand = stack.enter_context(controller(link, "safety-1", seed=key.private_bytes_raw().hex()))
    forger = stack.enter_context(controller(link, "forger"))
    eventually(lambda: hand.ask("stop", ARM, 5.0)["ok"])
    robots.ask("clear")
    robots.ask("move")
    names = ["safety-1"] if forged != "other names" else [f"safety-{number}" for number in range(2, 2002)]
    forger.ask("forge", names, 10_000.0, 60.0)
    eventually(lambda: any(each["event"] == "estop_refused" for each in robots.ask("audit")[0]))
    assert robots.ask("facts")["arm-1"]["moving"]
    for _ in range(STOPS):
        epoch = new_epoch()
        report = hand.ask("stop", ARM, PATIENCE_S, epoch)
        assert report["ok"], report
        facts = robots.ask("facts")["arm-1"]
        assert facts["epochs"] == [epoch]
        assert not facts["moving"]
        robots.ask("clear")
        robots.ask("move")
