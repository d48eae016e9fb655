"""A robot's own verbs on the wire of each network: described, carried out, refused, approved.

``tests/integration/faces`` has what a user does with them at every face.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import pytest
from fixtures.barista import Barista
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect import (
    FleetClient,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.mesh import init_mesh, session
from strands_robots.safety.authorization import Grants
from strands_robots.state_files import state_dir
from strands_robots.utils import ValidationError

NUMBERS = itertools.count(1)


def own_name() -> str:
    """Return an id that no robot of an earlier test had: the process remembers the sessions of those."""
    return f"robot-{next(NUMBERS)}"


Call = Callable[..., dict[str, Any]]


@dataclass
class Reached:
    """A robot that a caller on its network has found."""

    call: Call
    describe: Callable[[], list[Mapping[str, Any]]]


@contextmanager
def over_device_connect(robot: Any, name: str) -> Iterator[Reached]:
    link = loopback_config(free_port())
    runtime = init_device_connect_sync(robot, peer_id=name, link=link)
    try:
        with FleetClient(link, "tester") as client:
            eventually(lambda: name in [peer.id for peer in client.peers()])

            yield Reached(
                lambda verb, **arguments: client.call(name, verb, arguments, 20.0),
                lambda: next(list(peer.functions) for peer in client.peers() if peer.id == name),
            )
    finally:
        stop_device_connect(runtime)


@contextmanager
def over_the_mesh(robot: Any, name: str) -> Iterator[Reached]:
    peer = init_mesh(robot, name)
    console = init_mesh(None, "console")
    assert peer is not None
    assert console is not None

    def call(verb: str, **arguments: Any) -> dict[str, Any]:
        reply = console.send(name, {"action": verb, **arguments}, timeout=20.0)
        if reply.get("type") == "response":
            answer: dict[str, Any] = reply["result"]
            return answer
        assert "error" in reply, reply
        return {"status": "error", "reason": reply["error"]}

    try:
        eventually(lambda: console.get_peer(name) and "own_verbs" in (console.get_peer(name) or {}))
        yield Reached(
            call,
            lambda: call("describe")["functions"],
        )
    finally:
        console.close()
        peer.close()


NETWORKS = {"device-connect": over_device_connect, "mesh": over_the_mesh}


@pytest.fixture(autouse=True)
def network(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("STRANDS_MESH", "true")
    monkeypatch.setenv("STRANDS_MESH_PORT", str(free_port()))
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "*")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")
    yield
    eventually(lambda: session.current_session() is None, what="the mesh's session is closed")


@pytest.fixture(params=NETWORKS)
def reach(request: pytest.FixtureRequest) -> Any:
    return NETWORKS[request.param]


def test_own_verbs_are_described_and_carried_out(reach: Any) -> None:
    robot = Barista()
    with reach(robot, own_name()) as reached:
        described = {each["name"]: each for each in reached.describe()}
        brew = described["brewCoffee"]
        assert brew["parameters"]["properties"]["cups"] == {
            "type": "integer",
            "minimum": 1,
            "maximum": 8,
            "description": "how many cups",
        }
        assert brew["parameters"]["required"] == ["cups"]
        assert brew["labels"] == {"direction": "write", "safety": "critical", "own": "true", "lasts_s": "60"}
        assert described["beansLeft"]["labels"] == {"direction": "read", "own": "true"}
        for cups in (1, 2):
            answer = reached.call("brewCoffee", cups=cups)
            assert (answer["status"], answer["cups"]) == ("success", cups)
        assert reached.call("beansLeft")["result"] == 250.0
        for bad in (
            {"cups": 9},
            {"cups": True},
            {"cups": "2"},
            {},
            {"cups": 1, "mugs": 1},
            {"cups": 1, "strength": ""},
        ):
            refused = reached.call("brewCoffee", **bad)
            assert refused["status"] == "error"
            assert next(iter(set(bad) - {"cups"} or {"cups"})) in refused["reason"]
        assert robot.cups == 3


def test_real_robot_asks_the_operator_for_its_own_verb(reach: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BYPASS_TOOL_CONSENT")
    robot, name = Barista(), own_name()
    with reach(robot, name) as reached:
        refused = reached.call("brewCoffee", cups=1)
        assert "approv" in refused["reason"]
        assert robot.cups == 0
        assert reached.call("beansLeft")["result"] == 250.0
        Grants(state_dir() / "grants").grant("brewCoffee", name)
        assert reached.call("brewCoffee", cups=1)["status"] == "success"
        assert "approv" in reached.call("brewCoffee", cups=1)["reason"]


@pytest.mark.parametrize("join", ["device-connect", "mesh"])
def test_robot_that_cannot_be_stopped_is_refused_at_registration(join: str) -> None:
    from strands_robots import Permit, verb  # noqa: PLC0415 - this test's robot alone

    class Endless:
        @verb
        def spin(self) -> None:
            """Spin."""

    class Named:
        @verb(name="halt")
        def brake(self, permit: Permit) -> None:
            """Brake."""

    Named.brake.__annotations__["permit"] = Permit
    for robot, why in ((Endless(), "no stop would end"), (Named(), "cannot be the verb halt")):
        with pytest.raises(ValidationError, match=why):
            if join == "mesh":
                init_mesh(robot, "robot-1")
            else:
                init_device_connect_sync(robot, peer_id="robot-1", link=loopback_config(free_port()))
