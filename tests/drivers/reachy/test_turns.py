"""Stops and what stands in line for its turn with a Reachy."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots.drivers.reachy.motion import Motions
from strands_robots.safety.gate import MotionGate, MotionRefused, Permit


class Quiet:
    """As much of a connection as a write of the motors' torque meets; its daemon plays nothing."""

    connects, alive, motor_mode = 1, False, "enabled"
    polled = SimpleNamespace(moves=frozenset())
    stop_rest = SimpleNamespace(get=lambda path, within_s=None: [])

    def refusal(self) -> str | None:
        return None

    def link(self) -> Any:
        return SimpleNamespace(send_automatic_body_yaw=lambda on: None)


@pytest.fixture
def gate() -> MotionGate:
    return MotionGate()


@pytest.fixture
def motions(gate: MotionGate) -> Motions:
    return Motions(Quiet(), gate, "reachy", automatic_body_yaw=True)  # type: ignore[arg-type]


def test_a_halt_waits_for_torque_that_is_being_switched_and_voids_what_stands_behind_it(
    motions: Motions, gate: MotionGate, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    permit = gate.permit

    def noted(name: str) -> Permit:
        given = permit(name)
        asked.append(name)
        return given

    monkeypatch.setattr(gate, "permit", noted)
    switching, let_go = threading.Event(), threading.Event()
    done: list[str] = []

    def slow() -> None:
        switching.set()
        let_go.wait(60)
        done.append("disabled")

    refused: list[BaseException] = []

    def second() -> None:
        try:
            motions.torque(lambda: done.append("enabled"), "enableMotors")
        except MotionRefused as exc:
            refused.append(exc)

    threads = [threading.Thread(target=motions.torque, args=(slow, "disableMotors")), threading.Thread(target=second)]
    threads[0].start()
    assert switching.wait(20)
    threads[1].start()
    eventually(lambda: "enableMotors" in asked, what="the second stands in line")
    threads[1].join(0.1)
    assert threads[1].is_alive()
    verdict = motions.halt("test")
    assert verdict.stopped is False
    assert "does not return" in str(verdict.not_stopped)
    let_go.set()
    for thread in threads:
        thread.join(20)
        assert not thread.is_alive()
    assert done == ["disabled"]
    assert "halted after it was asked for" in str(refused[0])
    assert motions.halt("again").stopped is True
