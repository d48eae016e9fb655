"""Stops of a real arm: its stop level, its turn on the bus, and motions that have not begun."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.bodies import ScriptedPolicy
from fixtures.devices import RecordingDevice
from fixtures.leaders import ScriptedLeader
from fixtures.waiting import eventually

from strands_robots.envelope import error
from strands_robots.hardware import DeviceBody, HardwareRobot
from strands_robots.policies import task_engine
from strands_robots.safety.gate import MotionRequest, Permit
from strands_robots.utils import ValidationError


class LimpDevice(RecordingDevice):
    """Notes the motors whose torque was taken off."""

    def __init__(self) -> None:
        super().__init__()
        self.limp: list[str] = []
        self.bus = SimpleNamespace(motors={"pan": 1, "lift": 2}, disable_torque=self.limp.append)


@pytest.mark.parametrize(("word", "limp"), [("limp", ["pan", "lift"]), ("hold", []), ("", []), ("floppy", [])])
def test_a_halt_takes_torque_off_only_where_the_setting_says_limp(
    monkeypatch: pytest.MonkeyPatch, word: str, limp: list[str]
) -> None:
    monkeypatch.setenv("STRANDS_ESTOP_TORQUE", word)
    device = LimpDevice()
    robot = HardwareRobot(device, "arm")
    robot.connect()
    assert robot.halt("test").stopped is True
    assert device.limp == limp


def test_what_a_robot_was_told_outranks_the_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_ESTOP_TORQUE", "limp")
    device = LimpDevice()
    robot = HardwareRobot(device, "arm", stop_level="hold")
    robot.connect()
    assert robot.halt("test").stopped is True
    assert device.limp == []


def test_a_robot_that_cannot_go_limp_is_not_made_to_believe_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_ESTOP_TORQUE", "limp")
    with pytest.raises(ValidationError, match="STRANDS_ESTOP_TORQUE"):
        HardwareRobot(RecordingDevice(), "arm")


class SilentDevice(RecordingDevice):
    """Loses the answers to its next exchanges; each of them is waited for as ``wait`` does."""

    def __init__(self) -> None:
        super().__init__()
        self.lost = 0
        self.wait: Callable[[], object] = lambda: None
        self.began = 0

    def get_joints(self) -> dict[str, float]:
        self.began += 1
        if self.lost:
            self.lost -= 1
            self.wait()
            raise ConnectionError("no status packet")
        return dict(self.positions)


def stop_threads(name: str) -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name == f"halt-{name}"]


def test_the_thread_of_the_stop_stands_ready_once_connected_and_goes_with_the_robot() -> None:
    robot = HardwareRobot(RecordingDevice(), "steady")
    assert stop_threads("steady") == []
    robot.connect()
    assert len(stop_threads("steady")) == 1
    for _ in range(3):
        assert robot.halt("test").stopped is True
    assert len(stop_threads("steady")) == 1
    robot.cleanup()
    eventually(lambda: not stop_threads("steady"))
    assert robot.halt("again").stopped is True, "a halt after the cleanup makes its thread anew"


def test_a_robot_that_nobody_cleans_up_takes_the_thread_along() -> None:
    robot = HardwareRobot(RecordingDevice(), "dropped")
    robot.connect()
    robot.halt("test")
    del robot
    gc.collect()
    eventually(lambda: not stop_threads("dropped"))


def test_a_read_that_lost_an_answer_gives_the_bus_to_a_stop_instead_of_asking_again() -> None:
    device = SilentDevice()
    body = DeviceBody("arm", device)
    asked, failed = threading.Event(), list[Exception]()

    def wait() -> None:
        asked.set()
        eventually(lambda: body.stop_waits, what="the stop, while the exchange is under way")

    device.lost, device.wait = 9, wait

    def read() -> None:
        try:
            body.get_joints()
        except ConnectionError as exc:
            failed.append(exc)

    reader = threading.Thread(target=read)
    reader.start()
    assert asked.wait(20)
    with body.stopping():
        assert device.began == 1, "the exchange that was under way, and no other"
    reader.join(20)
    assert len(failed) == 1


def test_a_stop_that_a_ctrl_c_cuts_off_leaves_the_bus_free_and_nobody_waiting_for_it() -> None:
    class CutOff:
        """The device's lock; a Ctrl-C comes while it is waited for."""

        def __enter__(self) -> None:
            raise KeyboardInterrupt

        def __exit__(self, *exc: object) -> None:
            raise AssertionError

    body = DeviceBody("arm", RecordingDevice())
    lock = body.lock
    body.lock = CutOff()
    with pytest.raises(KeyboardInterrupt), body.stopping():
        pass
    assert not body.stop_waits
    body.lock = lock
    with pytest.raises(KeyboardInterrupt), body.stopping():
        assert body.stop_waits
        raise KeyboardInterrupt
    assert not body.stop_waits
    taken = list[bool]()
    other = threading.Thread(target=lambda: taken.append(lock.acquire(timeout=20)))
    other.start()
    other.join(20)
    assert taken == [True]


def test_the_stop_itself_asks_again() -> None:
    device = SilentDevice()
    robot = HardwareRobot(device, "arm")
    robot.connect()
    device.lost = 2
    assert robot.halt("test").stopped is True
    assert device.writes
    robot.cleanup()


WAVES = {"pan.pos": (0.0, 50.0, 1.0)}


class Locked:
    def refusal(self, verb: str) -> dict[str, Any]:
        return error(f"{verb} is locked.")


@pytest.fixture
def robot() -> Iterator[HardwareRobot]:
    made = HardwareRobot(RecordingDevice(), "waiting", control_hz=200)
    made.connect()
    yield made
    made.device.is_connected = True
    made.cleanup()


@pytest.fixture
def loading(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Set to let the policy that is being made be ready."""
    ready, asked = threading.Event(), threading.Event()

    def slow(name: str, **options: Any) -> ScriptedPolicy:
        asked.set()
        assert ready.wait(60)
        return ScriptedPolicy([], always={"pan.pos": 90.0})

    ready.asked = asked  # type: ignore[attr-defined]
    monkeypatch.setattr(task_engine, "create_policy", slow)
    yield ready
    ready.set()


def on_a_thread(call: Callable[[], Any]) -> tuple[threading.Thread, list[Any]]:
    answers: list[Any] = []
    thread = threading.Thread(target=lambda: answers.append(call()))
    thread.start()
    return thread, answers


def line_of(robot: HardwareRobot) -> threading.Semaphore:
    """Released each time that a motion is given leave: from then on it stands in line, and a halt reaches it."""
    given, permit = threading.Semaphore(0), robot.gate.permit

    def giving(verb: str, request: MotionRequest | None = None) -> Permit:
        leave = permit(verb, request)
        given.release()
        return leave

    robot.gate.permit = giving  # type: ignore[method-assign]
    return given


STOPS = {"stop_task": lambda robot: robot.stop_task(), "halt": lambda robot: robot.halt("test").envelope()}


@pytest.mark.parametrize("verb", STOPS)
def test_a_stop_reaches_a_task_whose_policy_still_loads(robot: HardwareRobot, loading: Any, verb: str) -> None:
    thread, answers = on_a_thread(lambda: robot.start_task("wave"))
    assert loading.asked.wait(20)
    assert STOPS[verb](robot)["stopped"] is True
    written = len(robot.device.writes)
    loading.set()
    thread.join(20)
    assert "halted after it was asked for" in answers[0]["reason"]
    assert not robot.occupied("waiting")
    assert len(robot.device.writes) == written


@pytest.mark.parametrize(
    "motion",
    [
        lambda robot: robot.start_task("nod"),
        lambda robot: robot.send_action({"pan.pos": 90.0}),
        lambda robot: robot.teleoperate("leader"),
    ],
    ids=["start_task", "send_action", "teleoperate"],
)
def test_a_halt_reaches_what_stands_in_line_behind_a_loading_policy(
    robot: HardwareRobot, loading: Any, motion: Callable[[HardwareRobot], Any]
) -> None:
    robot.attach_teleop(ScriptedLeader(WAVES))
    given = line_of(robot)
    first, _ = on_a_thread(lambda: robot.start_task("wave"))
    assert loading.asked.wait(20)
    assert given.acquire(timeout=20)
    second, answers = on_a_thread(lambda: motion(robot))
    assert given.acquire(timeout=20), "it stands in line"
    second.join(0.1)
    assert second.is_alive()
    assert robot.halt("test").stopped is True
    written = len(robot.device.writes)
    loading.set()
    first.join(20)
    second.join(20)
    assert answers[0]["status"] == "error"
    assert not robot.occupied("waiting")
    assert not robot.teleoperating()
    assert len(robot.device.writes) == written


def test_stop_task_reaches_a_run_task_that_waits_behind_a_loading_policy(robot: HardwareRobot, loading: Any) -> None:
    given = line_of(robot)
    first, _ = on_a_thread(lambda: robot.start_task("wave"))
    assert loading.asked.wait(20)
    assert given.acquire(timeout=20)
    second, answers = on_a_thread(lambda: robot.run_task("wave", duration=0.5))
    assert given.acquire(timeout=20), "it waits for the robot"
    assert robot.stop_task()["stopped"] is True
    written = len(robot.device.writes)
    loading.set()
    first.join(20)
    second.join(20)
    assert answers[0]["status"] == "error"
    assert len(robot.device.writes) == written


def test_a_leader_that_stands_in_line_is_stopped_by_its_own_stop(robot: HardwareRobot, loading: Any) -> None:
    robot.attach_teleop(ScriptedLeader(WAVES))
    first, _ = on_a_thread(lambda: robot.start_task("wave"))
    assert loading.asked.wait(20)
    second, answers = on_a_thread(lambda: robot.teleoperate("leader"))
    eventually(lambda: "leader" in list(robot.tasks.waiting_leaders._permits.values()), what="it stands in line")
    assert robot.stop_teleoperate()["stopped"] is True
    robot.stop_task()
    loading.set()
    first.join(20)
    second.join(20)
    assert "halted after it was asked for" in answers[0]["reason"]
    assert not robot.teleoperating()


def test_a_robot_that_fell_off_its_network_in_mid_motion_is_not_called_stopped(robot: HardwareRobot) -> None:
    robot.start_task("wave")
    eventually(lambda: len(robot.device.writes) > 3)
    robot.device.is_connected = False
    verdict = robot.halt("test")
    assert verdict.stopped is False
    assert "not connected" in str(verdict.not_stopped)
    assert robot.halt("again").stopped is not True, "nobody has frozen it since"
    robot.device.is_connected = True
    assert robot.halt("it is back").stopped is True


def test_a_robot_that_was_frozen_before_it_was_disconnected_stands_still(robot: HardwareRobot) -> None:
    robot.send_action({"pan.pos": 5.0})
    assert robot.cleanup()["status"] == "success"
    assert robot.halt("test").stopped is True


def test_a_locked_robot_whose_cable_is_back_is_frozen_as_it_connects(robot: HardwareRobot) -> None:
    robot.start_task("wave")
    eventually(lambda: len(robot.device.writes) > 3)
    robot.device.is_connected = False
    robot.gate.attach(Locked())
    assert robot.halt("test").stopped is False
    written = len(robot.device.writes)
    robot.connect()
    assert len(robot.device.writes) == written + 1, "one write: hold where you are"
    assert robot.halt("again").stopped is True


class BusyBus(RecordingDevice):
    """Loses the answers to the next ``missed`` reads."""

    missed = 0

    def get_observation(self) -> dict[str, Any]:
        if self.missed:
            self.missed -= 1
            raise ConnectionError("Failed to sync read 'Present_Position'")
        return super().get_observation()


def test_missed_observation_on_a_busy_bus_is_read_again() -> None:
    device = BusyBus()
    body = DeviceBody("arm", device)
    device.missed = 2
    assert body.get_observation()["pan.pos"] == 10.0
    device.missed = 3
    with pytest.raises(ConnectionError):
        body.get_observation()


def test_missed_observation_is_not_read_again_while_a_stop_waits() -> None:
    device = BusyBus()
    body = DeviceBody("arm", device)
    with body.stopping():
        device.missed = 2
        with pytest.raises(ConnectionError):
            body.get_observation()
        assert device.missed == 1


class MobileArm:
    """A base with an arm; like LeRobot's LeKiwi it reads the arm before it writes the wheels."""

    is_connected = True
    action_features = observation_features = dict.fromkeys(("pan.pos", "x.vel"), float)

    def __init__(self) -> None:
        self.silent = False
        self.wheels = 0.0

    def connect(self) -> None: ...

    def disconnect(self) -> None: ...

    def get_observation(self) -> dict[str, float]:
        if self.silent:
            raise ConnectionError("no status packet")
        return {"pan.pos": 1.0, "x.vel": self.wheels}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        if "pan.pos" in action:
            self.get_observation()
        self.wheels = action.get("x.vel", self.wheels)
        return action


class Kiwi(MobileArm):
    """One that cannot be sent an action for its wheels alone."""

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.get_observation()
        return super().send_action({"pan.pos": action["pan.pos"], "x.vel": action["x.vel"]})

    def stop_base(self) -> None:
        self.wheels = 0.0


@pytest.mark.parametrize("device", [MobileArm(), Kiwi()], ids=["sent zeros", "stop_base"])
def test_silent_motor_of_an_arm_does_not_keep_its_base_rolling(device: MobileArm) -> None:
    robot = HardwareRobot(device, "kiwi")
    assert robot.send_action({"pan.pos": 1.0, "x.vel": 0.2})["status"] == "success"
    assert device.wheels == 0.2
    device.silent = True
    assert robot.halt("test").stopped is not True
    assert device.wheels == 0.0
    device.silent = False
    assert robot.halt("again").stopped is True
    robot.cleanup()


class SteppingDevice(RecordingDevice):
    """Takes steps, and loses the answer to each."""

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        super().send_action({key: self.positions[key] + step for key, step in action.items()})
        raise ConnectionError("no answer")


def test_action_of_a_device_of_its_own_kind_is_sent_once() -> None:
    device = SteppingDevice()
    robot = HardwareRobot(device, "stepper")
    robot.connect()
    assert robot.send_action({"pan.pos": 5.0})["status"] == "error"
    assert [write.action["pan.pos"] for write in device.writes] == [15.0]
    robot.cleanup()


def test_a_robot_that_was_never_connected_is_unknown_each_time_and_stopped_once_frozen() -> None:
    """Whatever drove it before may still, and nobody here can ask it."""
    robot = HardwareRobot(RecordingDevice(), "arm")
    for _ in range(3):
        verdict = robot.halt("test")
        assert verdict.stopped is None
        assert "never connected" in str(verdict.unknown)
    robot.connect()
    assert robot.halt("test").stopped is True
    robot.device.disconnect()
    assert robot.halt("test").stopped is True, "frozen, and only we could have moved it since"


def test_cleanup_of_a_robot_that_was_never_connected_ends_and_claims_nothing() -> None:
    robot = HardwareRobot(RecordingDevice(), "arm")
    answer = robot.cleanup()
    assert (answer["status"], answer["stopped"]) == ("success", None)


class ClosedBus(SimpleNamespace):
    """A bus of one motor, whose port is closed."""

    def __init__(self) -> None:
        super().__init__(motors={"a": 1})

    def sync_read(self, register: str) -> dict[str, float]:
        raise OSError("the port is closed")


class OpenBus(ClosedBus):
    """The same, open."""

    def sync_read(self, register: str) -> dict[str, float]:
        return {"a": 10.0}


class BusMakingDevice:
    """A device that makes its bus as it connects, and whose camera does not answer."""

    name = "maker"

    def __init__(self, bus: ClosedBus | None) -> None:
        self.action_features = {"a.pos": float}
        self.observation_features = {"a.pos": float, "front": (4, 4, 3)}
        self.bus, self.is_connected = bus, False
        self.sent: list[dict[str, float]] = []

    def connect(self, calibrate: bool = False) -> None:
        self.bus, self.is_connected = OpenBus(), True

    def disconnect(self) -> None:
        self.is_connected = False

    def get_observation(self) -> dict[str, Any]:
        raise TimeoutError("the camera does not answer")

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.sent.append(action)
        return action


@pytest.mark.parametrize("bus_before", [None, ClosedBus()])
def test_a_halt_reads_the_bus_that_the_device_made_as_it_connected(bus_before: ClosedBus | None) -> None:
    device = BusMakingDevice(bus_before)
    robot = HardwareRobot(device, "maker")
    robot.connect()
    try:
        assert robot.halt("test").stopped is True
        assert device.sent == [{"a.pos": 10.0}]
    finally:
        robot.cleanup()
