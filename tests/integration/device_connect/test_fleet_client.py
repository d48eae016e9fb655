"""FleetClient: discovery, calls, events and stops on a real network."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from device_connect_edge.drivers import DeviceDriver, rpc
from fixtures.nats_server import NatsServer
from fixtures.toy_robots import ToyRobot, ToyWorld
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect import (
    FleetClient,
    LinkConfig,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.device_connect.client import CallRefusedError, DeviceEvent, DeviceTimeoutError, NoSuchDeviceError
from strands_robots.utils import ValidationError


@pytest.fixture
def link() -> LinkConfig:
    return loopback_config(free_port())


@pytest.fixture
def fleet(link: LinkConfig) -> Iterator[FleetClient]:
    with FleetClient(link, "tester") as client:
        yield client


@pytest.fixture
def worlds(link: LinkConfig) -> Iterator[dict[str, ToyWorld]]:
    made = {name: ToyWorld(name) for name in ("arm-1", "arm-2", "arm-3")}
    runtimes = [init_device_connect_sync(world, peer_id=name, link=link) for name, world in made.items()]
    yield made
    for runtime in runtimes:
        stop_device_connect(runtime)
    for world in made.values():
        world.close()


class Stubborn(DeviceDriver):  # type: ignore[misc]
    """A device that refuses to stop, and one function that never answers."""

    device_type = "stubborn"

    @rpc()
    async def stop(self) -> dict[str, Any]:
        """Stop."""
        return {"status": "error", "stopped": False, "reason": "no brakes"}

    @rpc()
    async def think(self) -> dict[str, Any]:
        """Think."""
        await __import__("asyncio").sleep(60)
        return {}


class Head(DeviceDriver):  # type: ignore[misc]
    """A device whose stop is called stopMotion."""

    device_type = "head"
    stopped = 0

    @rpc()
    async def stopMotion(self) -> dict[str, Any]:
        """Stop."""
        self.stopped += 1
        return {"status": "success"}


def test_first_discovery_is_complete(link: LinkConfig, worlds: dict[str, ToyWorld]) -> None:
    for _ in range(3):
        with FleetClient(link) as fresh:
            assert [peer.id for peer in fresh.peers(20)] == ["arm-1", "arm-2", "arm-3"]


def test_peer_describes_its_type_and_its_functions(fleet: FleetClient, worlds: dict[str, ToyWorld]) -> None:
    peer = fleet.peers(20)[0]
    assert (peer.id, peer.type, peer.model) == ("arm-1", "strands_sim", "arm-1")
    assert peer.status["availability"] == "idle"
    assert "execute" in {function["name"] for function in peer.functions}
    assert "policyComplete" in peer.events


def test_call_names_its_caller(fleet: FleetClient, worlds: dict[str, ToyWorld], monkeypatch: Any) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "tester")
    assert fleet.call("arm-1", "execute", {"instruction": "wave"})["robot_name"] == "left"
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "another-agent")
    assert "tester" in fleet.call("arm-1", "execute", {"instruction": "wave"})["reason"]


def test_absent_device_and_silent_device_raise_different_errors(fleet: FleetClient, link: LinkConfig) -> None:
    began = time.monotonic()
    with pytest.raises(NoSuchDeviceError, match="arm-9"):
        fleet.call("arm-9", "getStatus", timeout=60)
    assert time.monotonic() - began < 30
    runtime = init_device_connect_sync(Stubborn(), peer_id="thinker", link=link)
    with pytest.raises(DeviceTimeoutError, match="thinker"):
        fleet.call("thinker", "think", timeout=0.3)
    stop_device_connect(runtime)


def test_unknown_function_is_a_refusal_with_its_code(fleet: FleetClient, worlds: dict[str, ToyWorld]) -> None:
    with pytest.raises(CallRefusedError) as refused:
        fleet.call("arm-1", "fly")
    assert refused.value.code == -32601


@pytest.mark.parametrize("device", ["", "a.b", "*", "a/b", "x" * 200])
def test_id_out_of_domain_is_refused_before_it_is_sent(fleet: FleetClient, device: str) -> None:
    with pytest.raises(ValidationError, match="device"):
        fleet.call(device, "getStatus")


@pytest.mark.parametrize(
    ("params", "named"),
    [
        ({"duration": float("nan")}, "duration must be finite, not nan"),
        ({"x": float("-inf")}, "x must be finite, not -inf"),
        ({"joints": {"pan": 0.5, "lift": float("nan")}}, "joints.lift must be finite"),
        ({"path": [[0.0, 1.0], (0.0, float("inf"))]}, r"path\[1\]\[1\] must be finite"),
        ({"joints": {"pan": object()}}, "params must be values that JSON can carry"),
    ],
)
def test_argument_that_json_cannot_carry_is_refused_by_its_name(
    fleet: FleetClient, params: dict[str, Any], named: str
) -> None:
    with pytest.raises(ValidationError, match=named):
        fleet.call("arm-1", "execute", params)
    (answer, _) = fleet.call_each({"arm-1": params}, "execute")["arm-1"]
    assert isinstance(answer, ValidationError)


def test_subscription_delivers_events_in_order_until_it_closes(fleet: FleetClient, worlds: dict[str, ToyWorld]) -> None:
    received: list[DeviceEvent] = []
    with fleet.subscription("arm-2", received.append):
        fleet.call("arm-2", "execute", {"instruction": "wave", "duration": 0.3})
        eventually(lambda: any(event.name == "policyComplete" for event in received))
    assert {event.device for event in received} == {"arm-2"}
    steps = [event.payload["step"] for event in received if event.name == "streamStep"]
    assert steps == sorted(steps)
    count = len(received)
    time.sleep(0.3)
    assert len(received) == count


def test_events_iterates_over_all_devices(fleet: FleetClient, worlds: dict[str, ToyWorld]) -> None:
    seen: set[str] = set()
    ready = threading.Event()
    for event in fleet.events("*", timeout=20, ready=ready):
        assert ready.is_set()
        # The first event is a heartbeat; the tasks that it starts are told without waiting for the next one.
        if not seen:
            for name in worlds:
                fleet.call(name, "execute", {"instruction": "wave", "duration": 0.3})
        seen.add(event.device)
        if len(seen) == 3:
            break
    assert seen == set(worlds)


def test_stop_is_true_only_for_an_affirmative_answer(
    fleet: FleetClient, link: LinkConfig, worlds: dict[str, ToyWorld]
) -> None:
    fleet.call("arm-1", "execute", {"instruction": "wave"})
    assert fleet.stop("arm-1")["stopped"] == ["left"]
    head = Head()
    runtimes = [
        init_device_connect_sync(Stubborn(), peer_id="stubborn", link=link),
        init_device_connect_sync(head, peer_id="head", link=link),
    ]
    assert fleet.stop("stubborn")["status"] == "error"
    assert fleet.stop("head")["status"] == "success"
    assert fleet.stop("absent")["status"] == "error"
    fleet.call("arm-2", "execute", {"instruction": "wave"})
    answers = fleet.stop_all()
    assert set(answers) == {"arm-1", "arm-2", "arm-3", "stubborn", "head"}
    assert {name for name, answer in answers.items() if answer["status"] != "success"} == {"stubborn"}
    assert not worlds["arm-2"].rollouts["left"].running
    assert head.stopped == 2
    for runtime in runtimes:
        stop_device_connect(runtime)


def test_unreachable_network_raises_within_its_deadline() -> None:
    absent = LinkConfig(transport="nats", connect=(f"nats://127.0.0.1:{free_port()}",), connect_timeout_s=0.5)
    began = time.monotonic()
    with pytest.raises(Exception, match=r"127\.0\.0\.1"), FleetClient(absent):
        pass
    assert time.monotonic() - began < 30
    eventually(lambda: not any(t.name == "fleet-client" for t in threading.enumerate()))


def test_fleet_client_works_over_nats() -> None:
    with NatsServer() as server:
        link = LinkConfig(transport="nats", connect=(server.url,))
        world = ToyWorld()
        runtime = init_device_connect_sync(world, peer_id="arm-1", link=link)
        with FleetClient(link) as fleet:
            assert [peer.id for peer in fleet.peers(20)] == ["arm-1"]
            assert fleet.call("arm-1", "execute", {"instruction": "wave"})["status"] == "success"
            assert fleet.stop("arm-1")["stopped"] == ["left"]
            with pytest.raises(NoSuchDeviceError):
                fleet.call("arm-2", "stop")
            server.kill()
            server.start()
            eventually(lambda: answers(fleet))
        stop_device_connect(runtime)
        world.close()


def answers(fleet: FleetClient) -> bool:
    try:
        return fleet.call("arm-1", "getStatus", timeout=5)["status"] == "success"
    except Exception:  # noqa: BLE001 - any failure means not yet
        return False


def test_many_devices_are_asked_without_a_thread_for_each() -> None:
    link = loopback_config(free_port())
    robots = [ToyRobot(f"arm-{number}") for number in range(3)]
    runtimes = [init_device_connect_sync(each, peer_id=each.tool_name_str, link=link) for each in robots]
    try:
        with FleetClient(link, "tester") as fleet:
            eventually(lambda: len(fleet.peers()) == 3)
            names = [*(each.tool_name_str for each in robots), *(f"absent-{number}" for number in range(200))]
            most, over = [threading.active_count()], threading.Event()

            def count() -> None:
                while not over.wait(0.005):
                    most.append(threading.active_count())

            counting = threading.Thread(target=count)
            counting.start()
            answers = fleet.call_each({name: {} for name in names}, "getStatus", 5.0)
            over.set()
            counting.join()
            assert list(answers) == names
            assert all(isinstance(answers[f"arm-{each}"][0], dict) for each in range(3))
            assert all(isinstance(answers[f"absent-{each}"][0], NoSuchDeviceError) for each in range(200))
            # The counter, and a worker for each robot that is read.
            assert max(most) <= most[0] + 1 + 2 * len(robots)
    finally:
        for runtime in runtimes:
            stop_device_connect(runtime)
        for robot in robots:
            robot.close()
