from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually

from strands_robots.envelope import Envelope, error, success
from strands_robots.mesh import init_mesh, safety
from strands_robots.mesh.session import clear_peers
from strands_robots.mesh.transport import zenoh_config
from strands_robots.mesh.transport.zenoh_config import Posture
from strands_robots.tools import networks, robot_mesh
from strands_robots.tools.networks import DeviceConnect, NativeMesh, combined_verdict


class FakeNetwork:
    """Writes down what it was asked."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []

    def peers(self) -> Envelope:
        return self._did("peers")

    def tell(self, *asked: Any) -> Envelope:
        return self._did("tell", *asked)

    def status(self, target: str) -> Envelope:
        return self._did("status", target)

    def stop(self, target: str) -> Envelope:
        return self._did("stop", target)

    def emergency_stop(self, reason: str) -> Envelope:
        return self._did("emergency_stop", reason)

    def _did(self, *asked: Any) -> Envelope:
        self.asked.append(asked)
        return success("done")


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeNetwork:
    there = FakeNetwork()
    monkeypatch.setattr(networks, "network", lambda: there)
    return there


def test_every_action_reaches_the_network(fake: FakeNetwork) -> None:
    robot_mesh(action="peers")
    robot_mesh(action="tell", target="arm-1", instruction="wave", duration=2)
    robot_mesh(action="status", target="arm-1")
    robot_mesh(action="stop", target="arm-1")
    robot_mesh(action="stop")
    robot_mesh(action="emergency_stop", instruction="smoke")
    assert fake.asked == [
        ("peers",),
        ("tell", "arm-1", "wave", "mock", 2.0),
        ("status", "arm-1"),
        ("stop", "arm-1"),
        ("stop", ""),
        ("emergency_stop", "smoke"),
    ]


@pytest.mark.parametrize(
    ("asked", "named"),
    [
        ({"action": "dance"}, "action"),
        ({"action": "tell", "instruction": "wave"}, "target"),
        ({"action": "tell", "target": "arm/1", "instruction": "wave"}, "target"),
        ({"action": "tell", "target": "arm-1"}, "instruction"),
        ({"action": "tell", "target": "arm-1", "instruction": "a\x00b"}, "instruction"),
        ({"action": "tell", "target": "arm-1", "instruction": "wave", "duration": float("nan")}, "duration"),
        ({"action": "tell", "target": "arm-1", "instruction": "wave", "duration": 1e9}, "duration"),
        ({"action": "tell", "target": "arm-1", "instruction": "wave", "policy_provider": ""}, "policy_provider"),
        ({"action": "status"}, "target"),
        ({"action": "stop", "target": "arm 1"}, "target"),
    ],
)
def test_an_argument_out_of_its_domain_is_refused_by_name(fake: FakeNetwork, asked: dict[str, Any], named: str) -> None:
    answer = robot_mesh(**asked)
    assert answer["status"] == "error"
    assert named in answer["reason"]
    assert fake.asked == []


def test_one_silent_robot_makes_a_stop_an_error_that_names_it() -> None:
    answer = combined_verdict({"a": success("ok", stopped=True), "b": error("no answer in 5 s", stopped=None)})
    assert answer["status"] == "error"
    assert answer["silent"] == ["b"]
    assert answer["stopped"] is None
    assert "b" in answer["reason"]


def test_one_moving_robot_outranks_a_silent_one() -> None:
    answer = combined_verdict(
        {
            "a": success("ok", stopped=True),
            "b": error("no answer", stopped=None),
            "c": error("the bus is wedged", stopped=False),
        }
    )
    assert answer["stopped"] is False
    assert answer["not_stopped"] == ["c"]
    assert "DID NOT STOP: c" in answer["reason"]


def test_a_stop_that_reaches_nobody_is_an_error() -> None:
    assert combined_verdict({})["status"] == "error"


def test_only_affirmative_answers_are_a_stop() -> None:
    assert combined_verdict({"a": success("ok"), "b": success("ok", stopped=["arm"])})["status"] == "success"
    assert combined_verdict({"a": {"result": "hm"}})["status"] == "error"


@pytest.mark.parametrize("word", ["off", "OFF", "0", "false"])
def test_with_device_connect_off_the_native_mesh_is_used(monkeypatch: pytest.MonkeyPatch, word: str) -> None:
    monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", word)
    assert isinstance(networks.network(), NativeMesh)


@pytest.fixture
def on_the_mesh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", "off")
    monkeypatch.setenv("STRANDS_MESH_BACKEND", "memory")
    monkeypatch.setattr(zenoh_config, "DISCOVERY_S", 0.1)
    monkeypatch.setattr(networks, "STOP_S", 20.0)
    monkeypatch.setattr(safety, "COLLECT_S", 20.0)
    clear_peers()
    yield
    clear_peers()


def test_on_a_mesh_without_robots_everything_is_an_error(on_the_mesh: None) -> None:
    for asked in ({"action": "peers"}, {"action": "stop"}, {"action": "emergency_stop"}):
        assert robot_mesh(**asked)["status"] == "error"


def test_a_kill_switch_says_that_the_mesh_is_off(on_the_mesh: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH", "false")
    answer = robot_mesh(action="stop")
    assert "native mesh is off" in answer["reason"]
    assert answer["stopped"] is None


def test_robots_on_the_mesh_are_found_told_and_stopped_by_name(on_the_mesh: None) -> None:
    left, stuck = World("left"), Arm("stuck", stops=False)
    meshes = [init_mesh(left, "sim-1", "sim"), init_mesh(stuck, "arm-1")]
    try:
        # They and the tool's peer share what they heard, so that whom one has seen the tool knows.
        names = {"sim-1", "arm-1"}
        eventually(lambda: {row["peer_id"] for mesh in meshes if mesh is not None for row in mesh.peers} == names)
        assert {row["id"] for row in robot_mesh(action="peers")["peers"]} == names
        assert robot_mesh(action="tell", target="sim-1", instruction="wave")["status"] == "success"
        assert left.running == {"left": "wave"}
        assert robot_mesh(action="status", target="sim-1")["task_status"] == "running"
        assert robot_mesh(action="stop", target="sim-1")["stopped"] is True
        assert "operator approval" in robot_mesh(action="tell", target="arm-1", instruction="wave")["reason"]
        verdict = robot_mesh(action="emergency_stop")
        assert verdict["status"] == "error"
        assert verdict["not_stopped"] == ["arm-1"]
        assert meshes[0] is not None and meshes[0].lockout_epoch == verdict["estop_id"]
    finally:
        for mesh in meshes:
            if mesh is not None:
                mesh.close()


def test_a_link_to_a_stated_endpoint_is_waited_for_longer_than_it_pauses() -> None:
    pause = zenoh_config.explicit(Posture.from_settings())["connect"]["retry"]["period_max_ms"] / 1000
    assert pause + zenoh_config.DISCOVERY_S < zenoh_config.LINK_DISCOVERY_S


class Visit:
    """What the tool sees of a mesh on its own clock: robots that come at a time, and when each was told to stop."""

    def __init__(self, coming: dict[str, float], silent: frozenset[str] = frozenset()) -> None:
        self.now, self.coming, self.silent = 0.0, coming, silent
        self.peer_id, self.lockout_epoch, self.alive = "tool", "e" * 32, True
        self.stops: list[float] = []

    @property
    def peers(self) -> list[dict[str, Any]]:
        return [{"peer_id": name, "reachable": True} for name, at in self.coming.items() if at <= self.now]

    def emergency_stop(self) -> list[dict[str, Any]]:
        self.stops.append(self.now)
        told = [row["peer_id"] for row in self.peers if row["peer_id"] not in self.silent]
        return [{"responder_id": name, "result": {"ok": True, "stopped": True}} for name in told]

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def close(self) -> None:
        self.alive = False


@pytest.fixture
def visit(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Visit]:
    def visiting(coming: dict[str, float], **options: Any) -> Visit:
        made = Visit(coming, **options)
        monkeypatch.setattr("strands_robots.mesh.init_mesh", lambda *_: made)
        monkeypatch.setattr(networks, "time", made)
        return made

    return visiting


def test_on_loopback_a_stop_is_sent_at_once_and_again_when_somebody_is_seen(visit: Callable[..., Visit]) -> None:
    seen = visit({"arm-1": 0.4, "arm-2": 0.5})
    assert NativeMesh().emergency_stop("")["robots"] == {"arm-1": "stopped", "arm-2": "stopped"}
    assert len(seen.stops) == 2
    assert seen.stops[0] == 0.0
    assert seen.now < 1.5


def test_a_robot_that_connects_late_to_who_listens_is_stopped_when_it_comes(
    visit: Callable[..., Visit], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENOH_LISTEN", "tcp/127.0.0.1:7447")
    seen = visit({"arm-1": 0.4, "arm-2": 5.0, "arm-3": 8.5})
    assert NativeMesh().emergency_stop("")["robots"] == dict.fromkeys(("arm-1", "arm-2", "arm-3"), "stopped")
    for came in seen.coming.values():
        assert any(0 <= at - came <= networks.AGAIN_S + networks.LOOK_S for at in seen.stops), seen.stops
    assert len(seen.stops) == 4


def test_who_connects_and_finds_nobody_waits_for_the_listener(
    visit: Callable[..., Visit], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENOH_CONNECT", "tcp/127.0.0.1:7447")
    seen = visit({"arm-1": 7.0})
    assert NativeMesh().emergency_stop("")["stopped"] is True
    assert seen.now < 7.0 + 2 * zenoh_config.DISCOVERY_S


def test_a_robot_that_was_seen_and_left_without_an_answer_is_named(
    visit: Callable[..., Visit], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZENOH_LISTEN", "tcp/127.0.0.1:7447")
    seen = visit({"arm-1": 0.4, "arm-2": 0.4}, silent=frozenset({"arm-2"}))

    def sleep(seconds: float) -> None:
        seen.now += seconds
        if seen.now > 4.0:
            seen.coming.pop("arm-2", None)

    monkeypatch.setattr(seen, "sleep", sleep)
    verdict = NativeMesh().emergency_stop("")
    assert (verdict["stopped"], verdict["silent"]) == (None, ["arm-2"])


@pytest.mark.parametrize("word", ["auto", "on", "", "maybe"])
def test_device_connect_is_the_usual_network(monkeypatch: pytest.MonkeyPatch, word: str) -> None:
    monkeypatch.setenv("STRANDS_ROBOT_MESH_DC", word)
    assert isinstance(networks.network(), DeviceConnect)


def test_a_network_that_leaves_this_machine_needs_an_opt_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NATS_URL", "nats://192.0.2.1:4222")
    answer = robot_mesh(action="stop", target="arm-1")
    assert answer["status"] == "error"
    assert "allow_insecure" in answer["reason"]
    assert answer["stopped"] is None


def test_the_package_of_tools_loads_no_agent_framework() -> None:
    code = "import sys, strands_robots.tools; assert not {'strands', 'zenoh', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_strands_agents_one_sentence_names_the_extra() -> None:
    code = (
        "import sys; sys.modules['strands'] = None\n"
        "try:\n    from strands_robots.tools import robot_mesh\n"
        "except ImportError as exc:\n    print(exc)"
    )
    told = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert "'.[agent]'" in told
    assert len(told.splitlines()) == 1
