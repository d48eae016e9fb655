"""A question that is asked again, and how the asker tells that its command travelled."""

from __future__ import annotations

import json
import threading
from typing import Any

import pytest
from tests.mesh.peers import Fleet

from strands_robots.mesh import safety
from strands_robots.mesh.transport.memory import MemoryTransport

Answer = dict[str, Any]


class Strict:
    """A peer as the field has it: one command of a turn, and an answer after a while."""

    def __init__(
        self, peers: Fleet, name: str, seconds: float, first: Answer | None = None, always: Answer | None = None
    ) -> None:
        self.name, self.seconds, self.first, self.always = name, seconds, first, always
        self.turns: list[str] = []
        self.threads: list[threading.Timer] = []
        self.wire = peers.stranger()
        self.wire.put(f"strands/{name}/presence", {"robot_id": name, "timestamp": peers.clock()})
        for key in ("strands/broadcast", f"strands/{name}/cmd"):
            self.wire.declare_subscriber(key, self.asked)

    def asked(self, sample: Any) -> None:
        body = json.loads(sample.payload)
        again = body["turn_id"] in self.turns
        first = self.first if not self.turns else None
        first = self.always or first
        self.turns.append(body["turn_id"])
        head = {"responder_id": self.name, "turn_id": body["turn_id"], "timestamp": body["timestamp"]}
        key = f"strands/{body['sender_id']}/response/{self.name}/{body['turn_id']}"
        if again:
            self.wire.put(key, {**head, "type": "error", "error": "replay"})
            return
        said = first or {"type": "response", "result": {"ok": True}}
        late = threading.Timer(self.seconds if first is None else 0.0, lambda: self.wire.put(key, {**head, **said}))
        self.threads.append(late)
        late.start()

    def join(self) -> None:
        for each in self.threads:
            each.join(20)


def test_a_robot_that_stops_slowly_is_asked_again_under_another_turn_and_counts_as_stopped(peers: Fleet) -> None:
    console, slow = peers.join(None, "console"), Strict(peers, "slow", 2.5)
    console.emergency_stop()
    slow.join()
    recorded = peers.events("emergency_stop")[0]
    assert (recorded["not_stopped"], recorded["silent"]) == ([], [])
    assert len(slow.turns) >= 2
    assert len(set(slow.turns)) == len(slow.turns)
    assert not peers.events("response_duplicate_rejected")


def test_an_error_does_not_outvote_the_true_answer_after_it(peers: Fleet) -> None:
    console = peers.join(None, "console")
    busy = Strict(peers, "busy", 0.1, first={"type": "error", "error": "busy"})
    console.emergency_stop()
    busy.join()
    assert peers.events("emergency_stop")[0]["not_stopped"] == []


def test_who_answers_with_errors_alone_did_not_stop(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safety, "COLLECT_S", 2.0)
    console = peers.join(None, "console")
    refusing = Strict(peers, "refusing", 0.0, always={"type": "error", "error": "dispatch error"})
    console.emergency_stop()
    refusing.join()
    recorded = peers.events("emergency_stop")[0]
    assert (recorded["not_stopped"], recorded["silent"]) == (["refusing"], [])


@pytest.mark.parametrize("taken", [True, None])
def test_a_sender_is_told_how_its_command_went(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch, taken: bool | None
) -> None:
    def put_confirmed(self: MemoryTransport, key: str, payload: Any, timeout: float) -> bool | None:
        self.put(key, payload)
        return taken

    console = peers.join(None, "console")
    Strict(peers, "there", 0.0)
    plain = console.send("there", {"action": "ping"}, timeout=20)
    assert (plain["via"], plain["confirmed"]) == ("publish", False)
    monkeypatch.setattr(MemoryTransport, "put_confirmed", put_confirmed, raising=False)
    for answer in (console.send("there", {"action": "ping"}, timeout=20), console.ping("there", timeout=20)):
        assert (answer["via"], answer["confirmed"]) == ("direct", taken is True)
    absent = console.send("nobody", {"action": "ping"}, timeout=0.05)
    assert (absent["status"], absent["via"]) == ("timeout", "direct")


def test_a_refused_precondition_did_not_travel(peers: Fleet) -> None:
    assert "via" not in peers.join(None, "console").send("a/b", {"action": "ping"}, timeout=1)
