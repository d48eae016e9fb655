"""Stops of a Reachy Mini that was never linked: its daemon is asked, and nothing is called stopped unasked."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future

import pytest
from fixtures.planes import own_plane
from fixtures.reachy_daemon.broken import FAULTS, BrokenDaemon
from fixtures.reachy_daemon.process import Daemon, Kind
from fixtures.waiting import eventually, free_port

from strands_robots import settings
from strands_robots.device_connect import ReachyMiniDriver
from strands_robots.drivers.reachy import ReachyDriver, rest
from strands_robots.drivers.reachy.rest import ROUNDS_MAX
from strands_robots.hardware import HardwareRobot
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stopping import StopVerdict, graded

pytestmark = pytest.mark.timeout(120)


@pytest.fixture(scope="module", params=[Kind("1.13.0"), Kind("1.4.1")], ids=lambda kind: kind.name)
def shared(request: pytest.FixtureRequest) -> Iterator[Daemon]:
    with Daemon(request.param) as daemon:
        yield daemon


@pytest.fixture
def stranger(daemon: Daemon) -> ReachyDriver:
    """A driver that knows where the daemon is and has never linked to it."""
    return unlinked(daemon.port)


def unlinked(port: int) -> ReachyDriver:
    return ReachyDriver("127.0.0.1", api_port=port)


def senders() -> list[threading.Thread]:
    return [each for each in threading.enumerate() if each.name.startswith("stop-sender")]


def of_the_plane(reachy: ReachyDriver) -> StopVerdict:
    with own_plane(None) as plane:
        plane.register("head", reachy)
        return plane.emergency_stop(StopOrder(new_epoch(), "operator", "test"))["head"].verdict


WAYS: dict[str, Callable[[ReachyDriver], StopVerdict]] = {
    "halt": lambda reachy: reachy.halt("test"),
    "stop": lambda reachy: graded(reachy.stop_task(), "head"),
    "executor": lambda reachy: stop_executor().halt(reachy, "head", "test"),
    "device": lambda reachy: stop_executor().halt(ReachyMiniDriver(robot=reachy).robot, "head", "test"),
    "emergency stop": of_the_plane,
    "as a device of a hardware robot": lambda reachy: HardwareRobot(reachy, "head").halt("test"),
}


@pytest.mark.usefixtures("patient_halts")
@pytest.mark.parametrize("way", WAYS)
def test_a_stop_before_the_first_link_stops_the_moves_of_the_daemon(
    daemon: Daemon, stranger: ReachyDriver, way: str
) -> None:
    daemon.request("POST", "/api/move/goto", json={"antennas": [1.0, 1.0], "duration": 60.0})
    assert len(daemon.running_moves()) == 1
    assert WAYS[way](stranger).stopped is True
    assert daemon.running_moves() == []
    verdict = stranger.halt("again")
    assert (verdict.stopped, verdict.halted) == (True, ()), "asked, and nothing was moving"


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_daemon_that_does_not_say_what_moves_is_unknown_each_time(
    fault: str, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.3" if fault in ("hangs", "drips") else "20")
    with BrokenDaemon(fault) as broken:
        reachy = unlinked(broken.port)
        for _ in range(3):
            assert WAYS[way](reachy).stopped is None


@pytest.mark.usefixtures("patient_halts")
@pytest.mark.parametrize("way", WAYS)
def test_a_daemon_that_is_not_there_is_unknown_each_time(way: str) -> None:
    reachy = unlinked(free_port())
    for _ in range(3):
        verdict = WAYS[way](reachy)
        assert verdict.stopped is None
        assert "Connection refused" in str(verdict.unknown)


@pytest.mark.usefixtures("patient_halts")
def test_a_move_that_the_daemon_lists_and_does_not_stop_did_not_stop() -> None:
    with BrokenDaemon("unstoppable") as broken:
        for _ in range(3):
            verdict = unlinked(broken.port).halt("test")
            assert verdict.stopped is False
            assert "still runs" in str(verdict.not_stopped)


@pytest.mark.usefixtures("patient_halts")
@pytest.mark.parametrize("robot_of", [lambda reachy: reachy, HardwareRobot], ids=["a head", "a device"])
def test_each_of_three_stops_is_sent_while_the_daemon_hangs_at_those_before_it(
    robot_of: Callable[[ReachyDriver], ReachyDriver | HardwareRobot],
) -> None:
    with BrokenDaemon("hangs") as broken:
        robot = robot_of(unlinked(broken.port))
        stops: list[Future[StopVerdict]] = []
        for number in range(3):
            stops.append(stop_executor().submit(robot, "head", "test"))
            eventually(lambda sent=number: len(broken.arrivals) > sent, what="the daemon has the stop")
            time.sleep(0.05)  # later than one stop that is ordered twice
        assert not any(stop.done() for stop in stops), "each was sent although none before it was answered"


def test_many_stops_beside_a_hung_daemon_hold_a_bounded_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "3")
    with BrokenDaemon("hangs") as broken:
        reachy = unlinked(broken.port)
        stops = []
        for _ in range(4 * ROUNDS_MAX):
            stops.append(stop_executor().submit(reachy, "head", "test"))
            time.sleep(0.025)
            assert len(senders()) <= ROUNDS_MAX + 1, "one more stands ready"
        assert all(stop.result(60).stopped is not True for stop in stops)


def test_a_name_server_that_hangs_holds_up_neither_the_verdict_nor_the_next_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked, answer = [], threading.Event()

    def hanging(*args: object, **options: object) -> list[object]:
        asked.append(args[0])
        answer.wait(60)
        raise OSError("no name server")

    monkeypatch.setattr(rest.socket, "getaddrinfo", hanging)
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.3")
    reachy = ReachyDriver("head.lab.example.org")
    try:
        for number in range(3):
            began = time.monotonic()
            assert reachy.halt("test").stopped is None
            assert time.monotonic() - began < 10, "the deadline is 0.3 s, the name server would take 60"
            assert len(asked) == number + 1
    finally:
        answer.set()
    eventually(lambda: len(senders()) == 1, what="their end; one stands ready")


class Locked:
    """A latch that is engaged."""

    epochs = ("e",)

    def refusal(self, verb: str) -> dict[str, object]:
        return {"status": "error", "locked": True, "content": [], "reason": f"{verb} is locked"}


@pytest.mark.usefixtures("patient_halts")
def test_release_on_estop_needs_no_link(daemon: Daemon) -> None:
    reachy = ReachyDriver("127.0.0.1", api_port=daemon.port, release_on_estop=True)
    reachy.gate.attach(Locked())  # type: ignore[arg-type]
    assert reachy.halt("test").stopped is True
    assert daemon.request("GET", "/api/motors/status").json() == {"mode": "disabled"}
    away = ReachyDriver("127.0.0.1", api_port=free_port(), release_on_estop=True)
    away.gate.attach(Locked())  # type: ignore[arg-type]
    assert "torque" in away.halt("test").unknown


def test_deadline_of_a_stop_is_that_of_the_settings() -> None:
    """The rounds' share of the deadline leaves time for the verdict to be told."""
    with BrokenDaemon("hangs") as broken:
        verdict = unlinked(broken.port).halt("test")
    assert verdict.stopped is None
    assert "has not answered within 0.85 s" in str(verdict.unknown)
    assert settings.number("STRANDS_HALT_DEADLINE_S") == 1.0
