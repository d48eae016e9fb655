"""A foreign robot is made to fit in one place."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
from fixtures.devices import BlindDevice

from strands_robots.adapted import AdaptedRobot, adapt, adapt_world, behind_contract, lacks, warn_endless
from strands_robots.bus_access import bus_lock, read_joints
from strands_robots.contract import TaskRobot, for_request, holds_robots, put_away
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.gate import MotionGate, MotionRequest, answered
from strands_robots.safety.stopping import StopVerdict, grade
from strands_robots.serving.stops import robot_stop
from strands_robots.utils import ValidationError


class Foreign:
    """No more than the four verbs."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.stop_answer: Any = success("Stopped.", stopped=True)

    def start_task(self, instruction: str, **options: Any) -> Envelope:
        self.calls.append(f"start {instruction} {options}")
        return success("Started.")

    def stop_task(self) -> Any:
        self.calls.append("stop")
        if isinstance(self.stop_answer, BaseException):
            raise self.stop_answer
        return self.stop_answer

    def get_task_status(self) -> Envelope:
        return success("Idle.", task_status="idle")

    def get_features(self) -> Envelope:
        return success("None.")


class Locked:
    def refusal(self, verb: str) -> Envelope:
        return error(f"{verb} is refused: locked.")


def test_a_robot_of_four_verbs_is_made_to_fit() -> None:
    robot = adapt(Foreign())
    assert isinstance(robot, TaskRobot)
    assert robot.tool_name_str == "robot"
    assert robot.start_task("wave")["status"] == "success"
    assert robot.get_state()["task"]["task_status"] == "idle"
    assert robot.get_features()["status"] == "success"
    robot.subscribe(lambda event: None)()


def test_a_robot_that_fits_is_given_back_as_it_is() -> None:
    robot = adapt(Foreign())
    assert adapt(robot) is robot


@pytest.mark.parametrize("value", [None, 5, "so100", [], {}, Foreign, pytest])
def test_plain_value_is_refused_as_a_robot(value: object) -> None:
    for make in (adapt, adapt_world, behind_contract):
        with pytest.raises(ValidationError, match="robot must be an object with start_task"):
            make(value)


def only(*verbs: str) -> Any:
    """A double with these verbs, which succeed."""
    return SimpleNamespace(**{verb: lambda *_, **__: success("Done.", task_status="idle") for verb in verbs})


PARTIAL = {
    "nothing": (object(), False),
    "a name": (SimpleNamespace(tool_name_str="x"), False),
    "start_task": (only("start_task"), False),
    "stop_task": (only("stop_task"), True),
    "a mock": (MagicMock(), None),
    "start_policy": (only("list_robots", "start_policy"), False),
}


@pytest.mark.parametrize(("robot", "stopped"), PARTIAL.values(), ids=PARTIAL)
@pytest.mark.parametrize("make", [adapt, adapt_world], ids=["robot", "world"])
def test_partial_robot_is_stopped_or_says_that_it_was_not(make: Any, robot: Any, stopped: bool | None) -> None:
    assert make(robot).halt("test").stopped is stopped


@pytest.mark.parametrize("verb", ["start_task", "get_task_status", "get_features"])
def test_verb_that_a_robot_lacks_is_refused_by_name(verb: str) -> None:
    arguments = ("wave",) if verb == "start_task" else ()
    answer = getattr(adapt(SimpleNamespace(tool_name_str="x")), verb)(*arguments)
    assert answer["status"] == "error"
    assert answer["reason"] == f"x exposes no {verb}."


def test_robot_without_a_way_to_halt_names_it_in_every_stop() -> None:
    robot = adapt(SimpleNamespace(tool_name_str="x", stop_teleoperate=lambda: success("Ended.")))
    verdict = robot.halt()
    assert "neither stop_task nor halt" in verdict.not_stopped["x"]
    assert verdict.halted == ("teleoperation",)
    assert robot.stop_task()["stopped"] is False


def test_robot_without_a_way_to_halt_is_warned_of_once(caplog: pytest.LogCaptureFixture) -> None:
    double = only("start_task")
    for name in ("arm-1", "arm-2"):
        warn_endless(adapt(double), name)
    warn_endless(adapt(only("stop_task")), "arm-3")
    (warning,) = caplog.messages
    assert warning.startswith("arm-1 cannot be stopped: it exposes neither stop_task nor halt")


def test_stop_that_comes_later_counts() -> None:
    double = only("start_task")
    robot = adapt(double)
    double.stop_task = lambda: success("Stopped.")
    assert robot.halt().stopped is True
    assert "stop_task" not in lacks(robot)


def test_double_with_every_attribute_is_wrapped() -> None:
    double = MagicMock()
    assert isinstance(adapt(double).gate, MotionGate)
    assert not holds_robots(double)
    assert holds_robots(adapt_world(double))
    assert adapt_world(double).list_robots() == []


class World:
    """A simulation of others', with two robots."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def list_robots(self) -> list[str]:
        return ["left", "right"]

    def start_policy(self, robot_name: str, **policy: Any) -> Envelope:
        self.calls.append(f"start {robot_name} {policy['policy_provider']}")
        return success("Started.")

    def stop_policy(self, robot_name: str) -> Envelope:
        self.calls.append(f"stop {robot_name}")
        return success("Stopped.") if robot_name == "left" else error("it hangs")


def test_world_of_others_is_stopped_robot_by_robot() -> None:
    foreign = World()
    world = behind_contract(foreign)
    assert holds_robots(world)
    verdict = world.halt()
    assert (verdict.halted, list(verdict.not_stopped)) == (("left",), ["right"])
    assert world.start_policy("left", "wave")["status"] == "success"
    assert foreign.calls == ["stop left", "stop right", "start left mock"]
    for lacking in (world.get_state(), world.get_features(), world.step(), world.reset()):
        assert "simulation exposes no " in lacking["reason"]


def test_robot_that_was_started_is_stopped_before_its_world_is_read() -> None:
    class Read(World):
        def list_robots(self) -> list[str]:
            self.calls.append("list")
            return ["left"]

    foreign = Read()
    world = adapt_world(foreign)
    world.start_policy("left", "wave")
    world.start_policy("gone", "wave")
    foreign.calls.clear()
    assert world.halt().halted == ("left",)
    assert foreign.calls == ["stop left", "stop gone", "list"]
    foreign.calls.clear()
    assert world.halt().stopped is True
    assert foreign.calls == ["stop left", "list"]


def test_world_whose_robots_cannot_be_listed_did_not_stop() -> None:
    class Torn(World):
        def list_robots(self) -> list[str]:
            raise RuntimeError("torn down")

    verdict = adapt_world(Torn()).halt()
    assert "torn down" in verdict.not_stopped["simulation"]


@pytest.mark.parametrize("listed", [[{"name": "left"}], {"robots": ["left"]}, "left", None, MagicMock()])
def test_world_whose_list_of_robots_is_not_read_did_not_stop(listed: Any) -> None:
    class Odd(World):
        def list_robots(self) -> Any:
            return listed

        def stop_policy(self, robot_name: str) -> Envelope:
            return error("it goes on")

    world = adapt_world(Odd())
    assert "could not be listed" in world.halt().not_stopped["simulation"]
    world.start_policy("left", "wave")
    assert set(world.halt().not_stopped) == {"left", "simulation"}


def test_robot_that_hangs_leaves_the_others_of_its_world_their_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.5")
    released = threading.Event()

    class Stuck(World):
        def stop_policy(self, robot_name: str) -> Envelope:
            self.calls.append(robot_name)
            if robot_name == "left":
                released.wait(10)
            return success("Stopped.")

    foreign = Stuck()
    world = adapt_world(foreign)
    try:
        for times in (1, 2):
            verdict = world.halt()
            assert (verdict.halted, list(verdict.not_stopped)) == (("right",), ["left"])
            assert foreign.calls.count("right") == times
    finally:
        released.set()


def test_robots_that_a_world_listed_are_stopped_where_its_list_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.5")
    hangs, released = threading.Event(), threading.Event()

    class Slow(World):
        def list_robots(self) -> list[str]:
            if hangs.is_set():
                released.wait(10)
            return super().list_robots()

    foreign = Slow()
    world = adapt_world(foreign)
    assert world.list_robots() == ["left", "right"]
    hangs.set()
    try:
        for times in (1, 2):
            assert world.halt().stopped is False
            assert sorted(foreign.calls) == sorted(["stop left", "stop right"] * times)
    finally:
        released.set()


@pytest.mark.parametrize(("looks", "stopped"), [(0, True), (2, True), (10**6, False)])
def test_robot_that_its_world_goes_on_listing_as_running_did_not_stop(
    monkeypatch: pytest.MonkeyPatch, looks: int, stopped: bool
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.5")

    class Listing(World):
        left = 0

        def list_policies_running(self) -> list[dict[str, Any]]:
            self.left -= 1
            return [{"robot": "left"}] if self.left >= 0 else []

        def stop_policy(self, robot_name: str) -> Envelope:
            self.left = looks
            return success("Stopped.")

    world = adapt_world(Listing())
    for stop in (world, robot_stop(world, "left")):
        verdict = stop.halt()
        assert verdict.stopped is stopped
        assert ("lists it as running" in verdict.not_stopped.get("left", "")) is not stopped


def test_locked_world_of_others_is_never_asked_to_move() -> None:
    foreign = World()
    world = adapt_world(foreign)
    world.gate.attach(Locked())
    assert "locked" in world.start_policy("left", "wave")["reason"]
    assert foreign.calls == []


def test_halt_while_a_world_of_others_starts_stops_it_again() -> None:
    class Slow(World):
        def start_policy(self, robot_name: str, **policy: Any) -> Envelope:
            world.halt("meanwhile")
            return super().start_policy(robot_name, **policy)

    foreign = Slow()
    world = adapt_world(foreign)
    assert "was halted meanwhile, and DID NOT STOP AGAIN" in world.start_policy("left", "wave")["reason"]
    assert foreign.calls[-2:] == ["stop left", "stop right"]


def test_a_locked_foreign_robot_is_never_asked_to_move() -> None:
    foreign = Foreign()
    robot = adapt(foreign)
    robot.gate.attach(Locked())
    assert "locked" in robot.start_task("wave")["reason"]
    assert foreign.calls == []
    assert robot.stop_task()["status"] == "success"


def test_halt_voids_permits_and_stops_task_and_teleoperation() -> None:
    class Led(Foreign):
        def stop_teleoperate(self) -> Envelope:
            self.calls.append("stop teleoperation")
            return success("Stopped.")

    foreign = Led()
    foreign.stop_answer = RuntimeError("bus")
    robot = adapt(foreign)
    permit = robot.gate.permit("x")
    verdict = robot.halt("test")
    assert not permit.valid
    assert foreign.calls == ["stop", "stop teleoperation"]
    assert verdict.stopped is False
    assert verdict.halted == ("teleoperation",)


def test_own_halt_of_a_foreign_robot_is_called_and_graded() -> None:
    class Own(Foreign):
        tool_name_str = "own"

        def halt(self, reason: str = "") -> Any:
            return StopVerdict(unknown={"base": reason})

    robot = adapt(Own())
    verdict = robot.halt("test")
    assert verdict.stopped is None
    assert "own" in verdict.unknown


def telling(status: object, answer: object) -> AdaptedRobot:
    """A foreign robot that answers so to a stop, and goes on telling this status."""
    foreign = Foreign()
    foreign.stop_answer = answer
    foreign.get_task_status = lambda: status  # type: ignore[method-assign,assignment,return-value]
    return AdaptedRobot(foreign)


IDLE, RUNS = {"task_status": "idle"}, {"task_status": "Running"}


@pytest.mark.parametrize(
    ("status", "answer", "stopped"),
    [
        (RUNS, None, False),
        (RUNS, success("Stopped.", stopped=True), False),
        (RUNS, {"odd": 1}, False),
        (success("", task_status="running"), None, False),
        ({"status": "success", "content": [{"json": RUNS}]}, None, False),
        (IDLE, None, True),
        ({"content": [{"json": {"task_status": "STOPPED"}}]}, None, True),
        (IDLE, success("Stopped."), True),
        (IDLE, {"odd": 1}, None),
        (IDLE, "stopped", None),
        (IDLE, error("no"), False),
        (None, None, None),
        (None, success("Stopped.", stopped=True), None),
        ("idle", success("Stopped."), None),
        ({"task_status": "perhaps"}, success("Stopped."), None),
        ({"task_status": None}, success("Stopped."), None),
    ],
)
@pytest.mark.parametrize("verb", ["stop_task", "halt"])
def test_a_stop_counts_as_what_the_status_after_it_confirms(
    monkeypatch: pytest.MonkeyPatch, verb: str, status: object, answer: object, stopped: bool | None
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    assert grade(getattr(telling(status, answer), verb)()).stopped is stopped


def test_a_robot_that_takes_a_moment_to_stop_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "40")
    words = iter(["running", "running", "running", "stopped"])
    foreign = Foreign()
    foreign.stop_answer = None
    foreign.get_task_status = lambda: success("", task_status=next(words))  # type: ignore[method-assign]
    assert adapt(foreign).halt().halted == ("task",)


def test_a_status_that_raises_after_a_stop_is_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    foreign = Foreign()

    def lost() -> Envelope:
        raise ConnectionError("no status packet")

    foreign.get_task_status = lost  # type: ignore[method-assign]
    verdict = adapt(foreign).halt()
    assert verdict.stopped is None
    assert "idle" in verdict.unknown["task"], "it says what was expected"


def test_own_halt_that_takes_no_reason_is_called_without() -> None:
    class Short(Foreign):
        def halt(self) -> Any:
            return self.stop_task()

    class ShortWorld(World):
        def halt(self) -> Any:
            return success("Stopped.")

    short = Short()
    assert adapt(short).halt("run ended").stopped is True
    assert short.calls == ["stop"]
    assert adapt_world(ShortWorld()).halt("run ended").halted == ("simulation",)


def test_teleoperation_that_answers_none_to_its_stop_is_unknown() -> None:
    foreign = Foreign()
    foreign.stop_teleoperate = lambda: None  # type: ignore[attr-defined]
    verdict = adapt(foreign).halt()
    assert (verdict.halted, list(verdict.unknown)) == (("task",), ["teleoperation"])


def test_an_own_halt_is_checked_by_the_status_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    robot = telling(RUNS, None)
    robot.wrapped.halt = lambda reason: StopVerdict(("arm",))
    assert robot.halt().stopped is False


@pytest.mark.parametrize("answer", [success("Stopped.", stopped=False), error("no"), {"running": True}])
def test_a_stop_that_denies_itself_is_not_stopped(answer: Any) -> None:
    foreign = Foreign()
    foreign.stop_answer = answer
    assert adapt(foreign).halt().stopped is False


def test_a_gate_of_its_own_is_used() -> None:
    foreign = Foreign()
    foreign.gate = MotionGate()  # type: ignore[attr-defined]
    assert adapt(foreign).gate is foreign.gate  # type: ignore[attr-defined]
    foreign.gate = "no gate"  # type: ignore[attr-defined]
    assert isinstance(AdaptedRobot(foreign).gate, MotionGate)


def test_a_halt_while_a_foreign_robot_starts_stops_it_again() -> None:
    class Slow(Foreign):
        def start_task(self, instruction: str, **options: Any) -> Envelope:
            assert robot.halt("meanwhile").stopped
            return super().start_task(instruction, **options)

    foreign = Slow()
    robot = adapt(foreign)
    answer = robot.start_task("wave")
    assert answer["status"] == "error"
    assert "halted while it started, and was stopped again" in answer["reason"]
    assert foreign.calls[-1] == "stop"


def test_two_wrappers_of_one_robot_share_its_gate_so_that_a_stop_on_one_network_voids_the_other() -> None:
    foreign = Foreign()
    one, two = AdaptedRobot(foreign), AdaptedRobot(foreign)
    permit = two.gate.permit("start_task")
    one.halt("stop")
    assert not permit.valid
    assert AdaptedRobot(Foreign()).gate is not one.gate


def by_keyword(*, request: MotionRequest | None = None) -> Any:
    return request is not None


class Proxy:
    """A stranger's method that stands for one elsewhere, and has every attribute."""

    def __call__(self) -> bool:
        return False

    def __getattr__(self, name: str) -> Proxy:
        return self


@pytest.mark.parametrize(
    ("method", "taken"),
    [
        (by_keyword, True),
        (lambda *, request=None: request is not None, False),
        (lambda request=None: request is not None, False),
        (lambda **options: "request" in options, False),
        (answered(by_keyword), True),
        (dict, {}),
        (Proxy(), False),
    ],
    ids=[
        "by keyword",
        "a stranger's keyword",
        "a stranger's own request",
        "any option",
        "decorated",
        "no code",
        "proxy",
    ],
)
def test_request_is_given_to_a_method_that_takes_it_by_keyword_alone(method: Callable[..., Any], taken: object) -> None:
    request = MotionGate().request()
    assert for_request(request, method)() == taken
    assert for_request(None, method)() == (taken if taken == {} else False)


def test_robot_that_is_put_away_refuses_motion_until_that_is_taken_back() -> None:
    foreign = Foreign()
    free = put_away(foreign)
    assert "taken off its network" in AdaptedRobot(foreign).start_task("wave")["reason"]
    free()
    assert AdaptedRobot(foreign).gate.permit("start_task").valid


def test_joints_of_a_foreign_robot_are_read_by_the_given_reader() -> None:
    class Native(Foreign):
        def get_observation(self) -> dict[str, Any]:
            return {"pan.pos": 4.0, "front": [[0]]}

    class Wrapper(Foreign):
        def __init__(self) -> None:
            super().__init__()
            self.robot = BlindDevice()

    state = adapt(Native(), read_joints).get_state()
    assert (state["status"], state["joints"]) == ("success", {"pan.pos": 4.0})
    assert state["task"] == {"task_status": "idle"}
    assert adapt(Wrapper(), read_joints).get_state()["joints"]["pan.pos"] == 10.0, "whose camera fails"
    assert adapt(Foreign(), read_joints).get_state()["joints"] == {}


def test_a_foreign_robot_is_read_in_its_turn_on_the_bus() -> None:
    class Native(Foreign):
        held: bool | None = None

        def get_observation(self) -> dict[str, Any]:
            free = threading.Thread(target=self.look)
            free.start()
            free.join()
            return {}

        def look(self) -> None:
            self.held = not bus_lock(self).acquire(blocking=False)

    native = Native()
    adapt(native, read_joints).get_state()
    assert native.held is True


def test_unreadable_joints_are_reported_beside_the_task() -> None:
    class Dead(Foreign):
        def get_observation(self) -> dict[str, Any]:
            raise ConnectionError("no status packet")

    state = adapt(Dead(), read_joints).get_state()
    assert "no status packet" in state["joints_error"]
    assert (state["joints"], state["task"]["task_status"]) == ({}, "idle")


def test_foreign_robot_with_its_own_state_is_not_read() -> None:
    class Telling(Foreign):
        def get_state(self) -> Envelope:
            return success("Told.", joints={"a": 1.0})

    assert adapt(Telling(), read_joints).get_state()["joints"] == {"a": 1.0}


class Driven(Foreign):
    """Drives its own bus, without our lock on it."""

    def __init__(self) -> None:
        super().__init__()
        self.status = "idle"
        self.reads = 0
        self.during: list[Envelope] = []
        self.network: TaskRobot | None = None

    def get_task_status(self) -> Envelope:
        return success("Told.", task_status=self.status)

    def get_observation(self) -> dict[str, Any]:
        self.reads += 1
        return {"pan.pos": float(self.reads)}

    def start_task(self, instruction: str, **options: Any) -> Envelope:
        self._look()
        self.status = "running"
        return super().start_task(instruction, **options)

    def stop_task(self) -> Any:
        self.status = "stopped"
        self._look()
        return super().stop_task()

    def _look(self) -> None:
        assert self.network is not None
        self.during.append(self.network.get_state())


@pytest.mark.parametrize("stop", ["stop_task", "halt"])
def test_a_foreign_robot_is_not_read_on_any_network_while_it_starts_runs_or_stops(stop: str) -> None:
    foreign = Driven()
    robot, foreign.network = adapt(foreign, read_joints), adapt(foreign, read_joints)
    assert robot.get_state()["joints"] == {"pan.pos": 1.0}
    robot.start_task("wave")
    running = robot.get_state()
    getattr(robot, stop)()
    assert foreign.reads == 1
    assert "its task runs" in running["joints_error"]
    assert all("started or stopped" in each["joints_error"] for each in foreign.during)
    for state in (running, *foreign.during):
        assert state["joints"] == {"pan.pos": 1.0}, "those of the last read"
        assert state["joints_age_s"] >= 0
    after = robot.get_state()
    assert after["joints"] == {"pan.pos": 2.0}
    assert "joints_error" not in after


def test_a_read_that_waited_for_another_looks_anew_at_what_the_robot_does() -> None:
    foreign, entered, free = Driven(), threading.Event(), threading.Event()

    def slow(robot: Any) -> dict[str, float]:
        entered.set()
        assert free.wait(60)
        return read_joints(robot)

    one, two = adapt(foreign, slow), adapt(foreign, read_joints)
    states: list[Envelope] = []
    threads = [threading.Thread(target=lambda each=each: states.append(each.get_state())) for each in (one, two)]
    threads[0].start()
    assert entered.wait(20)
    threads[1].start()
    foreign.status = "running"
    free.set()
    for thread in threads:
        thread.join(20)
    assert foreign.reads == 1
    assert sorted("joints_error" in each for each in states) == [False, True]


def test_a_foreign_robot_without_joints_has_none_that_could_be_old() -> None:
    foreign = Foreign()
    robot = adapt(foreign, read_joints)
    assert robot.get_state()["joints"] == {}
    foreign.get_task_status = lambda: success("Told.", task_status="running")  # type: ignore[method-assign]
    assert "joints_error" not in robot.get_state()


@pytest.mark.parametrize("hangs", ["get_task_status", "stop_task"])
def test_halt_answers_while_a_method_of_a_stranger_hangs(monkeypatch: pytest.MonkeyPatch, hangs: str) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.2")
    robot, released = Foreign(), threading.Event()
    monkeypatch.setattr(robot, hangs, released.wait)
    verdicts: list[StopVerdict] = []
    halting = threading.Thread(target=lambda: verdicts.append(adapt(robot).halt()), daemon=True)
    halting.start()
    try:
        halting.join(20)
        assert [verdict.stopped for verdict in verdicts] == [False]
    finally:
        released.set()
