"""E-stop links of an MCP server: opened behind its start on each network, closed at its end."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from fixtures.waiting import eventually, free_port
from tests.fleet.scripted import ScriptedNetwork

from strands_robots.device_connect.backends import loopback_config
from strands_robots.fleet import safety_console as module
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.device_connect.network import DeviceConnectNetwork
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.safety_console import DOWN, OPENING, StandingController


class Sender:
    """A controller whose link a test sets."""

    link_up = True


class StandNetwork(ScriptedNetwork):
    """A network whose e-stop link opens once ``may_open`` is set, and fails while ``fault`` is set."""

    def __init__(self, name: str = DEVICE_CONNECT) -> None:
        super().__init__(name)
        self.may_open, self.fault = threading.Event(), ""
        self.tries, self.sender = 0, Sender()
        self.may_open.set()

    @contextmanager
    def standing(self, signing_key: Any, known: Callable[[], Collection[str]]) -> Iterator[Any]:
        self.tries += 1
        assert self.may_open.wait(30)
        if self.fault:
            raise OSError(self.fault)
        self.standing_for.append(known)
        try:
            yield self.sender
        finally:
            self.standing_for.remove(known)


def names() -> set[str]:
    return {each.name for each in threading.enumerate()}


@pytest.fixture
def near() -> StandNetwork:
    return StandNetwork()


@pytest.fixture
def networks(near: StandNetwork) -> Iterator[Networks]:
    with Networks([near]) as joined:
        yield joined


def test_server_goes_on_while_its_link_is_opened(near: StandNetwork, networks: Networks) -> None:
    near.may_open.clear()
    standing = StandingController("helper", networks)
    assert standing.problem == f"{near.name}: {OPENING}"
    standing.open()
    assert not near.standing_for, "the server waited for its e-stop link"
    near.may_open.set()
    eventually(lambda: standing.problem == "", what="its stand")
    near.sender.link_up = False
    assert standing.problem == f"{near.name}: {DOWN}"
    standing.close()
    assert not near.standing_for
    assert f"stand on {near.name}" not in names()


def test_link_that_cannot_be_opened_is_told_and_tried_again(
    near: StandNetwork, networks: Networks, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    near.fault = "no file descriptor is left"
    monkeypatch.setattr(module, "AGAIN_S", 0.01)
    standing = StandingController("helper", networks)
    standing.open()
    eventually(lambda: near.tries > 2, what="further tries")
    assert "no file descriptor is left" in standing.problem
    assert caplog.text.count("helper does not report whom it misses") == 1
    near.fault = ""
    eventually(lambda: standing.problem == "", what="its stand")
    standing.close()
    assert not near.standing_for


def test_close_waits_for_no_further_try(
    near: StandNetwork, networks: Networks, monkeypatch: pytest.MonkeyPatch
) -> None:
    near.fault = "no file descriptor is left"
    monkeypatch.setattr(module, "AGAIN_S", 1000.0)
    standing = StandingController("helper", networks)
    standing.open()
    eventually(lambda: "no file descriptor" in standing.problem, what="the failure")
    standing.close()
    assert f"stand on {near.name}" not in names()


def test_it_stands_on_a_network_that_comes_later_and_names_the_one_where_it_does_not(near: StandNetwork) -> None:
    far = StandNetwork(MESH)
    far.unreachable = "no hub"
    with Networks([near, far], stays=True, unasked={MESH}) as networks:
        standing = StandingController("helper", networks)
        standing.open()
        eventually(lambda: standing.problem == "", what="its stand on the one network that is there")
        far.fault, far.unreachable = "refused", ""
        eventually(lambda: "refused" in standing.problem, what="the failure")
        assert standing.problem.startswith(f"{MESH}: ")
        assert near.standing_for
        standing.close()


def test_network_that_is_not_joined_is_named(near: StandNetwork) -> None:
    near.unreachable = "no broker"
    with Networks([near], stays=True) as networks:
        standing = StandingController("helper", networks)
        standing.open()
        assert standing.problem == f"{near.name}: no broker"
        standing.close()


def test_controller_that_was_never_opened_can_be_closed(networks: Networks) -> None:
    StandingController("helper", networks).close()


def test_no_thread_is_left_of_a_true_link() -> None:
    before = names()
    with Networks([DeviceConnectNetwork(loopback_config(free_port()), "helper")]) as networks:
        standing = StandingController("helper", networks)
        standing.open()
        # The thread that reads the roster begins with the first stop of others.
        eventually(lambda: standing.problem == "", 30.0, what="the link")
        standing.close()
        left = {"standing roster", f"stand on {DEVICE_CONNECT}"}
        eventually(lambda: not left & (names() - before), 10.0, what="its end")
