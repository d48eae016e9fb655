"""Emergency stops of 8 MB: a stranger's delay no true one, an allowed source's stops unread."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.child import Child
from fixtures.nats_server import NatsServer
from fixtures.stop_controller import controller
from fixtures.stop_robots import robots
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect.backends import LinkConfig, loopback_config
from strands_robots.safety import ed25519

ARM = ["arm-1"]
BULK, STOPS = 8 * 2**20, 6
ALLOW, KEYS = "DEVICE_CONNECT_ESTOP_ALLOW", "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS"


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as made:
        yield made


@pytest.fixture(params=["zenoh", "nats"])
def link(request: pytest.FixtureRequest, stack: ExitStack) -> LinkConfig:
    if request.param == "zenoh":
        return loopback_config(free_port())
    return LinkConfig(transport="nats", connect=(stack.enter_context(NatsServer(max_payload=2 * BULK)).url,))


def test_stops_of_a_stranger_delay_no_true_stop_and_take_no_memory(stack: ExitStack, link: LinkConfig) -> None:
    site = stack.enter_context(robots(link, *ARM, environment={ALLOW: "safety-*"}))
    hand, stranger = (stack.enter_context(controller(link, name)) for name in ("safety-1", "stranger"))
    eventually(lambda: site.ask("ready") and hand.ask("stop", ARM, 1.0)["ok"], 30)
    before, took = site.ask("memory_mb"), []
    stranger.ask("bulk", "stranger", BULK, 5.0, 60.0)
    eventually(lambda: stranger.ask("flooded"))
    for _ in range(STOPS):
        site.ask("clear")
        site.ask("move")
        sent = stranger.ask("flooded")
        eventually(lambda sent=sent: stranger.ask("flooded") > sent)
        report = hand.ask("stop", ARM, 10.0)
        assert report["ok"], report
        took.append(report["elapsed_ms"])
    # 8 MB of lists take a parser 0.5 s and more; a busy machine has some milliseconds, seldom some hundred.
    assert statistics.median(took) < 250, took
    assert site.ask("memory_mb") < before + 100
    refused = [each["payload"] for each in site.ask("audit")[0] if each["event"] == "estop_refused"]
    assert {each["source"] for each in refused} == {"stranger"}


def test_stop_that_is_too_long_stops_unread_where_its_source_may_stop(stack: ExitStack, link: LinkConfig) -> None:
    site = stack.enter_context(robots(link, *ARM, environment={ALLOW: "safety-*"}))
    hand, other = (stack.enter_context(controller(link, name)) for name in ("safety-1", "safety-2"))
    eventually(lambda: site.ask("ready") and hand.ask("stop", ARM, 1.0)["ok"], 30)
    site.ask("clear")
    site.ask("move")
    other.ask("bulk", "safety-2", BULK, 1.0, 0.5)
    facts = eventually(lambda: (found := site.ask("facts")["arm-1"])["epochs"] and found)
    assert facts["halts"] >= 1
    eventually(lambda: not site.ask("facts")["arm-1"]["moving"])
    engaged = eventually(lambda: _engaged(site, "safety-2"))
    assert all("was not read" in each["reason"] for each in engaged)


def _engaged(site: Child, source: str) -> list[dict[str, Any]]:
    records = [each["payload"] for each in site.ask("audit")[0] if each["event"] == "remote_estop_engaged"]
    return [each for each in records if each["source"] == source]


def test_stop_that_is_too_long_is_refused_where_only_signed_ones_count(stack: ExitStack, link: LinkConfig) -> None:
    key = Ed25519PrivateKey.generate()
    settings = {ALLOW: "safety-*", KEYS: ed25519.encode(ed25519.public_half(key))}
    site = stack.enter_context(robots(link, *ARM, environment=settings))
    hand = stack.enter_context(controller(link, "safety-1", seed=key.private_bytes_raw().hex()))
    other = stack.enter_context(controller(link, "safety-2"))
    eventually(lambda: site.ask("ready") and hand.ask("stop", ARM, 1.0)["ok"], 30)
    site.ask("clear")
    site.ask("move")
    other.ask("bulk", "safety-2", BULK, 1.0, 0.5)
    eventually(lambda: any(each["event"] == "estop_refused" for each in site.ask("audit")[0]))
    facts = site.ask("facts")["arm-1"]
    assert facts["moving"]
    assert not facts["epochs"]
