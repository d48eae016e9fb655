"""Parts of a foreign robot are stopped each, also where the stop of another one hangs."""

from __future__ import annotations

import threading

import pytest
from fixtures.waiting import eventually

from strands_robots.adapted import adapt, adapt_world
from strands_robots.envelope import Envelope, success


@pytest.mark.parametrize("hangs", ["stop_task", "stop_teleoperate"])
def test_stop_that_hangs_leaves_the_other_part_of_a_stranger_its_stop(
    monkeypatch: pytest.MonkeyPatch, hangs: str
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.5")
    released, calls = threading.Event(), []

    class Led:
        def stop_task(self) -> Envelope:
            return self._stop("stop_task")

        def stop_teleoperate(self) -> Envelope:
            return self._stop("stop_teleoperate")

        def _stop(self, verb: str) -> Envelope:
            calls.append(verb)
            if verb == hangs:
                released.wait(20)
            return success("Stopped.")

    robot = adapt(Led())
    try:
        for times in (1, 2):
            assert robot.halt().stopped is False
            eventually(lambda times=times: sorted(calls) == sorted(["stop_task", "stop_teleoperate"] * times), 10)
    finally:
        released.set()


def test_world_whose_own_stop_hangs_has_its_teleoperation_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.5")
    released, ended = threading.Event(), threading.Event()

    class Led:
        def list_robots(self) -> list[str]:
            return ["left"]

        def stop_policy(self, robot_name: str) -> Envelope:
            return success("Stopped.")

        def halt(self, reason: str = "") -> Envelope:
            released.wait(20)
            return success("Stopped.")

        def stop_teleoperate(self) -> Envelope:
            ended.set()
            return success("Ended.")

    try:
        assert adapt_world(Led()).halt().stopped is False
        assert ended.is_set()
    finally:
        released.set()
