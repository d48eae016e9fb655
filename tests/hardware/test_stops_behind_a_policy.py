"""A stop waits for no policy: neither for a call of it that hangs nor for its interruption."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from fixtures.bodies import ScriptedPolicy
from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually

from strands_robots.hardware import HardwareRobot
from strands_robots.policies import task_engine
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.simulation import Simulation


class HangingPolicy(ScriptedPolicy):
    """Returns from one call, or from its interruption, when ``release`` is set; moves one joint before."""

    def __init__(self, joint: str, *, interrupts: bool) -> None:
        super().__init__([{joint: 0.1}], always=self._hang)
        self.release = threading.Event()
        self.hangs = threading.Event()
        self._interrupts = interrupts

    def _hang(self) -> None:
        self.hangs.set()
        self.release.wait(120)

    def interrupt(self) -> None:
        super().interrupt()
        if not self._interrupts:
            self.release.wait(120)


@pytest.fixture
def no_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    """No deadline helps a stop along within a test."""
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "30")


@pytest.fixture(params=[True, False], ids=["act hangs", "interrupt hangs"])
def policy(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], HangingPolicy]]:
    made: list[HangingPolicy] = []

    def make(joint: str) -> HangingPolicy:
        made.append(HangingPolicy(joint, interrupts=request.param))
        monkeypatch.setattr(task_engine, "create_policy", lambda name, **options: made[-1])
        return made[-1]

    yield make
    for each in made:
        each.release.set()


def hung_arm(policy: Callable[[str], HangingPolicy]) -> tuple[HardwareRobot, RecordingDevice, HangingPolicy]:
    """Return an arm whose policy hangs."""
    device, hanging = RecordingDevice(), policy("pan.pos")
    robot = HardwareRobot(device, "arm")
    robot.connect()
    robot.start_task("wave")
    assert hanging.hangs.wait(20)
    return robot, device, hanging


@pytest.mark.usefixtures("no_deadline")
def test_an_arm_is_frozen_by_each_stop_while_its_policy_hangs(policy: Any) -> None:
    robot, device, hanging = hung_arm(policy)
    stops = []
    for _ in range(10):
        written = len(device.writes)
        stops.append(stop_executor().submit(robot, "arm", "test"))
        eventually(lambda written=written: len(device.writes) > written, what="the freeze")  # type: ignore[misc]
        assert device.writes[-1].action == device.positions
    assert not any(each.done() for each in stops), "its loop has not returned"
    hanging.release.set()
    assert all(each.result(20).stopped for each in stops)
    assert "task" in stops[0].result(20).halted
    robot.cleanup()


@pytest.mark.usefixtures("no_deadline")
def test_stop_task_freezes_before_the_policy_is_interrupted(policy: Any) -> None:
    robot, device, hanging = hung_arm(policy)
    written = len(device.writes)
    answers: list[Any] = []
    stopping = threading.Thread(target=lambda: answers.append(robot.stop_task()))
    stopping.start()
    eventually(lambda: len(device.writes) > written, what="the freeze")
    assert not answers
    hanging.release.set()
    stopping.join(20)
    assert answers[0]["stopped"] is True
    robot.cleanup()


@pytest.mark.usefixtures("no_deadline")
def test_a_world_is_frozen_by_each_stop_while_a_policy_hangs(policy: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    hanging = policy("shoulder_pan")
    world = Simulation()
    world.add_robot("left", "so100")
    frozen: list[None] = []
    hold = world.physics.hold
    monkeypatch.setattr(world.physics, "hold", lambda: (frozen.append(None), hold()))
    world.start_policy("left", "wave", "mock")
    assert hanging.hangs.wait(20)
    stops = []
    for number in range(10):
        stops.append(stop_executor().submit(world, "world", "test"))
        eventually(lambda number=number: len(frozen) > number, what="the freeze")  # type: ignore[misc]
    assert not any(each.done() for each in stops), "its loop has not returned"
    hanging.release.set()
    assert all(each.result(20).stopped for each in stops)
    world.cleanup()
