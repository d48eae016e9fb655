"""Holds: every writer waits or leaves a beat out, a halt wins at once, and nothing bursts afterwards."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.bodies import RecordingBody, ScriptedPolicy, StepClock
from fixtures.devices import RecordingDevice
from fixtures.ros_bases import OPEN, TOPIC, velocities
from fixtures.ros_memory import MemoryLink
from fixtures.waiting import eventually

from strands_robots.drivers.reachy.motion import MotionController
from strands_robots.drivers.reachy.target import HeadPose, Target
from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
from strands_robots.hardware.body import DeviceBody
from strands_robots.hardware.robot import HardwareRobot
from strands_robots.policies.rollout import Rollout
from strands_robots.safety.gate import MotionGate, MotionRefused, MotionsHeldError, PermitVoidError
from strands_robots.safety.plane import SafetyPlane
from strands_robots.simulation import Simulation

LONG_S = 60.0
"""A hold that a test ends itself."""


def release(gate: MotionGate) -> None:
    """End the hold of a gate, as its time does."""
    gate._held_until = float("-inf")


@dataclass
class Writer:
    """One way to write: ``send`` begins a motion of one write, ``writes`` counts those that reached the device."""

    gate: MotionGate
    send: Callable[[], object]
    writes: Callable[[], int]
    halt: Callable[[], object]


def _arm() -> Writer:
    device = RecordingDevice()
    device.connect()
    robot = HardwareRobot(device, "arm")
    return Writer(
        robot.gate, lambda: robot.send_action({"pan.pos": 5.0}), lambda: _actions(device), lambda: robot.halt("test")
    )


def _actions(device: RecordingDevice) -> int:
    return sum(1 for each in device.writes if each.action.get("pan.pos") == 5.0)


def _world() -> Writer:
    world = Simulation("cell", realtime=False)
    world.add_robot("arm", "so100")
    key = next(iter(world.body("arm").bounds))
    start = world.body("arm").targets[key]
    return Writer(
        world.gate,
        lambda: world.send_action({key: start + 0.1}, "arm"),
        lambda: int(world.body("arm").targets[key] > start + 0.05),
        lambda: world.halt("test"),
    )


def _base() -> Writer:
    link = MemoryLink()
    robot = MobileBaseRobot("rover", link, TOPIC, publish_rate=100.0, command_gate=OPEN)
    return Writer(
        robot.gate,
        lambda: robot.drive(0.5, 0.0, count=1),
        lambda: velocities(link).count((0.5, 0.0)),
        lambda: robot.halt("test"),
    )


class ReachyConnection:
    """The part of a connection that a frame uses."""

    connects, alive, motor_mode = 1, False, "enabled"
    moves: frozenset[str] = frozenset()
    stop_rest = SimpleNamespace(get=lambda path, within_s=None: [])
    feed = SimpleNamespace(pose=HeadPose, fresh_joints=None)

    def __init__(self) -> None:
        self.frames: list[Target] = []

    def refusal(self) -> str | None:
        return None

    def link(self) -> Any:
        return SimpleNamespace(send_automatic_body_yaw=lambda on: None, send_target=self.frames.append)


def _reachy() -> Writer:
    connection, gate = ReachyConnection(), MotionGate()
    motions = MotionController(connection, gate, "reachy", automatic_body_yaw=True)  # type: ignore[arg-type]
    return Writer(
        gate,
        lambda: motions.stream(Target(body_yaw=0.0), "setTarget"),
        lambda: len(connection.frames),
        lambda: motions.halt("test"),
    )


@pytest.fixture(params=[_arm, _world, _base, _reachy], ids=["arm", "world", "base", "reachy"])
def writer(request: pytest.FixtureRequest, patient_halts: None) -> Iterator[Writer]:
    made: Writer = request.param()
    yield made
    release(made.gate)
    made.halt()


class TestEveryWriter:
    """What a hold means, for each kind of robot."""

    def test_writes_nothing_during_a_hold_and_goes_on_after_it(self, writer: Writer) -> None:
        writer.gate.hold(LONG_S)
        thread = threading.Thread(target=writer.send, daemon=True)
        thread.start()
        thread.join(0.1)
        assert (thread.is_alive(), writer.writes()) == (True, 0)
        release(writer.gate)
        thread.join(20)
        assert (thread.is_alive(), writer.writes()) == (False, 1)

    def test_halt_during_a_hold_wins_at_once(self, writer: Writer) -> None:
        writer.gate.hold(LONG_S)
        ended = list[object]()

        def send() -> None:
            try:
                ended.append(writer.send())
            except (MotionRefused, PermitVoidError) as refused:
                ended.append(refused)

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        eventually(lambda: writer.gate.given, what="the permit")
        halted = threading.Thread(target=writer.halt, daemon=True)
        halted.start()
        halted.join(20)
        thread.join(20)
        assert not halted.is_alive(), "the halt waited for the writer"
        assert not thread.is_alive()
        assert (len(ended), writer.writes()) == (1, 0)


def test_hold_voids_no_permit_and_is_only_ever_made_longer() -> None:
    gate = MotionGate()
    permit, before = gate.permit("move"), gate.holds
    gate.hold(LONG_S)
    gate.hold(0.001)
    time.sleep(0.01)
    assert (permit.held, permit.valid, gate.holds - before) == (True, True, 1)


def test_lock_is_free_while_a_hold_is_waited_for() -> None:
    gate, lock, written = MotionGate(), threading.Lock(), threading.Event()
    gate.hold(LONG_S)
    thread = threading.Thread(target=gate.permit("move").write, args=(lock, written.set), daemon=True)
    thread.start()
    for _ in range(20):
        assert lock.acquire(timeout=10)
        lock.release()
        time.sleep(0.001)
    assert not written.is_set()
    release(gate)
    thread.join(20)
    assert written.is_set()


def test_write_that_finds_a_hold_on_its_way_is_made_again_after_it() -> None:
    gate, tries = MotionGate(), list[float]()

    def write() -> str:
        tries.append(time.monotonic())
        if len(tries) == 1:
            gate.hold(0.05)
            raise MotionsHeldError("held")
        return "written"

    assert gate.permit("move").write(threading.Lock(), write) == "written"
    assert tries[1] - tries[0] >= 0.05


def test_repeated_exchange_does_not_write_after_a_hold_began() -> None:
    class Silent(RecordingDevice):
        """Loses the first answer, and holds the robot meanwhile."""

        def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
            if not self.tries:
                self.tries.append(0.0)
                gate.hold(0.05)
                raise ConnectionError("no status packet")
            self.tries.append(time.monotonic())
            return super().send_action(action)

        tries: list[float]

    device, gate = Silent(), MotionGate()
    device.tries = []
    device.connect()
    body = DeviceBody("arm", device)
    body._send_tries = 3
    began = time.monotonic()
    body.send_action({"pan.pos": 5.0}, gate.permit("move"))
    assert len(device.tries) == 2
    assert device.tries[1] - began >= 0.05


def test_plane_holds_each_of_its_robots() -> None:
    plane = SafetyPlane()
    robots = [_PlaneRobot(), _PlaneRobot()]
    entries = [plane.register(f"arm-{i}", robot) for i, robot in enumerate(robots)]
    plane.hold(LONG_S)
    assert [robot.gate.held for robot in robots] == [True, True]
    for entry in entries:
        entry.close()


class _PlaneRobot:
    tool_name_str = "arm"

    def __init__(self) -> None:
        self.gate = MotionGate()

    def halt(self, reason: str = "") -> Any:
        raise AssertionError


class TestRollouts:
    def test_missed_beats_are_neither_made_up_for_nor_left_out(self) -> None:
        """The plan goes on from where it is: the same actions in their order, a beat apart."""
        gate, clock, body, missed = MotionGate(), StepClock(), RecordingBody(), list[int]()
        plan = [{"a": step / 100} for step in range(20)]

        class Plan(ScriptedPolicy):
            preparing = False

            def act(self, observation: Any) -> Any:
                if len(self.observations) == 7:
                    # The process does not run for ten beats.
                    clock.time += 1.0
                    gate.hold(0.02)
                return super().act(observation)

            def miss(self, ticks: int) -> None:
                missed.append(ticks)

        one = Rollout(body, Plan(plan), permit=gate.permit("test"), hz=10.0, clock=clock)
        one.run()
        assert [action for _, action in body.writes] == plan
        assert (missed, one.missed_ticks) == ([], 0)
        # Every beat is waited for: none follows another one at once.
        gaps = [later - earlier for earlier, later in zip(clock.waits, clock.waits[1:], strict=False)]
        assert min(gaps) >= 0.1 - 1e-9

    def test_velocity_is_set_to_zero_for_the_time_of_a_hold(self) -> None:
        gate, body = MotionGate(), _Wheels()
        policy = ScriptedPolicy([], always={"x.vel": 0.2})
        one = Rollout(body, policy, permit=gate.permit("test"), hz=100.0)
        one.start()
        eventually(lambda: body.writes, what="the base drives")
        gate.hold(LONG_S)
        eventually(lambda: body.holds, what="the base stands")
        count = len(body.writes)
        time.sleep(0.05)
        assert (len(body.writes), body.holds) == (count, 1)
        release(gate)
        eventually(lambda: len(body.writes) > count, what="it goes on")
        one.request_stop()
        assert one.join(20)

    def test_stop_request_ends_a_rollout_that_waits(self) -> None:
        gate, body = MotionGate(), RecordingBody()
        one = Rollout(body, ScriptedPolicy([], always={"a": 0.1}), permit=gate.permit("test"), hz=100.0)
        gate.hold(LONG_S)
        one.start()
        one.request_stop()
        assert one.join(20)
        assert (body.writes, one.state) == ([], "stopped")

    def test_observation_of_the_next_action_is_made_after_the_hold(self) -> None:
        gate, body = MotionGate(), RecordingBody()
        policy = ScriptedPolicy([], always={"a": 0.1})
        gate.hold(LONG_S)
        one = Rollout(body, policy, permit=gate.permit("test"), hz=100.0, steps=1)
        one.start()
        body.position = 0.7
        release(gate)
        assert one.join(20)
        assert policy.observations[0]["a"] == 0.7


class _Wheels(RecordingBody):
    @property
    def bounds(self) -> Any:
        return {"x.vel": (-1.0, 1.0)}

    def send_action(self, action: Any, permit: Any) -> Any:
        self.writes.append((time.monotonic(), dict(action)))
        return action


def test_base_that_drives_gets_zeros_for_the_time_of_a_hold_and_all_its_messages() -> None:
    link = MemoryLink()
    robot = MobileBaseRobot("rover", link, TOPIC, publish_rate=200.0, command_gate=OPEN)
    thread = threading.Thread(target=robot.drive, args=(0.5, 0.0), kwargs={"duration": 0.5}, daemon=True)
    thread.start()
    eventually(lambda: (0.5, 0.0) in velocities(link), what="the base drives")
    robot.gate.hold(0.1)
    thread.join(20)
    sent = velocities(link)
    assert not thread.is_alive()
    assert sent.count((0.5, 0.0)) == 100
    first = sent.index((0.0, 0.0))
    assert (0.5, 0.0) in sent[first:], "the drive goes on after the zeros"
    assert sent[-1] == (0.0, 0.0)
    robot.disconnect()


def test_time_of_a_world_stands_still_in_a_hold(patient_halts: None) -> None:
    world = Simulation("cell")
    world.add_robot("arm", "so100")
    key = next(iter(world.body("arm").bounds))
    world.send_action({key: 0.1}, "arm")
    eventually(lambda: world.physics.snapshot.time, what="time passes")
    world.gate.hold(LONG_S)
    # A step that began before the hold may still end.
    eventually(lambda: _stands(world), what="time stands still")
    release(world.gate)
    world.halt("test")
    world.cleanup()


def _stands(world: Simulation) -> bool:
    before = world.physics.snapshot.time
    time.sleep(0.1)
    return world.physics.snapshot.time == before
