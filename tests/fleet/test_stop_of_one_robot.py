"""A stop of one id: it goes to every bearer, and no silence of a network is taken for an absence."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from tests.fleet.scripted import OURS, ScriptedNetwork

from strands_robots.envelope import Envelope, error, success
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH, STOP_S, FoundRobot
from strands_robots.fleet.fleet import Fleet
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.remote_robot import RemoteRobot
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.roster import Roster
from strands_robots.safety.sightings import Known, RosterRow

Stop = Callable[[Networks], dict[str, Envelope]]

FACES: list[Stop] = [
    lambda networks: networks.stop("arm-1"),
    lambda networks: asyncio.run(networks.stop_async("arm-1")),
]


@pytest.fixture
def near() -> ScriptedNetwork:
    return ScriptedNetwork(DEVICE_CONNECT, {"arm-1": OURS})


@pytest.fixture
def far() -> ScriptedNetwork:
    return ScriptedNetwork(MESH, {})


@pytest.fixture
def networks(near: ScriptedNetwork, far: ScriptedNetwork) -> Iterator[Networks]:
    with Networks([near, far]) as joined:
        joined.settled()
        yield joined


@pytest.fixture
def remembered(far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch) -> list[RosterRow]:
    """Robots that this machine remembers on the mesh; a name that was only heard."""
    rows = [RosterRow("arm-1", Known.HEARD)]

    def of(network: NetworkKey, *_: float) -> Roster:
        return Roster(network, tuple(rows) if network == far.key else ())

    monkeypatch.setattr(Roster, "of", of)
    return rows


@pytest.mark.parametrize("stop", FACES)
def test_network_that_never_had_the_robot_has_no_answer(stop: Stop, networks: Networks) -> None:
    assert {name: said["stopped"] for name, said in stop(networks).items()} == {DEVICE_CONNECT: True}


@pytest.mark.parametrize("stop", FACES)
def test_silent_robot_that_a_network_remembers_is_unknown(
    stop: Stop, networks: Networks, remembered: list[RosterRow]
) -> None:
    assert {name: said["stopped"] for name, said in stop(networks).items()} == {DEVICE_CONNECT: True, MESH: None}


@pytest.mark.parametrize("stop", FACES)
def test_stop_that_did_not_leave_is_unknown_where_the_robot_is_remembered(
    stop: Stop, near: ScriptedNetwork, far: ScriptedNetwork, remembered: list[RosterRow]
) -> None:
    far.unreachable = "no hub"
    with Networks([near, far]) as networks:
        networks.settled()
        answers = stop(networks)
        assert {name: said["stopped"] for name, said in answers.items()} == {DEVICE_CONNECT: True, MESH: None}
        assert "did not leave on mesh: no hub" in answers[MESH]["reason"]
        remembered.clear()
        assert list(stop(networks)) == [DEVICE_CONNECT]


@pytest.mark.parametrize("stop", FACES)
def test_absent_network_that_is_only_a_name_is_asked_for_its_memory(
    stop: Stop, near: ScriptedNetwork, far: ScriptedNetwork, remembered: list[RosterRow]
) -> None:
    with Networks([near], {MESH: "no mesh answers"}, {MESH: lambda: far.key}) as networks:
        assert {name: said["stopped"] for name, said in stop(networks).items()} == {DEVICE_CONNECT: True, MESH: None}


def test_halt_of_a_remote_robot_names_the_network_that_it_did_not_leave_on(
    near: ScriptedNetwork, far: ScriptedNetwork, remembered: list[RosterRow]
) -> None:
    far.unreachable = "no hub"
    with Fleet([near, far]) as fleet:
        verdict = fleet["arm-1"].halt()
    assert verdict.stopped is None
    assert list(verdict.unknown) == ["arm-1 on mesh"]


def test_stop_from_a_loop_waits_for_a_network_that_would_tell_an_absence(
    networks: Networks, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    answered = threading.Event()

    async def frozen(robot: str, within: float = STOP_S, robot_name: str = "") -> Envelope:
        await asyncio.to_thread(answered.wait, 30)
        return error("no reply in time", stopped=None)

    monkeypatch.setattr(far, "tells_absence", True)
    monkeypatch.setattr(far, "stop_async", frozen)

    async def stop() -> dict[str, Envelope]:
        stopping = asyncio.ensure_future(networks.stop_async("arm-1"))
        done, _ = await asyncio.wait([stopping], timeout=0.2)
        assert not done
        answered.set()
        return await stopping

    assert {name: said["stopped"] for name, said in asyncio.run(stop()).items()} == {DEVICE_CONNECT: True, MESH: None}


@pytest.mark.parametrize("failure", [OSError("gone"), asyncio.CancelledError()])
def test_network_that_fails_hides_no_answer_of_the_other(
    networks: Networks, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch, failure: BaseException
) -> None:
    async def fails(robot: str, within: float = STOP_S, robot_name: str = "") -> Envelope:
        raise failure

    monkeypatch.setattr(far, "stop_async", fails)
    answers = asyncio.run(networks.stop_async("arm-1"))
    assert {name: said["stopped"] for name, said in answers.items()} == {DEVICE_CONNECT: True, MESH: None}


class TestCallsThatAreStops:
    """``call`` with the name of a stop."""

    @pytest.fixture
    def far(self) -> ScriptedNetwork:
        return ScriptedNetwork(MESH, {"arm-1": OURS})

    @pytest.mark.parametrize("verb", ["stop", "stopMotion"])
    def test_they_go_to_every_robot_of_the_id(
        self, networks: Networks, near: ScriptedNetwork, far: ScriptedNetwork, verb: str
    ) -> None:
        found = FoundRobot("arm-1")
        calls: list[Callable[[], Any]] = [
            lambda: networks.call("arm-1", verb, {}, 5.0),
            lambda: asyncio.run(networks.call_async("arm-1", verb, {}, 5.0)),
            lambda: RemoteRobot(found, near, networks).call(verb),
        ]
        for call in calls:
            near.stopped, far.stopped = [], []
            assert call()["stopped"] is True
            assert (near.stopped, far.stopped) == (["arm-1"], ["arm-1"])

    def test_stop_of_a_robot_of_a_world_stops_it_alone(
        self, networks: Networks, near: ScriptedNetwork, far: ScriptedNetwork
    ) -> None:
        networks.call("arm-1", "stop", {"robot_name": "left"}, 5.0)
        assert (near.stopped, far.stopped) == (["arm-1/left"], ["arm-1/left"])

    def test_one_that_did_not_stop_makes_it_an_error(self, networks: Networks, far: ScriptedNetwork) -> None:
        far.stops = error("no brakes", stopped=False)
        answer = networks.call("arm-1", "stop", {}, 5.0)
        assert (answer["status"], answer["not_stopped"]) == ("error", ["arm-1 on mesh"])

    def test_stop_of_a_fleet_that_has_one_network_is_a_call(self, near: ScriptedNetwork) -> None:
        near.answers["stop"] = lambda arguments: success("stopped", stopped=True)
        with Networks([near]) as networks:
            networks.call("arm-1", "stop", {}, 5.0)
        assert [call[1] for call in near.calls] == ["stop"]
