"""A robot's own verbs as methods of a RemoteRobot, on Device Connect and on the mesh.

``tests/integration/faces`` has stops, leases and lockouts of such verbs.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import pytest
from fixtures.barista import Barista, Careless, Stubborn
from fixtures.waiting import eventually, free_port

from strands_robots import connect, errors
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.fleet import RemoteRobot
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.mesh import init_mesh
from strands_robots.mesh.session import clear_peers


@pytest.fixture(autouse=True)
def port(monkeypatch: pytest.MonkeyPatch, patient_halts: None) -> Iterator[int]:
    number = free_port()
    for name in ("STRANDS_DC_PORT", "STRANDS_MESH_PORT"):
        monkeypatch.setenv(name, str(number))
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "*")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    yield number
    clear_peers()


@pytest.fixture(params=[DEVICE_CONNECT, MESH])
def network(request: pytest.FixtureRequest) -> str:
    chosen: str = request.param
    return chosen


class Served:
    """Robots of this process and a fleet that reaches them."""

    def __init__(self, network: str, port: int, stack: ExitStack) -> None:
        self._network, self._port, self._stack = network, port, stack
        self._fleet: Any = None

    def robot(self, body: Any, name: str) -> RemoteRobot:
        if self._network == DEVICE_CONNECT:
            runtime = init_device_connect_sync(body, peer_id=name, link=loopback_config(self._port))
            self._stack.callback(stop_device_connect, runtime)
        else:
            peer = init_mesh(body, name)
            assert peer is not None
            self._stack.callback(peer.close)
        if self._fleet is None:
            self._fleet = self._stack.enter_context(connect())
        # A robot that joins a mesh later is known from its first presence on.
        eventually(lambda: name in self._fleet, what=name)
        found: RemoteRobot = self._fleet[name]
        return found


@pytest.fixture
def served(network: str, port: int) -> Iterator[Served]:
    with ExitStack() as stack:
        yield Served(network, port, stack)


def test_own_verb_is_a_method_with_signature_units_and_docstring(served: Served) -> None:
    body = Barista()
    barista = served.robot(body, "barista-1")
    assert {"brew_coffee", "beans_left"} <= set(dir(barista))
    signature = inspect.signature(barista.brew_coffee)
    assert list(signature.parameters) == ["cups", "strength"]
    assert signature.parameters["strength"].default == "mild"
    said = barista.brew_coffee.__doc__ or ""
    assert "Brew coffee." in said
    assert "it is not proven" in said
    assert "how many cups; 1 to 8" in said
    assert "(as the robot describes it)" in said
    assert barista.verbs["brewCoffee"].own
    assert (barista.verbs["brewCoffee"].kind, barista.verbs["beansLeft"].kind) == ("motion", "read")
    assert barista.brew_coffee(2)["cups"] == 2
    assert barista.brew_coffee(cups=1, strength="strong")["strength"] == "strong"
    assert barista.call("brewCoffee", cups=1)["task_status"] == "completed"
    assert barista.beans_left()["result"] == 250.0
    assert body.cups == 4


def test_refusals_say_who_what_and_why(served: Served) -> None:
    barista = served.robot(Barista(), "barista-2")
    with pytest.raises(errors.ArgumentsError, match=r"barista-2: .*cups must be an integer from 1 to 8, not 9"):
        barista.brew_coffee(9)
    with pytest.raises(errors.ArgumentsError, match="cups"):
        barista.brew_coffee(cups=True)
    with pytest.raises(errors.UnknownVerbError, match="brewCoffee"):
        barista.call("brewCofee", cups=1)
    careless = served.robot(Careless(), "careless-2")
    for _ in range(2):
        with pytest.raises(errors.RobotError) as failed:
            careless.spill()
        assert (failed.value.robot, failed.value.verb) == ("careless-2", "spill")
        assert careless.weigh()["samples"] == [[1.0, 2.0]]


def test_call_under_way_ends_when_the_fleet_is_closed(served: Served) -> None:
    body = Stubborn()
    served.robot(body, "mill-6")
    with connect(name="other") as fleet, ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(fleet["mill-6"].grind)
        try:
            eventually(body.started.is_set)
            fleet.close()
            with pytest.raises(errors.NoAnswerError, match="the fleet was closed"):
                waiting.result(10.0)
        finally:
            body.released.set()
