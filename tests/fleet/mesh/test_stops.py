"""Stops of all robots on the mesh, on a clock of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

import pytest

from strands_robots.envelope import Envelope
from strands_robots.fleet.adapter import StopRequest
from strands_robots.fleet.mesh import network, peers, stops
from strands_robots.fleet.mesh.network import MeshNetwork
from strands_robots.fleet.mesh.stops import mesh_network
from strands_robots.mesh.transport import config
from strands_robots.mesh.transport.config import Posture
from strands_robots.safety import stop_roster
from strands_robots.safety.roster import Roster


def test_discovery_of_a_stated_endpoint_outlasts_its_retry_pause() -> None:
    pause = config.explicit(Posture.from_settings())["connect"]["retry"]["period_max_ms"] / 1000
    assert pause + config.DISCOVERY_S < config.LINK_DISCOVERY_S


class TimedMesh:
    """A mesh on a clock of its own: robots that come into reach at a time, and the times of its stops."""

    def __init__(
        self,
        arrivals: dict[str, float],
        silent: frozenset[str] = frozenset(),
        facts: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        self.now, self.arrivals, self.silent, self.facts = 0.0, arrivals, silent, facts or {}
        self.peer_id, self.lockout_epoch, self.alive = "tool", "e" * 32, True
        self.stops: list[float] = []
        self.ids: set[str] = set()
        self.reasons: set[str] = set()

    @property
    def peers(self) -> list[dict[str, Any]]:
        there = [name for name, at in self.arrivals.items() if at <= self.now]
        return [{"peer_id": name, "reachable": True, **self.facts.get(name, {})} for name in there]

    def emergency_stop(
        self, signing_key: Any = None, *, reason: str = "", estop_id: str = "", on_answers: Callable[[list[Any]], None]
    ) -> list[dict[str, Any]]:
        self.stops.append(self.now)
        self.reasons.add(reason)
        on_answers([])
        # One press is one stop, however often it is sent.
        self.ids.add(estop_id)
        assert len(self.ids) == 1
        answering = [row["peer_id"] for row in self.peers if row["peer_id"] not in self.silent]
        return [{"responder_id": name, "result": {"ok": True, "stopped": True}} for name in answering]

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
        for thread in threading.enumerate():
            if thread.name == "stop roster":
                # This clock is faster than the disk.
                thread.join(0.05)

    @property
    def peers_by_id(self) -> dict[str, dict[str, Any]]:
        return {row["peer_id"]: row for row in self.peers}

    def listen(self, topic: str, heard: object, name: str) -> bool:
        return True

    def unsubscribe(self, name: str) -> None:
        """Nothing to undo."""

    def close(self) -> None:
        self.alive = False


@pytest.fixture
def timed_mesh(monkeypatch: pytest.MonkeyPatch) -> Callable[..., TimedMesh]:
    def make(arrivals: dict[str, float], **options: Any) -> TimedMesh:
        made = TimedMesh(arrivals, **options)
        monkeypatch.setattr(stops, "time", made)
        monkeypatch.setattr(peers, "time", made)
        monkeypatch.setattr(network, "time", made)
        return made

    return make


def locked(mesh: TimedMesh) -> Envelope:
    """Send the emergency stop of a command that has just joined, and return its answer."""
    there = MeshNetwork.joined(mesh)  # type: ignore[arg-type]
    return there.verdict(there.emergency_stop(StopRequest("a hand")))


def test_loopback_estop_is_sent_at_once_and_again_when_a_robot_appears(timed_mesh: Callable[..., TimedMesh]) -> None:
    mesh = timed_mesh({"arm-1": 0.4, "arm-2": 0.5})
    assert locked(mesh)["robots"] == {"arm-1": "stopped", "arm-2": "stopped"}
    assert len(mesh.stops) == 2
    assert mesh.stops[0] == 0.0
    assert mesh.reasons == {"a hand"}
    assert mesh.now < 1.5


@pytest.mark.parametrize(("facts", "missed"), [({}, []), ({"locked": False}, ["desk"]), ({"type": "robot"}, ["desk"])])
def test_program_that_only_calls_robots_is_missed_by_no_stop(
    timed_mesh: Callable[..., TimedMesh], facts: dict[str, Any], missed: list[str]
) -> None:
    mesh = timed_mesh(
        {"arm-1": 0.0, "desk": 0.3}, silent=frozenset({"desk"}), facts={"desk": {"type": "tool", **facts}}
    )
    assert locked(mesh)["silent"] == missed


@pytest.mark.parametrize("hangs", ["roster", "keys"])
def test_hung_disk_delays_no_further_sending(
    timed_mesh: Callable[..., TimedMesh], monkeypatch: pytest.MonkeyPatch, hangs: str
) -> None:
    mesh, ended, waited = timed_mesh({"arm-1": 0.4}), threading.Event(), list[bool]()

    def hang(*_: object) -> Any:
        waited.append(ended.wait(10.0))
        return {} if hangs == "keys" else Roster(mesh_network())

    where, name = {"roster": (stop_roster.Roster, "of"), "keys": (stops, "enrolled_peers")}[hangs]
    monkeypatch.setattr(where, name, hang)
    try:
        verdict = locked(mesh)
        assert waited == []
    finally:
        ended.set()
    assert len(mesh.stops) >= 2
    assert verdict["status"] == "error"


def test_robot_that_connects_late_to_a_listener_is_stopped(
    timed_mesh: Callable[..., TimedMesh], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENOH_LISTEN", "tcp/127.0.0.1:7447")
    mesh = timed_mesh({"arm-1": 0.4, "arm-2": 5.0, "arm-3": 8.5})
    assert locked(mesh)["robots"] == dict.fromkeys(("arm-1", "arm-2", "arm-3"), "stopped")
    for arrival in mesh.arrivals.values():
        assert any(0 <= at - arrival <= stops.AGAIN_S + peers.LOOK_S for at in mesh.stops), mesh.stops
    assert len(mesh.stops) == 4


def test_connecting_peer_waits_for_its_listener(
    timed_mesh: Callable[..., TimedMesh], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENOH_CONNECT", "tcp/127.0.0.1:7447")
    mesh = timed_mesh({"arm-1": 7.0})
    assert locked(mesh)["stopped"] is True
    assert mesh.now < 7.0 + 2 * config.DISCOVERY_S


def test_robot_that_left_without_an_answer_is_named(
    timed_mesh: Callable[..., TimedMesh], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENOH_LISTEN", "tcp/127.0.0.1:7447")
    mesh = timed_mesh({"arm-1": 0.4, "arm-2": 0.4}, silent=frozenset({"arm-2"}))

    def sleep(seconds: float) -> None:
        mesh.now += seconds
        if mesh.now > 4.0:
            mesh.arrivals.pop("arm-2", None)

    monkeypatch.setattr(mesh, "sleep", sleep)
    verdict = locked(mesh)
    assert (verdict["stopped"], verdict["silent"]) == (None, ["arm-2"])
