"""Requests that are sent again, and the report of their delivery."""

from __future__ import annotations

from typing import Any

import pytest
from tests.mesh.peers import Fleet, ScriptedPeer

from strands_robots.mesh import safety
from strands_robots.mesh.rpc import REPEAT_S
from strands_robots.mesh.transport.memory import MemoryTransport


def test_slow_robot_is_asked_again_under_another_turn_and_counts_as_stopped(peers: Fleet) -> None:
    console, slow = peers.join(None, "console"), ScriptedPeer(peers, "slow", 2.5)
    console.emergency_stop()
    slow.join()
    recorded = peers.events("emergency_stop")[0]
    assert (recorded["not_stopped"], recorded["silent"]) == ([], [])
    assert len(slow.turns) >= 2
    assert len(set(slow.turns)) == len(slow.turns)
    assert not peers.events("response_duplicate_rejected")


def test_result_replaces_an_earlier_error(peers: Fleet) -> None:
    console = peers.join(None, "console")
    busy = ScriptedPeer(peers, "busy", 0.1, first={"type": "error", "error": "busy"})
    console.emergency_stop()
    busy.join()
    assert peers.events("emergency_stop")[0]["not_stopped"] == []


def test_peer_that_answers_only_errors_did_not_stop(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safety, "COLLECT_S", 2.0)
    console = peers.join(None, "console")
    refusing = ScriptedPeer(peers, "refusing", 0.0, always={"type": "error", "error": "dispatch error"})
    console.emergency_stop()
    refusing.join()
    recorded = peers.events("emergency_stop")[0]
    assert (recorded["not_stopped"], recorded["silent"]) == (["refusing"], [])


def test_stop_of_one_peer_whose_message_is_lost_is_sent_again(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    console = peers.join(None, "console")
    there = ScriptedPeer(peers, "there", 0.0)
    sent = lose_commands(peers, monkeypatch, 1)
    assert console.send("there", {"action": "stop"}, timeout=60)["type"] == "response"
    there.join()
    assert (len(sent), len(there.turns)) == (2, 1)


def test_motion_whose_message_is_lost_is_never_sent_again(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    console = peers.join(None, "console")
    sent = lose_commands(peers, monkeypatch, 100)
    assert console.send("there", {"action": "reset"}, timeout=3 * REPEAT_S)["status"] == "timeout"
    assert len(sent) == 1


def lose_commands(peers: Fleet, monkeypatch: pytest.MonkeyPatch, first: int) -> list[str]:
    """Lose the ``first`` commands of the console; return the keys of all that it sends."""
    sent: list[str] = []
    transport = peers.transports["console"]
    put = transport.put

    def lossy(key: str, payload: Any) -> None:
        if key.endswith("/cmd"):
            sent.append(key)
            if len(sent) <= first:
                return
        put(key, payload)

    monkeypatch.setattr(transport, "put", lossy)
    return sent


@pytest.mark.parametrize("taken", [True, None])
def test_reply_reports_the_delivery_of_the_command(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, taken: bool | None
) -> None:
    def put_confirmed(self: MemoryTransport, key: str, payload: Any, timeout: float) -> bool | None:
        self.put(key, payload)
        return taken

    console = peers.join(None, "console")
    ScriptedPeer(peers, "there", 0.0)
    plain = console.send("there", {"action": "ping"}, timeout=20)
    assert (plain["via"], plain["confirmed"]) == ("publish", False)
    monkeypatch.setattr(MemoryTransport, "put_confirmed", put_confirmed)
    monkeypatch.setattr(MemoryTransport, "confirms", True)
    for answer in (console.send("there", {"action": "ping"}, timeout=20), console.ping("there", timeout=20)):
        assert (answer["via"], answer["confirmed"]) == ("direct", taken is True)
    absent = console.send("absent", {"action": "ping"}, timeout=0.05)
    assert (absent["status"], absent["via"]) == ("timeout", "direct")


def test_refused_precondition_reports_no_delivery(peers: Fleet) -> None:
    assert "via" not in peers.join(None, "console").send("a/b", {"action": "ping"}, timeout=1)
