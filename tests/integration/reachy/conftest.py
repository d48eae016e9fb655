"""Daemons for the tests: the stand-in always, real ones where installed."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import pytest
from fixtures.reachy_daemon.process import Daemon, Kind
from fixtures.waiting import eventually

from strands_robots.drivers.reachy import ReachyDriver

STAND_INS = [Kind("1.13.0", wireless=True), Kind("1.4.1")]
REAL = [Kind("1.13.0", "mock-up"), Kind("1.13.0", "mujoco"), Kind("1.4.1", "mock-up")]

Connect = Callable[..., ReachyDriver]


def finished(reachy: ReachyDriver) -> dict[str, str]:
    """Wait for the end of the present motion and return its facts."""
    motion = reachy.motions.current
    assert motion is not None
    eventually(motion.done.is_set, what=f"the end of {motion.name}")
    return motion.facts()


def every(kinds: list[Kind]) -> list[object]:
    marks = [pytest.mark.timeout(180)]
    system = [*marks, pytest.mark.system]
    return [pytest.param(kind, id=kind.name, marks=system if kind.real else marks) for kind in kinds]


@pytest.fixture(scope="module", params=every(STAND_INS + REAL))
def shared(request: pytest.FixtureRequest) -> Iterator[Daemon]:
    """A running daemon for a module's tests, of every kind in turn."""
    kind: Kind = request.param
    if reason := kind.missing():
        (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)
    with Daemon(kind) as daemon:
        yield daemon


@pytest.fixture
def daemon(shared: Daemon) -> Daemon:
    """The shared daemon at rest: motors on, nothing moving, no fault switched on."""
    if not shared.kind.real:
        shared.control(slow_s=0.0, hub="cached", nan=False, holder="")
    if shared.request("GET", "/api/daemon/status").json()["state"] != "running":
        shared.request("POST", "/api/daemon/restart")
        eventually(
            lambda: shared.request("GET", "/api/daemon/status").json()["state"] == "running", what="running again"
        )
    for move in shared.request("GET", "/api/move/running").json():
        shared.request("POST", "/api/move/stop", json=move)
    shared.request("POST", "/api/motors/set_mode/enabled")
    return shared


@pytest.fixture
def connect(daemon: Daemon) -> Iterator[Connect]:
    """Connected drivers of the daemon, disconnected at the end."""
    drivers: list[ReachyDriver] = []

    def make(**options: object) -> ReachyDriver:
        ports = {"api_port": daemon.port, "zenoh_port": daemon.zenoh_port}
        driver = ReachyDriver("127.0.0.1", **{**ports, **options})  # type: ignore[arg-type]
        drivers.append(driver)
        driver.connect(within_s=40)
        return driver

    yield make
    for driver in drivers:
        driver.disconnect()


@pytest.fixture
def reachy(connect: Connect) -> ReachyDriver:
    """One connected driver."""
    return connect()
