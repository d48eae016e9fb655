"""Attempts of a served robot: whose stop it was, and what is no clean end. The robot here is a double."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots.cli import far_recording
from strands_robots.cli.far_recording import FarRobot, FarTask
from strands_robots.cli.led_robot import halted_first
from strands_robots.cli.output import CliError
from strands_robots.cli.recording_state import RecordingState
from strands_robots.errors import NoAnswerError, RobotError
from strands_robots.fleet.adapter import RobotEvent
from strands_robots.recording.file import Recorder

STOPPED = {"state": "stopped"}


class ServedArm:
    """A served robot without cameras, and its network.

    Attributes:
        answers: returns its status, or raises.
        start: called with each start.
        halts: reasons of its halts from here.
    """

    id = address = "arm-1"
    verbs: tuple[str, ...] = ()
    has_lease, model = True, "so100"

    def __init__(self) -> None:
        self.answers: Callable[[], Mapping[str, Any]] = lambda: {"task_status": "running"}
        self.start: Callable[[], object] = lambda: None
        self.halts: list[str] = []
        self.stands = True
        self.robots: dict[str, Any] = {}
        self._tell: Callable[[RobotEvent], None] = lambda event: None

    def features(self) -> dict[str, Any]:
        return {"joint_units": {"pan": "radians"}}

    def status(self) -> Mapping[str, Any]:
        return self.answers()

    def call(self, verb: str, **arguments: Any) -> dict[str, Any]:
        self.start()
        return {}

    def halt(self, reason: str) -> Any:
        self.halts.append(reason)
        return SimpleNamespace(stopped=self.stands)

    def of(self, name: str, verb: str = "", *, moves: bool) -> Any:
        return SimpleNamespace(starts="execute", subscribe=self.subscribe)

    def subscribe(self, name: str, tell: Callable[[RobotEvent], None], detail: Any) -> Callable[[], None]:
        self._tell = tell
        return lambda: None

    def tells(self, name: str, payload: Mapping[str, Any]) -> None:
        """Send an event, on the network's thread."""
        self._tell(RobotEvent("arm-1", name, payload))


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(far_recording, "LOOK_S", 0.01)
    monkeypatch.setattr(far_recording, "SILENT_S", 0.05)


@pytest.fixture
def arm() -> ServedArm:
    return ServedArm()


@pytest.fixture
def recorder(tmp_path: Path) -> Iterator[Recorder]:
    with Recorder(tmp_path / "attempt.mcap", joints_of_events=False) as made:
        yield made


@pytest.fixture
def robot(arm: ServedArm, recorder: Recorder) -> Iterator[FarRobot]:
    world: Any = arm
    made = FarRobot(world, world, "", "mock", "wave", None)
    with made.recorded(recorder, 30, None):
        yield made
        made.halt("test ended")


def ended(task: FarTask) -> None:
    eventually(lambda: not task.running, within=5)


def test_robot_of_both_networks_is_followed_on_the_one_that_motions_go_to(arm: ServedArm, recorder: Recorder) -> None:
    world: Any = arm
    networks: Any = SimpleNamespace(of=arm.of)
    with FarRobot(world, networks, "", "", "wave", None).recorded(recorder, 30, None):
        arm.tells("streamStep", {"observation": {"pan": 1.0}})
    eventually(lambda: recorder.counts["/arm-1/streamStep"] == 1, within=5, what="the step")


def test_stop_that_comes_just_before_the_end_is_that_of_others(arm: ServedArm, robot: FarRobot) -> None:
    arm.answers = lambda: {"task_status": "stopped"}
    task = robot.begin(30)
    arm.tells("taskComplete", STOPPED)
    # Asked before the watcher has looked: the attempt ends by its time at this moment.
    assert (robot.stopped, robot.stopped_by) == (True, "arm-1 was stopped.")
    ended(task)
    assert (task.voided, task.error) == (True, "")


def test_end_of_an_attempt_is_no_stop_of_others(arm: ServedArm, robot: FarRobot) -> None:
    task = robot.begin(30)
    robot.halt("attempt ended")
    arm.tells("taskComplete", STOPPED)
    assert (robot.stopped, robot.stopped_by, task.voided, task.error) == (False, "", False, "")


def test_leader_elsewhere_halts_its_own_motion_and_only_a_lockout_ends_the_attempt(
    arm: ServedArm, recorder: Recorder
) -> None:
    world: Any = arm
    robot = FarRobot(world, world, "", "", "wave", None)
    with robot.recorded(recorder, 30, None):
        task = robot.begin(None)
        for _ in range(2):
            arm.tells("taskComplete", STOPPED)
        looks: list[None] = []

        def look() -> Mapping[str, Any]:
            looks.append(None)
            return {"task_status": "idle"}

        arm.answers = look
        eventually(lambda: len(looks) > 3, within=5, what="some looks at it since")
        assert (task.running, robot.stopped) == (True, False)
        arm.answers = lambda: {"task_status": "idle", "locked": True}
        ended(task)
        assert robot.stopped_by == "arm-1 is locked by an emergency stop."


def test_answer_that_comes_late_says_nothing_of_the_next_attempt(
    arm: ServedArm, robot: FarRobot, recorder: Recorder
) -> None:
    asked, let = threading.Event(), threading.Event()

    def late() -> Mapping[str, Any]:
        asked.set()
        assert let.wait(5)
        return {"locked": True}

    arm.answers = late
    first = robot.begin(30)
    assert asked.wait(5)
    watcher = next(each for each in threading.enumerate() if each.name == "attempt arm-1")
    robot.halt("attempt ended")
    arm.answers = lambda: {"task_status": "running"}
    second = robot.begin(30)
    let.set()
    watcher.join(5)
    assert (robot.stopped, second.running, first.stopped_by) == (False, True, "")
    assert "locked" not in recorder.arrived


def test_robot_that_is_locked_ends_the_attempt_and_the_lockout_is_recorded(
    arm: ServedArm, robot: FarRobot, recorder: Recorder
) -> None:
    arm.answers = lambda: {"locked": True}
    task = robot.begin(30)
    ended(task)
    assert (task.voided, robot.stopped_by) == (True, "arm-1 is locked by an emergency stop.")
    assert "locked" in recorder.arrived


def test_watcher_that_cannot_read_the_robot_ends_the_attempt(arm: ServedArm, robot: FarRobot) -> None:
    def broken() -> Mapping[str, Any]:
        raise TypeError("its status is a list")

    arm.answers = broken
    task = robot.begin(30)
    ended(task)
    assert task.error == "arm-1 can be watched no more: TypeError: its status is a list"


def test_silent_robot_ends_the_attempt(arm: ServedArm, robot: FarRobot) -> None:
    def silent() -> Mapping[str, Any]:
        raise NoAnswerError("no answer")

    arm.answers = silent
    task = robot.begin(30)
    ended(task)
    assert task.error.startswith("arm-1 is out of reach: ")


@pytest.mark.parametrize(
    ("payload", "error"),
    [
        ({"state": "completed"}, ""),
        ({"state": "error"}, "its policy ended as 'error'"),
        ({"state": "error", "error": "out of memory"}, "out of memory"),
        ({"state": "completed", "error": "late"}, "late"),
    ],
)
def test_policy_that_failed_without_a_word_is_no_clean_end(
    arm: ServedArm, robot: FarRobot, payload: Mapping[str, Any], error: str
) -> None:
    task = robot.begin(30)
    arm.tells("taskComplete", payload)
    ended(task)
    assert (task.error, task.voided, robot.stopped) == (error, False, False)


def test_policy_whose_end_nobody_tells_is_no_success(arm: ServedArm, robot: FarRobot) -> None:
    task = robot.begin(30)
    looked = threading.Event()
    arm.answers = lambda: (looked.set(), {"task_status": "running"})[1]
    assert looked.wait(5)
    eventually(lambda: task.running, within=1)
    arm.answers = lambda: {"task_status": "idle"}
    ended(task)
    assert (task.voided, robot.stopped) == (True, False)


@pytest.mark.parametrize("running", [True, False], ids=["it was seen to run", "it was not"])
@pytest.mark.parametrize(
    "status",
    [{"task_status": "stopped"}, {"task_status": "idle", "outcomes": {"so100": {"task_status": "stopped"}}}],
    ids=["arm", "world"],
)
def test_stop_that_only_the_status_tells_is_that_of_others_and_recorded(
    arm: ServedArm, robot: FarRobot, recorder: Recorder, status: Mapping[str, Any], running: bool
) -> None:
    looked = threading.Event()
    arm.answers = lambda: (looked.set(), {"task_status": "running"})[1] if running else status
    task = robot.begin(30)
    if running:
        assert looked.wait(5)
        arm.answers = lambda: status
    ended(task)
    assert (task.voided, robot.stopped_by) == (True, "arm-1 was stopped.")
    eventually(lambda: recorder.counts["/arm-1/halted"] == 1, within=5, what="the stop")


@pytest.mark.parametrize(
    ("outcome", "error"),
    [
        ({"task_status": "completed", "why": "it is done"}, ""),
        ({"task_status": "error", "why": "no memory"}, "no memory"),
    ],
)
def test_end_of_a_policy_that_only_the_status_tells_is_that_end(
    arm: ServedArm, robot: FarRobot, outcome: Mapping[str, Any], error: str
) -> None:
    looked = threading.Event()
    arm.answers = lambda: (looked.set(), {"running_policies": {"so100": {}}})[1]
    task = robot.begin(30)
    assert looked.wait(5)
    arm.answers = lambda: {"running_policies": {}, "outcomes": {"so100": outcome}}
    ended(task)
    assert (task.error, task.voided, robot.stopped) == (error, False, False)


def test_policy_that_is_not_seen_to_run_yet_has_not_ended(arm: ServedArm, robot: FarRobot) -> None:
    looks: list[None] = []
    arm.answers = lambda: (looks.append(None), {"task_status": "completed"})[1]
    task = robot.begin(30)
    eventually(lambda: len(looks) > 3, within=5, what="some looks at it")
    assert task.running


def test_halt_of_others_motion_that_only_the_status_tells_is_recorded_once(arm: ServedArm, recorder: Recorder) -> None:
    world: Any = arm
    robot = FarRobot(world, world, "", "", "wave", None)
    looks: list[None] = []

    def answer(status: Mapping[str, Any]) -> Callable[[], Mapping[str, Any]]:
        return lambda: (looks.append(None), status)[1]

    def looked() -> None:
        looks.clear()
        eventually(lambda: len(looks) > 3, within=5, what="some looks at it")

    with robot.recorded(recorder, 30, None):
        task = robot.begin(None)
        for times in (1, 2):
            arm.answers = answer({"task_status": "running"})
            looked()
            arm.answers = answer({"task_status": "stopped"})
            looked()
            assert (task.running, robot.stopped) == (True, False)
            eventually(lambda times=times: recorder.counts["/arm-1/halted"] == times, within=5, what="the halt")
        robot.halt("test ended")


def test_policy_that_is_loading_is_not_started_after_a_stop_of_the_recording(arm: ServedArm, robot: FarRobot) -> None:
    state, tries = RecordingState(), list[str]()

    def loading() -> None:
        tries.append("start")
        if len(tries) == 2:
            state.halt("the recording was stopped: stop by desk")
        raise RobotError("its policy is loading", envelope={"loading": True})

    arm.start = loading
    with pytest.raises(CliError, match="Nothing began: the recording was stopped: stop by desk"):
        robot.begin(30, state.check)
    assert len(tries) == 2


def test_start_that_is_not_answered_halts_the_robot(arm: ServedArm, robot: FarRobot) -> None:
    def unanswered() -> None:
        raise NoAnswerError("no answer")

    arm.start, arm.stands = unanswered, False
    with pytest.raises(CliError, match="arm-1 did not confirm its stop and may move"):
        robot.begin(30)
    assert arm.halts == ["its start was not answered"]


def test_robot_that_refused_its_start_is_not_halted_for_others_may_move_it(arm: ServedArm, robot: FarRobot) -> None:
    def refused() -> None:
        raise RobotError("it is driven by hand")

    arm.start = refused
    with pytest.raises(CliError, match="driven by hand"), halted_first(robot):
        robot.begin(30)
    assert arm.halts == []


def test_refused_motion_of_the_mesh_is_recorded_as_that_of_device_connect(
    arm: ServedArm, robot: FarRobot, recorder: Recorder
) -> None:
    arm.tells("safety_event", {"event": "motion_refused", "verb": "execute"})
    arm.tells("safety_event", {"event": "emergency_stop"})
    assert set(recorder.arrived) == {"jointUnits", "motionRefused"}


def test_robot_is_stopped_before_anything_of_its_leader_is_waited_for(arm: ServedArm) -> None:
    hand = SimpleNamespace(
        begin=lambda *given, **more: None,
        cease=lambda: arm.halts.append("no more commands"),
        end=lambda: arm.halts.append("the leader is let go"),
    )
    robot: Any = FarRobot(arm, arm, "", "", "wave", None, hand)  # type: ignore[arg-type]
    robot.begin(1.0)
    assert robot.halt("attempt ended").stopped
    assert arm.halts == ["no more commands", "attempt ended", "the leader is let go"]
