"""Calls, stops and questions to peers from an event loop."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import fleet

from strands_robots.errors import ApprovalError, NoAnswerError, NoSuchRobotError, UnknownVerbError
from strands_robots.fleet.adapter import CLOSED
from strands_robots.fleet.mesh.network import IN_FLIGHT, MeshNetwork
from strands_robots.mesh import Mesh
from strands_robots.safety.authorization import Grants, digest
from strands_robots.state_files import state_dir


@pytest.fixture
def console(tmp_path: Path) -> Iterator[tuple[Mesh, MeshNetwork, Arm]]:
    with fleet(tmp_path) as peers:
        arm = Arm("arm-1")
        peers.join(arm, "arm-1")
        mesh = peers.join(None, "console")
        there = MeshNetwork.joined(mesh)
        yield mesh, there, arm
        there.close()


class Busy:
    """A mesh on which every call hangs until it is released; stops and questions pass."""

    def __init__(self, mesh: Mesh, monkeypatch: pytest.MonkeyPatch, hung: str) -> None:
        self.released, self.waiting = threading.Event(), 0
        self._send, self._hung = mesh.send, hung
        monkeypatch.setattr(mesh, "send", self._sent)

    def _sent(self, target: str, cmd: dict[str, Any], timeout: float = 30.0) -> dict[str, Any]:
        if cmd["action"] == self._hung:
            self.waiting += 1
            self.released.wait(60)
            return {"status": "timeout"}
        return self._send(target, cmd, timeout)


def test_stop_and_question_wait_for_no_call(console: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, there, arm = console
    busy = Busy(mesh, monkeypatch, "ping")
    arm.start_task("wave")

    async def both() -> None:
        calls = [asyncio.create_task(there.call_async("arm-1", "ping", {}, 60.0)) for _ in range(2 * IN_FLIGHT)]
        await asyncio.to_thread(eventually, lambda: busy.waiting >= IN_FLIGHT, 30.0, what="every thread of calls waits")
        stopped = await there.stop_async("arm-1", 10.0)
        report = await there.lockout_async("arm-1", 10.0)
        assert stopped["stopped"] is True
        assert not arm.moving
        assert (report.problem, report.lockouts) == ("", ())
        assert report.facts["task_status"] == "idle"
        busy.released.set()
        assert {type(each) for each in await asyncio.gather(*calls, return_exceptions=True)} == {NoAnswerError}

    asyncio.run(both())


def test_call_is_answered_or_refused(console: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, there, _ = console

    async def answers() -> Any:
        features = await there.call_async("arm-1", "getFeatures", {"nothing": None, "empty": ""}, 10.0)
        with pytest.raises(UnknownVerbError, match="arm-1 has no verb 'fly'"):
            await there.call_async("arm-1", "fly", {}, 10.0)
        with pytest.raises(NoSuchRobotError):
            await there.call_async("arm-9", "getStatus", {}, 0.05)
        Busy(mesh, monkeypatch, "ping").released.set()
        with pytest.raises(NoAnswerError, match="arm-1 did not answer"):
            await there.call_async("arm-1", "ping", {}, 0.05)
        return features

    assert asyncio.run(answers())["status"] == "success"


def test_peer_describes_itself_and_an_older_one_is_described_by_its_kind(
    console: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh, there, _ = console
    arm = asyncio.run(there.describe_async("arm-1", 10.0))
    assert {"start", "stop", "acquireControl"} <= {each["name"] for each in arm.functions}
    send = mesh.send

    def older(target: str, cmd: dict[str, Any], timeout: float) -> dict[str, Any]:
        known = cmd["action"] != "describe"
        refused = {"type": "error", "error": "validation: action must be one of stop, not 'describe'."}
        return dict(send(target, cmd, timeout)) if known else refused

    monkeypatch.setattr(mesh, "send", older)
    by_kind = asyncio.run(there.describe_async("arm-1", 10.0))
    assert {"start", "stop"} <= {each["name"] for each in by_kind.functions}


def test_grant_for_a_call_as_it_is_received_lets_that_call_alone_begin(console: Any) -> None:
    _, there, arm = console
    task = {"instruction": "wave", "policy_provider": "mock", "duration": 0.2, "robot_name": ""}
    sent = {**task, "lease_id": "secret", "lease_ttl_s": 5.0}
    received = there.received("arm-1", "start", task)
    bound = {"caller": received.caller, "arguments_digest": digest(received.arguments)}
    Grants(state_dir() / "grants").grant(received.verb, "arm-1", 15.0, **bound)
    with pytest.raises(ApprovalError):
        asyncio.run(there.call_async("arm-1", "start", {**sent, "duration": 0.3}, 10.0))
    asyncio.run(there.call_async("arm-1", "start", sent, 10.0))
    assert arm.started == ["wave"]


def test_silent_robot_has_neither_stopped_nor_reported(console: Any) -> None:
    _, there, _ = console

    async def asked() -> Any:
        return await there.stop_async("arm-9", 0.05), await there.lockout_async("arm-9", 0.05)

    stop, report = asyncio.run(asked())
    assert (stop["status"], stop["stopped"]) == ("error", None)
    assert (report.problem, report.facts) == ("no answer", {})


def test_closed_network_answers_at_once(console: Any) -> None:
    _, there, _ = console
    there.close()

    async def asked() -> Any:
        with pytest.raises(NoAnswerError, match=CLOSED):
            await there.call_async("arm-1", "ping", {}, 10.0)
        return await there.stop_async("arm-1", 10.0), await there.lockout_async("arm-1", 10.0)

    stopped, report = asyncio.run(asked())
    assert (stopped["reason"], stopped["stopped"], report.problem) == (CLOSED, None, CLOSED)


def test_hundredth_stop_begins_as_soon_as_the_first(console: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, there, _ = console
    busy = Busy(mesh, monkeypatch, "stop")

    async def all_of_them() -> None:
        stops = [asyncio.create_task(there.stop_async(f"arm-{each}", 60.0)) for each in range(3 * IN_FLIGHT)]
        await asyncio.to_thread(eventually, lambda: busy.waiting == 3 * IN_FLIGHT, 30.0, what="every stop has begun")
        busy.released.set()
        assert {each["stopped"] for each in await asyncio.gather(*stops)} == {None}

    asyncio.run(all_of_them())


def test_requests_answer_whatever_the_mesh_raises(console: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, there, _ = console

    def broken(*_: Any) -> Any:
        raise OSError("the cable")

    monkeypatch.setattr(mesh, "send", broken)

    async def asked() -> Any:
        with pytest.raises(NoAnswerError, match="the cable"):
            await there.call_async("arm-1", "ping", {}, 10.0)
        return await there.stop_async("arm-1", 10.0), await there.lockout_async("arm-1", 10.0)

    stopped, report = asyncio.run(asked())
    assert [stopped["reason"], report.problem] == ["the cable"] * 2
    assert stopped["stopped"] is None


def test_request_that_waits_for_a_thread_is_answered_where_the_network_is_left(
    console: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh, there, _ = console
    busy = Busy(mesh, monkeypatch, "ping")

    async def left() -> None:
        calls = [asyncio.create_task(there.call_async("arm-1", "ping", {}, 60.0)) for _ in range(IN_FLIGHT + 1)]
        await asyncio.to_thread(eventually, lambda: busy.waiting >= IN_FLIGHT, 30.0, what="every thread of calls waits")
        there.close()
        with pytest.raises(NoAnswerError, match=CLOSED):
            await calls[-1]
        busy.released.set()
        await asyncio.gather(*calls, return_exceptions=True)

    asyncio.run(left())
