"""Networks as one, from an event loop: where calls go, and stops that wait for a network alone."""

from __future__ import annotations

import asyncio
import threading

import pytest
from tests.fleet.scripted import ScriptedNetwork

from strands_robots.envelope import error, is_error, text_of
from strands_robots.errors import NoSuchRobotError
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.networks import Networks


class SlowNetwork(ScriptedNetwork):
    """A network that is joined once ``reached`` is set."""

    def __init__(self, *robots: str) -> None:
        super().__init__(MESH, dict.fromkeys(robots, ()))
        self.reached = threading.Event()

    def open(self) -> None:
        assert self.reached.wait(30)
        super().open()


@pytest.fixture
def near() -> ScriptedNetwork:
    return ScriptedNetwork(DEVICE_CONNECT, {"arm-1": (), "both": ()})


@pytest.fixture
def far() -> ScriptedNetwork:
    return ScriptedNetwork(MESH, {"arm-2": (), "both": ()})


def test_read_goes_to_the_first_network_that_has_the_robot_and_asks_none(
    near: ScriptedNetwork, far: ScriptedNetwork
) -> None:
    with Networks([near, far]) as networks:
        networks.settled()

        async def read(robot: str) -> str:
            return (await networks.of_async(robot)).name

        assert [asyncio.run(read(each)) for each in ("arm-1", "arm-2", "both")] == [near.name, far.name, near.name]
        assert near.asked == far.asked == []
        with pytest.raises(NoSuchRobotError):
            asyncio.run(read("arm-3"))


def test_motion_of_an_id_on_two_networks_is_refused_where_no_key_decides(
    near: ScriptedNetwork, far: ScriptedNetwork
) -> None:
    with Networks([near, far]) as networks:
        refused = asyncio.run(networks.call_async("both", "moveTo", {}, 1.0))
    assert is_error(refused)
    assert "device_connect and mesh both have" in text_of(refused)
    assert "moveTo" not in {verb for _, verb, *_ in near.calls + far.calls}


def test_robot_describes_itself_on_its_network(near: ScriptedNetwork, far: ScriptedNetwork) -> None:
    far.robots["arm-2"] = ({"name": "moveTo"},)
    with Networks([near, far]) as networks:
        found = asyncio.run(networks.describe_async("arm-2", 1.0))
    assert (found.id, found.functions) == ("arm-2", ({"name": "moveTo"},))


def test_stop_leaves_on_a_network_as_soon_as_that_is_joined(near: ScriptedNetwork) -> None:
    far = SlowNetwork("arm-2")
    near.stops = error("no such robot", stopped=None)
    with Networks([near, far]) as networks:

        async def stop() -> object:
            stopping = asyncio.ensure_future(networks.stop_async("arm-2"))
            await asyncio.sleep(0)
            assert far.stopped == []
            far.reached.set()
            return await stopping

        assert asyncio.run(stop()) == {MESH: far.stops}
    assert far.stopped == ["arm-2"]


def test_stop_of_a_robot_waits_for_no_network_that_does_not_know_it(near: ScriptedNetwork) -> None:
    far = SlowNetwork("arm-2")
    with Networks([near, far]) as networks:
        stopped = asyncio.run(_both(networks, far))
    assert stopped == {DEVICE_CONNECT: near.stops}


async def _both(networks: Networks, far: SlowNetwork) -> object:
    answer = await asyncio.wait_for(networks.stop_async("arm-1"), 10.0)
    far.reached.set()
    return answer
