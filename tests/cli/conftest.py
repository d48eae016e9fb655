"""Runner for commands, and a fleet in the place of Device Connect."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from click.testing import Result
from fixtures.waiting import free_port
from typer.testing import CliRunner

from strands_robots.cli.app import build
from strands_robots.cli.network import Network
from strands_robots.device_connect.backends import loopback_config
from strands_robots.device_connect.discovery import Peer
from strands_robots.envelope import Envelope, success
from strands_robots.fleet.device_connect.network import DeviceConnectNetwork
from strands_robots.fleet.networks import Networks
from strands_robots.serving.advertised import AdvertisedVerb, find_verb

Run = Callable[..., Result]


@pytest.fixture(autouse=True)
def networks_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """No command meets the user's networks, or those of a test beside this one."""
    for name in ("STRANDS_DC_PORT", "STRANDS_MESH_PORT"):
        monkeypatch.setenv(name, str(free_port()))


@pytest.fixture
def run() -> Run:
    """Run a command line, as ``run("doctor", "--json")``."""

    def call(*arguments: str) -> Result:
        # As the command itself does: building all takes longer than running one.
        return CliRunner().invoke(build(arguments[0] if arguments else ""), list(arguments))

    return call


class FakeFleet:
    """A fleet that answers what the test sets."""

    def __init__(self) -> None:
        self.link, self.source = loopback_config(), "cli"
        self.found: list[Peer] = []
        self.answer: Envelope | BaseException = success("done")
        self.stops: dict[str, Envelope] = {}
        self.called: list[tuple[Any, ...]] = []
        self.stale = ""

    def known(self) -> tuple[str, ...]:
        return tuple(peer.id for peer in self.found)

    def peers(self, timeout: float = 2.0) -> list[Peer]:
        return self.found

    def describe(self, device: str, timeout: float = 1.0) -> Peer:
        return next((peer for peer in self.found if peer.id == device), Peer(device))

    def verb(self, device: str, name: str) -> AdvertisedVerb | None:
        return find_verb(self.describe(device).functions, name)

    def call(self, *called: Any) -> Envelope:
        self.called.append(called)
        if isinstance(self.answer, BaseException):
            raise self.answer
        return self.answer

    def stop(self, device: str, timeout: float, robot_name: str = "") -> Envelope:
        return self.stops[f"{device}/{robot_name}" if robot_name else device]

    def stop_all(self, timeout: float) -> dict[str, Envelope]:
        return self.stops


class Given(DeviceConnectNetwork):
    """Device Connect by a client that is connected already."""

    def open(self) -> None:
        """Do nothing."""


def connect(monkeypatch: pytest.MonkeyPatch, fleet: Any) -> None:
    """Put ``fleet`` in the place of the robots on every network."""

    monkeypatch.setattr(Network, "networks", lambda *_, **__: Networks([Given.joined(fleet)]))


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> FakeFleet:
    fake = FakeFleet()
    connect(monkeypatch, fake)
    return fake
