"""One network answers and the other one hangs: what is in reach is found, called and stopped at once."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually, free_port

from strands_robots import connect
from strands_robots.errors import NoSuchRobotError
from strands_robots.fleet import Fleet
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.mesh import init_mesh
from strands_robots.mesh.session import clear_peers

TASK = {"instruction": "wave", "duration": 300.0, "policy_provider": "mock"}


@pytest.fixture
def silent_broker() -> Iterator[int]:
    """The port of a broker that takes connections and never says a word."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch, patient_halts: None) -> Iterator[ToyRobot]:
    """A moving robot on the mesh."""
    monkeypatch.setenv("STRANDS_MESH_PORT", str(free_port()))
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    toy = ToyRobot("arm-2")
    mesh = init_mesh(toy, "arm-2", "sim")
    assert mesh is not None
    toy.start_task(**TASK)
    eventually(lambda: toy.writes, what="a first write")
    yield toy
    mesh.close()
    toy.close()
    clear_peers()


@pytest.fixture
def opening(silent_broker: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Set once the broker has been given up, which a test may look at."""
    from strands_robots.fleet.device_connect.network import DeviceConnectNetwork  # noqa: PLC0415 - this test alone

    over, real = threading.Event(), DeviceConnectNetwork.open

    def opened(network: Any) -> None:
        try:
            real(network)
        finally:
            over.set()

    monkeypatch.setattr(DeviceConnectNetwork, "open", opened)
    yield over
    assert over.wait(60)


def halted(toy: ToyRobot) -> bool:
    return toy.get_task_status()["task_status"] != "running"


@pytest.mark.parametrize("stop", [Fleet.stop, Fleet.estop])
def test_stop_leaves_on_the_mesh_while_the_broker_hangs(
    stop: Any, arm: ToyRobot, silent_broker: int, opening: threading.Event
) -> None:
    verdicts: list[Any] = []
    with connect(nats=f"nats://127.0.0.1:{silent_broker}") as fleet:
        stopping = threading.Thread(target=lambda: verdicts.append(stop(fleet)))
        stopping.start()
        eventually(lambda: halted(arm), what="the halt")
        assert not opening.is_set()
        stopping.join(60)
        assert verdicts[0]["arm-2"].stopped is True
        # An emergency stop waits for no joining.
        eventually(lambda: list(fleet.absent) == [DEVICE_CONNECT], 60, "the broker that is given up")


def test_one_robot_is_stopped_on_the_mesh_while_the_broker_hangs(
    arm: ToyRobot, silent_broker: int, opening: threading.Event
) -> None:
    with connect(nats=f"nats://127.0.0.1:{silent_broker}") as fleet:
        answers: dict[str, Any] = {}
        stopping = threading.Thread(target=lambda: answers.update(fleet._networks.stop("arm-2")))
        stopping.start()
        eventually(lambda: halted(arm), what="the halt")
        assert not opening.is_set()
        stopping.join(60)
        assert answers[MESH]["stopped"] is True


def test_robots_of_the_network_that_answers_are_found_and_called(
    arm: ToyRobot, silent_broker: int, opening: threading.Event
) -> None:
    with connect(nats=f"nats://127.0.0.1:{silent_broker}") as fleet:
        assert fleet["arm-2"].status()["task_status"] == "running"
        assert fleet["arm-2"].halt().stopped is True
        assert list(fleet.absent) == [DEVICE_CONNECT]


def test_a_stated_endpoint_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    monkeypatch.setenv("STRANDS_MESH_CONNECT", endpoint)
    with (
        connect(port=free_port()) as fleet,
        pytest.raises(NoSuchRobotError, match=f"mesh does not answer at {endpoint}"),
    ):
        fleet["arm-1"].status()
