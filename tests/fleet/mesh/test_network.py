"""Calls, lists and stops of mesh peers by the calling side."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import pytest

from strands_robots.envelope import error
from strands_robots.errors import ArgumentsError, LockoutError, NoSuchRobotError, UnknownVerbError
from strands_robots.fleet.mesh import network, peers
from strands_robots.fleet.mesh.network import MeshNetwork
from strands_robots.mesh import session
from strands_robots.mesh.transport import config
from strands_robots.serving.advertised import RobotDescription

Reply = Callable[[dict[str, Any]], dict[str, Any]]


class FakeMesh:
    """A mesh whose peers are rows of presence, and which notes what is sent."""

    peer_id = "tool"

    def __init__(self, rows: list[dict[str, Any]], reply: Reply) -> None:
        self.rows, self.reply = rows, reply
        self.sent: list[tuple[str, dict[str, Any], float]] = []

    @property
    def peers(self) -> list[dict[str, Any]]:
        return [dict(row) for row in self.rows]

    @property
    def peers_by_id(self) -> dict[str, dict[str, Any]]:
        return {row["peer_id"]: row for row in self.peers}

    def get_peer(self, peer: str) -> dict[str, Any] | None:
        return self.peers_by_id.get(peer)

    def send(self, peer: str, command: dict[str, Any], seconds: float) -> dict[str, Any]:
        self.sent.append((peer, command, seconds))
        return self.reply(command)


def row(name: str, kind: str = "robot", **more: Any) -> dict[str, Any]:
    return {"peer_id": name, "type": "robot", "reachable": True, "age": 0.1, "robot_kind": kind, **more}


def timeout(command: Mapping[str, Any]) -> dict[str, Any]:
    return {"status": "timeout"}


def done(command: Mapping[str, Any]) -> dict[str, Any]:
    return {"type": "response", "result": {"status": "success", "stopped": True}}


def joined(mesh: FakeMesh) -> MeshNetwork:
    return MeshNetwork.joined(mesh)  # type: ignore[arg-type]


@pytest.fixture(autouse=True)
def quick_discovery(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config, "DISCOVERY_S", 0.05)


def test_silent_peers_hold_up_a_list_for_a_bounded_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "LIST_S", 0.1)
    names = [f"bar-{n}" for n in range(100)]

    def send(peer: str, command: dict[str, Any], seconds: float) -> dict[str, Any]:
        given.append(seconds)
        threading.Event().wait(seconds)
        return {"status": "timeout"}

    mesh, given = FakeMesh([row(name, "mobile_base") for name in names], timeout), list[float]()
    monkeypatch.setattr(mesh, "send", send)
    described = joined(mesh).describe_each(names)
    assert all("drive" in RobotDescription.of(described[name]).verbs for name in names)
    assert len(given) < len(names) and max(given) <= 0.1


def test_silent_peers_do_not_delay_the_question_for_the_lockouts_of_another_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names, asked = [f"bar-{n}" for n in range(60)], threading.Event()

    def send(peer: str, command: dict[str, Any], seconds: float) -> dict[str, Any]:
        if peer == "lively":
            asked.set()
            return {"type": "response", "result": {"lockout": []}}
        waited.append(asked.wait(10.0))
        return {"status": "timeout"}

    waited = list[bool]()
    mesh = FakeMesh([row(name) for name in (*names, "lively")], timeout)
    monkeypatch.setattr(mesh, "send", send)
    reports = joined(mesh).lockouts([*names, "lively"], 1.0)
    assert [each.name for each in reports if not each.problem] == ["lively"]
    assert waited == [True] * len(names)


def test_presence_of_a_peer_is_its_beat() -> None:
    there = joined(FakeMesh([row("arm-1", age=2.0), row("arm-2", reachable=False)], timeout))
    before = time.monotonic()
    beats = there.beats(["arm-1", "arm-2", "arm-3"])
    at = beats["arm-1"]
    assert at is not None and before <= at + 2.0 <= time.monotonic()
    assert (beats["arm-2"], beats["arm-3"]) == (None, None)


def test_verbs_of_an_older_peer_are_those_of_its_kind() -> None:
    older = {"type": "error", "error": "validation: action must be one of status, stop."}
    mesh = FakeMesh([row("bar-1", own_verbs=["brewCoffee", 5])], lambda _: older)
    verbs = [*RobotDescription.of(joined(mesh).describe_each(["bar-1"])["bar-1"]).verbs]
    assert "moveTo" in verbs and verbs[-1] == "brewCoffee"


def test_locked_peer_is_refused_with_its_epoch_and_the_remedy() -> None:
    facts = error("step is refused: arm-1 is locked. To resume: ...", locked=True, refused="lockout", epochs=["a" * 32])
    mesh = FakeMesh([row("arm-1")], lambda _: {"type": "error", "error": "command rejected", "refusal": facts})
    with pytest.raises(LockoutError, match="To resume: ") as refused:
        joined(mesh).call("arm-1", "step", {}, 1.0)
    assert refused.value.envelope["epochs"] == ["a" * 32]


@pytest.mark.parametrize("refusal", [None, 5, {}, {"status": "success"}])
def test_locked_peer_of_an_earlier_release_is_refused_in_its_words(refusal: object) -> None:
    mesh = FakeMesh([row("arm-1")], lambda _: {"type": "error", "error": "command rejected", "refusal": refusal})
    with pytest.raises(LockoutError, match="it is locked by an emergency stop"):
        joined(mesh).call("arm-1", "step", {}, 1.0)


@pytest.mark.parametrize(
    ("verb", "said"),
    [("brew_coffee", "'brew_coffee'. Near it: brewCoffee"), ("execute", "'execute'. There are: brewCoffee, stop.")],
)
def test_verb_that_a_peer_lacks_is_refused_with_those_that_it_has(verb: str, said: str) -> None:
    def reply(command: dict[str, Any]) -> dict[str, Any]:
        if command["action"] == "describe":
            functions = [{"name": name} for name in ("stop", "brewCoffee")]
            return {"type": "response", "result": {"status": "success", "functions": functions}}
        return {"status": "error", "error": "validation: action must be one of status, stop."}

    with pytest.raises(UnknownVerbError, match=f"bar-1 has no verb {said}"):
        joined(FakeMesh([row("bar-1")], reply)).call("bar-1", verb, {}, 1.0)


def test_peer_announces_the_verbs_of_its_kind_and_is_not_asked_for_them() -> None:
    mesh = FakeMesh([row("bar-1", "mobile_base", own_verbs=["brewCoffee"])], timeout)
    verbs = [*RobotDescription.of(joined(mesh).announced_functions("bar-1")).verbs]
    assert "drive" in verbs and verbs[-1] == "brewCoffee"
    assert mesh.sent == []


def test_peer_without_a_robot_is_listed_and_not_found() -> None:
    console = {"peer_id": "console", "type": "tool", "reachable": True, "age": 0.1}
    there = joined(FakeMesh([row("arm-1"), console], timeout))
    assert [each.id for each in there.find(None, peers=True)] == ["arm-1", "console"]
    assert [each.id for each in there.find()] == ["arm-1"]
    assert there.describe_each(["console"]) == {}


@pytest.mark.parametrize("action", ["stop", "releaseTorque"])
def test_action_that_takes_energy_away_is_sent_to_a_peer_that_was_not_seen(action: str) -> None:
    mesh = FakeMesh([row("arm-1")], done)
    there = joined(mesh)
    assert there.verb("arm-2", action) is None
    assert there.call("arm-2", action, {}, 60.0)["status"] == "success"
    assert mesh.sent == [("arm-2", {"action": action}, network.STOP_S)]


def test_motion_is_not_sent_to_a_peer_that_was_not_seen() -> None:
    mesh = FakeMesh([row("arm-1")], done)
    with pytest.raises(NoSuchRobotError, match="Near it: arm-1"):
        joined(mesh).call("arm-2", "moveTo", {}, 60.0)
    assert mesh.sent == []


def test_stop_of_a_seen_peer_is_sent_at_once_and_asks_for_nothing_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(config, "DISCOVERY_S", 60.0)
    monkeypatch.delattr(time, "sleep")
    mesh = FakeMesh([row("arm-1")], done)
    there = joined(mesh)
    assert there.verb("arm-1", "stop") is None
    there.call("arm-1", "stop", {}, 1.0)
    there.stop("arm-1", 1.0, insist=True)
    assert [command for _, command, _ in mesh.sent] == [{"action": "stop"}, {"action": "stop"}]


@pytest.mark.parametrize("arguments", [{"x": math.nan}, {"action": "start"}, {"x": object()}])
def test_no_argument_refuses_a_stop(arguments: dict[str, Any]) -> None:
    mesh = FakeMesh([row("arm-1")], done)
    there = joined(mesh)
    assert there.call("arm-1", "stop", arguments, 1.0)["status"] == "success"
    assert [command for _, command, _ in mesh.sent] == [{"action": "stop"}]
    with pytest.raises(ArgumentsError) as refused:
        there.call("arm-1", "moveTo", arguments, 1.0)
    assert not refused.value.envelope


@pytest.mark.parametrize("arguments", [{"x": math.nan}, {"action": "start"}, {"x": object()}])
def test_call_from_an_event_loop_is_refused_for_such_an_argument_and_a_stop_is_not(arguments: dict[str, Any]) -> None:
    mesh = FakeMesh([row("arm-1")], done)
    there = joined(mesh)
    with pytest.raises(ArgumentsError):
        asyncio.run(there.call_async("arm-1", "moveTo", arguments, 1.0))
    assert mesh.sent == []
    asyncio.run(there.call_async("arm-1", "stop", arguments, 1.0))
    assert [command for _, command, _ in mesh.sent] == [{"action": "stop"}]


def test_stop_of_a_robot_that_was_not_found_is_sent_and_only_waited_for_where_it_can_be_nowhere_else() -> None:
    mesh = FakeMesh([], timeout)
    there = joined(mesh)
    assert there.stop("arm-1", 1.0) is None
    assert [command for _, command, _ in mesh.sent] == [{"action": "stop"}]
    answer = there.stop("arm-1", 1.0, insist=True)
    assert answer is not None and answer["stopped"] is None
    assert mesh.sent[-1][2] == 1.0


def test_stop_leaves_before_the_robot_is_known() -> None:
    mesh = FakeMesh([], done)
    answer = joined(mesh).stop("arm-1", 1.0)
    assert answer is not None and answer["stopped"] is True
    assert [command for _, command, _ in mesh.sent] == [{"action": "stop"}]


def test_programs_without_a_robot_are_none_of_a_stop_unless_they_say_that_something_moves() -> None:
    def broadcast(command: dict[str, Any], seconds: float) -> list[dict[str, Any]]:
        stopped = {"desk": True, "robot-mesh-tool": True, "odd-tool": False, "arm-1": True}
        return [
            {
                "responder_id": name,
                "type": "response",
                "result": {"status": "success" if still else "error", "stopped": still},
            }
            for name, still in stopped.items()
        ]

    caller = {"reachable": True, "age": 0.1}
    types = {"desk": "controller", "robot-mesh-tool": "tool", "odd-tool": "tool"}
    mesh = FakeMesh([row("arm-1"), *({"peer_id": name, "type": kind, **caller} for name, kind in types.items())], done)
    mesh.broadcast = broadcast  # type: ignore[attr-defined]
    answers, outcome = joined(mesh).stop_all()
    assert {name: said["stopped"] for name, said in answers.items()} == {"arm-1": True, "odd-tool": False}
    assert not {"desk", "robot-mesh-tool"} & {row.name for row in outcome.roster.rows}


def test_call_is_not_sent_on_a_mesh_that_has_lost_its_hub_and_a_stop_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "cut_off", lambda: True)
    monkeypatch.setattr(network, "HUB_S", 0.1)
    mesh = FakeMesh([row("arm-1")], done)
    there = joined(mesh)
    with pytest.raises(NoSuchRobotError):
        there.call("arm-1", "go_home", {}, 5.0)
    with pytest.raises(NoSuchRobotError):
        there.describe("arm-1")
    assert mesh.sent == []
    there.call("arm-1", "stop", {}, 5.0)
    assert [command["action"] for _, command, _ in mesh.sent] == ["stop"]
