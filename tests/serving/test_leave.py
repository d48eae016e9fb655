"""A motion that a halt overtakes between its leave and its robot is refused there, by every robot."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from fixtures.devices import RecordingDevice
from fixtures.ros_memory import MemoryLink
from fixtures.toy_robots import ToyRobot, ToyWorld

from strands_robots import Permit, Simulation, verb
from strands_robots.adapted import AdaptedRobot, adapt
from strands_robots.drivers.reachy import ReachyDriver
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.envelope import success
from strands_robots.hardware import HardwareRobot
from strands_robots.ros.gate import CommandGate
from strands_robots.safety.authorization import Leave
from strands_robots.safety.gate import MotionGate
from strands_robots.serving.offered_verbs import own_verbs
from strands_robots.serving.peer_verbs import PEER_VERBS
from strands_robots.serving.pipeline import Command, Pipeline, Result
from strands_robots.serving.reachy_verbs import REACHY_VERBS
from strands_robots.serving.robot_verbs import NAVIGATING_BASE_VERBS, TASK_VERBS, WORLD_VERBS
from strands_robots.serving.stops import OneRobot
from strands_robots.serving.verbs import Verb


class HaltAfterLeave(Pipeline):
    """Pipeline of a robot that is halted when leave has been given, before the motion begins."""

    def leave(self, command: Command, arguments: dict[str, Any]) -> Leave:
        given = super().leave(command, arguments)
        assert self.robot is not None
        self.robot.gate.revoke()
        return given


def overtaken(robot: Any, described: Verb, **arguments: Any) -> dict[str, Any]:
    line = HaltAfterLeave.of(robot, lambda: "arm-1", hardware=False, authorize=lambda command, given: ("tester",))
    answers: list[Result] = []
    line.serve(Command(described, arguments, "tester", line.pending.arrive()), answers.append)
    answer: dict[str, Any] = answers[0].result
    return answer


@contextmanager
def arm() -> Iterator[HardwareRobot]:
    robot = HardwareRobot(RecordingDevice(), "arm")
    robot.connect()
    yield robot
    robot.cleanup()


@contextmanager
def world() -> Iterator[Simulation]:
    simulated = Simulation(tool_name="world", realtime=False)
    simulated.add_robot("left", model="so100")
    yield simulated
    simulated.cleanup()


@contextmanager
def child() -> Iterator[OneRobot]:
    with world() as simulated:
        yield OneRobot(simulated, "left")


@contextmanager
def base() -> Iterator[RosBridgedRobot]:
    approved = CommandGate(lambda _: ("cmd_vel", "navigate_to_pose"), lambda: False)
    yield RosBridgedRobot(
        "rover", "/cmd_vel", "/odom", nav_action="/navigate_to_pose", link=MemoryLink(), command_gate=approved
    )


@contextmanager
def reachy() -> Iterator[ReachyDriver]:
    yield ReachyDriver("127.0.0.1")


TASK = {"instruction": "wave"}
PEER_TASK = {"instruction": "wave", "policy_provider": "mock", "duration": 1.0}
POINT = {"x": 0.2, "y": 0.0, "z": 0.1}
OURS = [
    (arm, TASK_VERBS["execute"], TASK),
    (arm, PEER_VERBS["start"], PEER_TASK),
    (world, WORLD_VERBS["execute"], TASK),
    (world, PEER_VERBS["start"], PEER_TASK),
    (child, PEER_VERBS["start"], PEER_TASK),
    (world, WORLD_VERBS["reset"], {}),
    (world, WORLD_VERBS["moveJoints"], {"joints": {"wrist_flex": 10.0}}),
    (world, WORLD_VERBS["moveTo"], POINT),
    (world, WORLD_VERBS["moveBy"], {"dz": 0.01}),
    (world, WORLD_VERBS["setGripper"], {"opening": 1.0}),
    (world, WORLD_VERBS["goTo"], {"place": "home"}),
    (world, WORLD_VERBS["pick"], POINT),
    (base, NAVIGATING_BASE_VERBS["drive"], {"linear": 0.1, "angular": 0.0, "duration": 1.0}),
    (base, NAVIGATING_BASE_VERBS["navigateTo"], {"x": 1.0, "y": 0.0}),
    *((reachy, REACHY_VERBS[name], {}) for name in ("look", "antennas", "body", "nod", "wakeUp", "sleep")),
    *((reachy, REACHY_VERBS[name], {}) for name in ("enableMotors", "disableMotors")),
    (reachy, PEER_VERBS["nod"], {}),
]


@pytest.mark.parametrize(
    ("made", "described", "arguments"), OURS, ids=[f"{made.__name__} {described.name}" for made, described, _ in OURS]
)
def test_robot_of_ours_is_given_the_request_as_an_argument(
    made: Callable[[], Any], described: Verb, arguments: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    with made() as robot:
        with monkeypatch.context() as patch:
            patch.setattr(MotionGate, "within", lambda gate, request: pytest.fail("the thread was asked"))
            answer = overtaken(robot, described, **arguments)
        assert "halted after it was asked for" in answer["reason"]


class WithoutGate:
    """A stranger's robot that knows no gate."""

    def __init__(self) -> None:
        self.started = 0

    def start_task(self, instruction: str, **options: Any) -> dict[str, Any]:
        self.started += 1
        return success("started")

    def stop_task(self) -> dict[str, Any]:
        return success("stopped", stopped=True)

    def get_task_status(self) -> dict[str, Any]:
        return success("idle", task_status="idle")

    def get_features(self) -> dict[str, Any]:
        return success("none", observation_features={}, action_features={})


class WithGate(WithoutGate):
    """A stranger's robot that asks a gate of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.gate = MotionGate()

    def move_joints(self, joints: dict[str, float], **options: Any) -> dict[str, Any]:
        self.gate.permit("moveJoints")
        self.started += 1
        return success("moved")


class Barista(WithoutGate):
    """A stranger's robot with a verb of its own."""

    @verb
    def brew(self, permit: Permit) -> None:
        """Brew."""
        self.started += 1


@pytest.mark.parametrize("made", [WithoutGate, WithGate])
def test_task_of_a_strangers_robot_is_not_started(made: Callable[[], WithoutGate]) -> None:
    stranger = made()
    robot = adapt(stranger)
    assert isinstance(robot, AdaptedRobot)
    assert "halted after it was asked for" in overtaken(robot, TASK_VERBS["execute"], **TASK)["reason"]
    assert stranger.started == 0


def test_strangers_permit_is_given_for_the_request() -> None:
    stranger = WithGate()
    answer = overtaken(adapt(stranger), TASK_VERBS["moveJoints"], joints={"pan": 1.0})
    assert "halted after it was asked for" in answer["reason"]
    assert stranger.started == 0


def test_verb_of_a_robots_own_is_not_begun() -> None:
    stranger = Barista()
    answer = overtaken(adapt(stranger), own_verbs(stranger)["brew"])
    assert "halted after it was asked for" in answer["reason"]
    assert stranger.started == 0


@pytest.mark.parametrize(
    ("toy", "verbs"), [(ToyRobot(), TASK_VERBS), (ToyWorld(), WORLD_VERBS)], ids=["robot", "world"]
)
def test_strangers_robot_with_the_whole_contract_is_refused_its_permit(toy: Any, verbs: dict[str, Verb]) -> None:
    answer = overtaken(toy, verbs["execute"], **TASK)
    assert "halted after it was asked for" in answer["reason"]
    assert not toy.rollouts
