"""Robots that were frozen, cut off or killed while a stop was sent lock by it when they are back: real processes."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from fixtures.child import Child
from fixtures.nats_server import NatsServer
from fixtures.stop_robots import robots
from fixtures.tcp_proxy import TcpProxy
from fixtures.waiting import eventually, free_port
from fixtures.zenoh_router import ZenohRouter
from tests.integration.safety.conftest import Stage

from strands_robots.device_connect.backends import LinkConfig, loopback_config
from strands_robots.safety.sighting_file import SightingFile

pytestmark = pytest.mark.system

NOTICED_S = 1.0
"""A process that was frozen for less than half a second does not notice it."""

BEYOND_THE_LEASE_S = 5.0


@pytest.fixture(params=["zenoh peers", "zenoh router", "nats"])
def site(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Stage]:
    """Robots and controllers on one network; ``site.proxied`` leads there by a proxy, where there is a broker."""
    folder = tmp_path / "robots"
    folder.mkdir(mode=0o700)
    with ExitStack() as stack:
        if request.param == "nats":
            server = stack.enter_context(NatsServer())
            link = LinkConfig(transport="nats", connect=(server.url,))
        elif request.param == "zenoh router":
            router = stack.enter_context(ZenohRouter())
            link = LinkConfig(connect=(router.endpoint,), mode="client")
        else:
            link = loopback_config(free_port())
        made = Stage(link, folder)
        stack.callback(made.close)
        yield made


@pytest.fixture
def proxy(site: Stage) -> Iterator[TcpProxy]:
    if not site.link.connect:
        pytest.skip("peers find one another whatever stands between two of them")
    with TcpProxy(int(site.link.connect[0].rpartition(":")[2])) as made:
        yield made


def epochs(child: Child, name: str) -> list[str]:
    found: list[str] = child.ask("facts")[name]["epochs"]
    return found


def locked(child: Child, name: str, epoch: str) -> None:
    """Wait until the robot is locked by this stop, and by no other."""
    eventually(lambda: epochs(child, name), 10.0, "a lockout")
    assert epochs(child, name) == [epoch], [each["event"] for each in child.ask("audit")[0]]


@contextmanager
def frozen(child: Child, seconds: float) -> Iterator[None]:
    """Freeze a process for the block, and for so many seconds at least."""
    child.signal(signal.SIGSTOP)
    began = time.monotonic()
    yield
    # The length of the fault, not a wait for its end.
    time.sleep(max(0.0, seconds - (time.monotonic() - began)))
    child.signal(signal.SIGCONT)


def stopped_once(site: Stage, *expected: str) -> str:
    """Stop by a controller that is gone before anybody is back; return the stop's id."""
    hand = site.controller()
    report = hand.ask("stop", list(expected), 10.0)
    assert report["ok"], report
    hand.kill()
    return str(report["estop_id"])


def met(site: Stage, *ids: str) -> None:
    """Have every robot stopped once, so that all are reached, and freed again; this machine remembers them."""
    hand = site.controller("probe")
    site.meet(hand, *ids)
    hand.close()
    remembered = SightingFile(site.folder).served
    eventually(lambda: all(remembered(each) for each in ids), what="the memory of who is served")


@pytest.mark.parametrize("frozen_s", [NOTICED_S, BEYOND_THE_LEASE_S], ids=["shortly", "beyond the lease"])
def test_robot_frozen_during_a_stop_is_locked_once_it_runs(site: Stage, frozen_s: float) -> None:
    here, away = site.robots("arm-1"), site.robots("arm-2")
    met(site, "arm-1", "arm-2")
    here.ask("clear"), away.ask("clear")
    away.ask("move")
    with frozen(away, frozen_s):
        epoch = stopped_once(site, "arm-1")
    locked(away, "arm-2", epoch)
    eventually(lambda: not away.ask("facts")["arm-2"]["moving"])


def test_robot_that_was_cut_off_is_locked_once_its_link_is_back(site: Stage, proxy: TcpProxy) -> None:
    here = site.robots("arm-1")
    scheme, _, _ = site.link.connect[0].rpartition(":")
    direct, site.link = site.link, replace(site.link, connect=(f"{scheme}:{proxy.port}",))
    away = site.robots("arm-2")
    site.link = direct
    met(site, "arm-1", "arm-2")
    here.ask("clear"), away.ask("clear")
    away.ask("move")
    proxy.state = "refusing"
    eventually(lambda: not away.ask("ready"), what="the cut")
    epoch = stopped_once(site, "arm-1")
    assert away.ask("facts")["arm-2"]["moving"]
    proxy.state = "passing"
    locked(away, "arm-2", epoch)
    eventually(lambda: not away.ask("facts")["arm-2"]["moving"])


def test_answerer_that_was_killed_and_restarted_still_answers(site: Stage) -> None:
    here, away = site.robots("arm-1"), site.robots("arm-2")
    met(site, "arm-1", "arm-2")
    here.ask("clear"), away.ask("clear")
    with frozen(away, NOTICED_S):
        epoch = stopped_once(site, "arm-1")
        here.kill()
        again = site.robots("arm-1")
        assert epochs(again, "arm-1") == [epoch]
    locked(away, "arm-2", epoch)


def test_robot_that_was_killed_before_the_stop_asks_when_it_is_started_again(site: Stage) -> None:
    here, away = site.robots("arm-1"), site.robots("arm-2")
    met(site, "arm-1", "arm-2")
    here.ask("clear"), away.ask("clear")
    away.kill()
    epoch = stopped_once(site, "arm-1")
    again = site.robots("arm-2")
    locked(again, "arm-2", epoch)


def test_robot_that_was_resumed_stays_free_though_another_one_is_locked(site: Stage) -> None:
    here, away = site.robots("arm-1"), site.robots("arm-2")
    met(site, "arm-1", "arm-2")
    here.ask("clear"), away.ask("clear")
    epoch = stopped_once(site, "arm-1", "arm-2")
    away.ask("clear")
    away.signal(signal.SIGSTOP)
    time.sleep(1.0)
    away.signal(signal.SIGCONT)
    # It asks at once and after two seconds; each time the other robot answers.
    time.sleep(3.5)
    assert epochs(here, "arm-1") == [epoch]
    assert epochs(away, "arm-2") == []
    away.kill()
    again = robots(site.link, "arm-2", environment={"STRANDS_STATE_DIR": str(site.folder)})
    try:
        eventually(lambda: again.ask("ready"))
        time.sleep(3.5)
        assert epochs(again, "arm-2") == []
    finally:
        again.close()
