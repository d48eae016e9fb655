"""A halt and the motions of a Reachy Mini that wait to start."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots.drivers.reachy.motion import MotionController
from strands_robots.safety.gate import MotionGate, MotionRefused, MotionRequest, Permit


class IdleConnection:
    """The part of a connection that a write of the motors' torque uses."""

    connects, alive, motor_mode = 1, False, "enabled"
    moves: frozenset[str] = frozenset()
    stop_rest = SimpleNamespace(get=lambda path, within_s=None: [])

    def refusal(self) -> str | None:
        return None

    def link(self) -> Any:
        return SimpleNamespace(send_automatic_body_yaw=lambda on: None)


@pytest.fixture
def gate() -> MotionGate:
    return MotionGate()


@pytest.fixture
def motions(gate: MotionGate) -> MotionController:
    return MotionController(IdleConnection(), gate, "reachy", automatic_body_yaw=True)  # type: ignore[arg-type]


def test_halt_reports_a_torque_write_that_does_not_return_and_voids_the_motion_behind_it(
    motions: MotionController, gate: MotionGate, monkeypatch: pytest.MonkeyPatch
) -> None:
    permitted: list[str] = []
    permit = gate.permit

    def recorded_permit(name: str, request: MotionRequest | None = None) -> Permit:
        given = permit(name, request)
        permitted.append(name)
        return given

    monkeypatch.setattr(gate, "permit", recorded_permit)
    switching, release = threading.Event(), threading.Event()
    done: list[str] = []

    def slow() -> None:
        switching.set()
        release.wait(60)
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
    eventually(lambda: "enableMotors" in permitted, what="the second waits to start")
    threads[1].join(0.1)
    assert threads[1].is_alive()
    verdict = motions.halt("test")
    assert verdict.stopped is False
    assert "does not return" in str(verdict.not_stopped)
    release.set()
    for thread in threads:
        thread.join(20)
        assert not thread.is_alive()
    assert done == ["disabled"]
    assert "halted after it was asked for" in str(refused[0])
    assert motions.halt("again").stopped is True
