"""Forty robots that hang delay the halt of no other robot whose holder was killed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass

import pytest
from fixtures.child import Child
from fixtures.leased_robots import leased_robots
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually

TTL_S = 3.0
LATE_S = 0.25
"""Far below the deadline of a halt, for which a line behind a wedged robot would wait; the benchmark has the bound."""
HEALTHY = [f"arm-{number}" for number in range(6)]
WEDGED = 40


@dataclass
class Site:
    """The process of the robots, and the holder of all of them."""

    robots: Child
    holder: Child
    names: list[str]


@pytest.fixture(params=["status", "halt"])
def site(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "*")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    wedges = {f"hangs-{number}": request.param for number in range(WEDGED)} | dict.fromkeys(HEALTHY, "")
    with ExitStack() as stack:
        server = stack.enter_context(NatsServer())
        robots = stack.enter_context(leased_robots(server.url, wedges))
        holder = stack.enter_context(Child("fixtures.lease_holder", {"url": server.url}))
        yield Site(robots, holder, list(wedges))


def test_healthy_robots_of_a_killed_holder_halt_in_time_beside_forty_that_hang(site: Site) -> None:
    assert site.holder.ask("move", site.names, TTL_S) == ["success"] * len(site.names)
    due = leases_end(site.robots)
    site.robots.ask("hang")
    site.holder.kill()
    late = lateness(site.robots, due)
    assert all(0.0 <= each <= LATE_S for each in late.values()), late


def leases_end(robots: Child) -> dict[str, float]:
    """Return when the leases end that robots know of now."""
    return {name: at for name, at in robots.ask("due").items() if at is not None}


def lateness(robots: Child, due: dict[str, float]) -> dict[str, float]:
    """Return by healthy robot the seconds from the end of its lease to its standstill."""

    def halted() -> dict[str, float]:
        # A renewal that was under way at the kill may still arrive.
        due.update(leases_end(robots))
        still = robots.ask("still")
        return {name: still[name] - due[name] for name in HEALTHY} if all(still[name] for name in HEALTHY) else {}

    return eventually(halted, TTL_S + 15.0, "the halt of every healthy robot")
