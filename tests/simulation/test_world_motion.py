"""Motion in a simulated world: rollouts, leaders, single actions and stops."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest
from fixtures.bodies import ScriptedPolicy
from fixtures.leaders import ScriptedLeader
from fixtures.planes import own_plane
from fixtures.waiting import eventually

from strands_robots.contract import RolloutEvent
from strands_robots.envelope import Envelope, error
from strands_robots.policies import task_engine
from strands_robots.safety.gate import MotionRequest, Permit
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.safety.stopping import Outcome, StopVerdict, grade, read_verdict
from strands_robots.simulation import Simulation
from strands_robots.simulation import world as world_module

pytestmark = pytest.mark.usefixtures("patient_halts")


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation()
    simulation.add_robot("left", "so100")
    simulation.add_robot("right", "so101")
    yield simulation
    simulation.cleanup()


@pytest.fixture
def events(world: Simulation) -> list[RolloutEvent]:
    seen: list[RolloutEvent] = []
    world.subscribe(seen.append)
    return seen


def busy(world: Simulation) -> list[str]:
    return sorted(row["robot"] for row in world.list_policies_running())


class Stuck:
    """A policy whose third step blocks until ``let_go`` is set."""

    uses_cameras = False

    def __init__(self) -> None:
        self.inside = threading.Event()
        self.let_go = threading.Event()
        self._calls = 0

    def reset(self, instruction: str, ranges: Mapping[str, tuple[float, float]]) -> None:
        """Nothing to load."""

    def act(self, observation: Mapping[str, Any]) -> dict[str, float]:
        self._calls += 1
        if self._calls == 3:
            self.inside.set()
            self.let_go.wait(60)
        return {"shoulder_pan": 1.5}

    def interrupt(self) -> None:
        """Do nothing: this policy ignores the stop."""

    def close(self) -> None:
        """Nothing to free."""


class Loading(Stuck):
    """A policy that loads until ``let_go`` is set."""

    def reset(self, instruction: str, ranges: Mapping[str, tuple[float, float]]) -> None:
        self.inside.set()
        assert self.let_go.wait(60)


class Failing(Stuck):
    def act(self, observation: Mapping[str, Any]) -> dict[str, float]:
        raise ZeroDivisionError("no idea")


@pytest.fixture
def stuck(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stuck]:
    policy = Stuck()
    monkeypatch.setattr(task_engine, "create_policy", lambda provider, **options: policy)
    yield policy
    policy.let_go.set()


def test_each_robot_runs_its_own_policy(world: Simulation, events: list[RolloutEvent]) -> None:
    assert world.start_policy("left", "wave")["status"] == "success"
    assert world.start_policy("right", "nod")["status"] == "success"
    eventually(lambda: {e.robot for e in events if e.step > 5} == {"left", "right"})
    assert busy(world) == ["left", "right"]
    assert set(world.get_state()["running_policies"]) == {"left", "right"}
    assert world.stop_policy("left")["stopped"] is True
    assert busy(world) == ["right"]
    step = world.list_policies_running()[0]["step"]
    eventually(lambda: world.list_policies_running()[0]["step"] > step + 5, what="the other robot continues")


def test_a_rollout_moves_only_its_robot(world: Simulation, events: list[RolloutEvent]) -> None:
    still = world.get_observation("right")
    start = world.get_observation("left")
    world.run_policy("left", "wave", duration=60.0, n_steps=30)
    assert max(abs(world.get_observation("left")[k] - start[k]) for k in start) > 0.01
    assert world.get_observation("right") == pytest.approx(still, abs=0.004)
    assert [e.kind for e in events][:1] + [e.kind for e in events][-1:] == ["started", "finished"]


def test_run_policy_waits_and_reports(world: Simulation) -> None:
    began = time.monotonic()
    answer = world.run_policy("left", "wave", duration=0.3)
    assert time.monotonic() - began >= 0.3
    assert (answer["state"], answer["status"]) == ("completed", "success")
    assert answer["step"] >= 1


def test_the_caller_sets_rate_and_steps_of_a_rollout(world: Simulation) -> None:
    answer = world.run_policy("left", "wave", duration=60.0, control_frequency=25, n_steps=4)
    assert (answer["state"], answer["step"]) == ("completed", 4)
    refused = world.start_policy("left", "wave", control_frequency=1000)
    assert refused["status"] == "error"
    assert "control_frequency" in refused["reason"]


def test_reads_do_not_wait_for_a_slow_policy(world: Simulation, stuck: Stuck) -> None:
    world.start_policy("left", "think")
    assert stuck.inside.wait(20)
    for _ in range(100):
        assert world.get_state()["running_policies"]["left"]["step"] == 2
        world.get_observation("left")
    assert not stuck.let_go.is_set()


@pytest.mark.parametrize(
    ("change", "arguments"),
    [("remove_robot", ("right",)), ("add_robot", ("x", "so100")), ("add_object", ("cube",)), ("create_world", ())],
)
def test_changing_the_world_is_refused_while_a_rollout_runs(
    world: Simulation, change: str, arguments: tuple[Any, ...]
) -> None:
    world.start_policy("left", "wave")
    answer = getattr(world, change)(*arguments)
    assert f"{change} is refused while something moves: policy on left" in answer["reason"]
    assert world.list_robots() == ["left", "right"]
    world.stop_policy("left")
    assert getattr(world, change)(*arguments)["status"] == "success"


def test_second_policy_on_a_robot_is_refused(world: Simulation) -> None:
    world.start_policy("left", "wave")
    assert "left is driven by the policy mock ('wave')" in world.start_policy("left", "nod")["reason"]


def test_halt_stops_every_rollout_and_nothing_is_written_afterwards(
    world: Simulation, events: list[RolloutEvent]
) -> None:
    world.start_policy("left", "wave")
    world.start_policy("right", "nod")
    eventually(lambda: len([e for e in events if e.kind == "step"]) > 20)
    verdict = world.halt("test")
    held = world.body("left").targets, world.body("right").targets
    assert verdict.stopped is True
    assert sorted(verdict.halted) == ["left", "right"]
    time.sleep(0.2)
    assert held == (world.body("left").targets, world.body("right").targets)
    assert busy(world) == []


def test_halt_names_a_policy_that_does_not_return_and_its_action_is_not_written(
    world: Simulation, stuck: Stuck, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    world.start_policy("left", "think")
    assert stuck.inside.wait(20)
    verdict = world.halt("test")
    assert verdict.stopped is False
    assert "has not returned" in verdict.not_stopped["left"]
    held = world.body("left").targets
    stuck.let_go.set()
    eventually(lambda: not busy(world))
    assert held == world.body("left").targets


def test_emergency_stop_names_a_policy_whose_loop_ended_before_the_halt_ran(world: Simulation) -> None:
    world.start_policy("left", "wave", duration=300)
    eventually(lambda: world.list_policies_running()[0]["step"] > 2)
    halt = world.halt

    def late(reason: str = "") -> StopVerdict:
        eventually(lambda: not busy(world))
        return halt(reason)

    world.halt = late  # type: ignore[method-assign]
    with own_plane(20.0) as plane:
        plane.register("world", world)
        report = plane.emergency_stop(StopOrder(new_epoch(), "safety-1"))["world"]
        assert (report.stopped, report.verdict.halted) == (True, ("left",))
        plane.clear_local("ann")
        assert plane.emergency_stop(StopOrder(new_epoch(), "safety-1"))["world"].verdict.halted == ()


@pytest.mark.parametrize("stop", ["halt", "stop_policy"])
def test_a_stop_while_a_policy_loads_says_stopped_and_it_never_moves_the_robot(
    world: Simulation, monkeypatch: pytest.MonkeyPatch, stop: str
) -> None:
    loading = Loading()
    monkeypatch.setattr(task_engine, "create_policy", lambda *_, **__: loading)
    world.start_policy("left", "think")
    assert loading.inside.wait(20)
    answer = world.halt() if stop == "halt" else world.stop_policy("left")
    assert (answer.stopped if isinstance(answer, StopVerdict) else answer["stopped"]) is True
    assert not loading.let_go.is_set()
    loading.let_go.set()
    eventually(lambda: not busy(world))
    assert abs(world.body("left").targets["shoulder_pan"]) < 0.1, "it would go to 1.5"


def test_later_action_of_a_stuck_policy_is_not_written_after_stop_policy(
    world: Simulation, stuck: Stuck, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(world_module, "STOP_JOIN_S", 0.1)
    world.start_policy("left", "think")
    assert stuck.inside.wait(20)
    answer = world.stop_policy("left")
    assert answer["stopped"] is False
    assert grade(answer) is Outcome.REFUSED
    where = world.get_observation("left")["shoulder_pan"]
    stuck.let_go.set()
    eventually(lambda: not busy(world))
    world.step(300)
    assert world.get_observation("left")["shoulder_pan"] == pytest.approx(where, abs=0.2)


def test_policy_that_raises_when_interrupted_is_stopped(
    world: Simulation, stuck: Stuck, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt() -> None:
        stuck.let_go.set()
        raise OSError("no")

    monkeypatch.setattr(stuck, "interrupt", interrupt)
    world.start_policy("left", "think")
    assert stuck.inside.wait(20)
    verdict = world.halt("test")
    assert (verdict.stopped, verdict.halted) == (True, ("left",))


def test_failing_policy_ends_in_error(
    world: Simulation, events: list[RolloutEvent], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(task_engine, "create_policy", lambda provider, **options: Failing())
    answer = world.run_policy("left", "wave", duration=5)
    assert answer["status"] == "error"
    assert "ZeroDivisionError: no idea" in answer["reason"]
    assert (events[-1].kind, events[-1].state) == ("finished", "error")
    assert busy(world) == []


def test_reset_stops_rollouts_first(world: Simulation) -> None:
    start = world.get_observation("left")
    world.start_policy("left", "wave")
    eventually(lambda: world.list_policies_running()[0]["step"] > 5)
    assert world.reset()["status"] == "success"
    assert busy(world) == []
    assert world.get_observation("left") == pytest.approx(start, abs=0.004)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"robot_name": "nobody"}, "robot_name"),
        ({"instruction": ""}, "instruction"),
        ({"instruction": "a\x00b"}, "instruction"),
        ({"duration": 0}, "duration"),
        ({"duration": float("inf")}, "duration"),
        ({"duration": True}, "duration"),
        ({"policy_provider": "mok"}, "policy_provider"),
        ({"policy_port": -1}, "policy_port"),
    ],
)
def test_bad_rollout_argument_is_refused_by_name(world: Simulation, change: dict[str, Any], named: str) -> None:
    answer = world.start_policy(**{"robot_name": "left", "instruction": "wave", **change})
    assert answer["status"] == "error"
    assert named in answer["reason"]
    assert busy(world) == []


def test_locked_world_refuses_start_policy(world: Simulation) -> None:
    class Locked:
        def refusal(self, verb: str) -> Envelope | None:
            return error(f"{verb} is refused: locked.")

    world.gate.attach(Locked())
    assert world.start_policy("left", "wave")["reason"] == "start_policy is refused: locked."
    assert busy(world) == []


def test_policy_that_was_halted_while_loading_does_not_start(
    world: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow(provider: str, **options: Any) -> Stuck:
        assert world.halt("meanwhile").stopped
        return Stuck()

    monkeypatch.setattr(task_engine, "create_policy", slow)
    assert "halted while its policy was made ready" in world.start_policy("left", "wave")["reason"]
    assert busy(world) == []


def test_stopping_an_idle_robot_succeeds(world: Simulation) -> None:
    assert world.stop_policy("left")["stopped"] is True
    assert world.halt("test").stopped is True
    assert "robot_name" in world.stop_policy("nobody")["reason"]


def test_cleanup_ends_rollouts_and_threads(world: Simulation) -> None:
    world.start_policy("left", "wave")
    world.start_policy("right", "nod")
    assert [t.name for t in threading.enumerate() if t.name.startswith("rollout")]
    assert world.cleanup()["status"] == "success"
    assert not [t.name for t in threading.enumerate() if t.name.startswith(("rollout", "simulation"))]
    assert "cleaned up" in world.start_policy("left", "wave")["reason"]


class Script:
    """A scripted leader: it swings one joint as time goes by."""

    def __init__(self) -> None:
        self.began = time.monotonic()

    def get_action(self) -> dict[str, float]:
        return {"shoulder_pan": 0.5 * min(1.0, time.monotonic() - self.began)}


def test_halt_ends_a_teleoperation_and_a_rollout(world: Simulation) -> None:
    assert world.attach_teleop(Script(), "script", robot_name="right")["status"] == "success"
    assert world.teleoperate("script")["status"] == "success"
    eventually(lambda: world.get_observation("right")["shoulder_pan"] > 0.1, what="the robot follows")
    assert "right is driven by script" in world.start_policy("right", "nod")["reason"]
    assert world.start_policy("left", "wave")["status"] == "success"
    assert "script leading right" in world.remove_robot("right")["reason"]
    verdict = world.halt("test")
    assert verdict.stopped is True
    assert sorted(verdict.halted) == ["left", "teleoperation script"]
    held = world.body("right").targets
    time.sleep(0.1)
    assert world.body("right").targets == held


def test_leader_is_refused_while_a_policy_drives_the_robot(world: Simulation) -> None:
    world.attach_teleop(Script(), "script", robot_name="left")
    world.start_policy("left", "wave")
    assert "left is driven by the policy" in world.teleoperate("script")["reason"]
    world.stop_policy("left")
    assert world.teleoperate("script")["status"] == "success"
    assert world.stop_teleoperate("script")["stopped"] is True
    world.cleanup()
    assert not [t.name for t in threading.enumerate() if t.name.startswith(("rollout", "simulation"))]


def test_send_action_is_refused_while_a_policy_drives_the_robot(world: Simulation) -> None:
    world.start_policy("left", "wave")
    assert "left is driven by the policy" in world.send_action({"gripper": 1.0}, "left")["reason"]
    assert world.send_action({"gripper": 1.0}, "right")["status"] == "success"


def test_cleaned_up_world_refuses_teleoperate(world: Simulation) -> None:
    world.attach_teleop(Script(), "script")
    world.cleanup()
    assert "cleaned up" in world.teleoperate("script")["reason"]


def test_concurrent_verbs_raise_nothing_and_end(world: Simulation) -> None:
    world.attach_teleop(Script(), "script", robot_name="right")
    jobs: list[Callable[[], object]] = [
        lambda: world.start_policy("left", "wave", duration=0.05),
        lambda: world.start_policy("right", "nod", duration=5),
        lambda: world.stop_policy("right"),
        lambda: world.teleoperate("script", duration=0.05),
        lambda: world.halt("test"),
        world.reset,
        lambda: world.add_robot("extra", "rover"),
        lambda: world.remove_robot("extra"),
        lambda: world.send_action({"gripper": 1.0}, "left"),
        lambda: world.step(20),
        lambda: [world.get_state(), world.get_observation("left"), world.get_features()],
    ]
    calm: list[bool] = []
    until = time.monotonic() + 1.5

    def repeat(job: Callable[[], object]) -> None:
        while time.monotonic() < until:
            job()
            time.sleep(0.002)
        calm.append(True)

    threads = [threading.Thread(target=repeat, args=(job,)) for job in jobs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not any(thread.is_alive() for thread in threads)
    assert len(calm) == len(jobs)
    assert world.cleanup()["status"] == "success"
    assert not [t.name for t in threading.enumerate() if t.name.startswith(("rollout", "simulation"))]


def swinging() -> ScriptedLeader:
    return ScriptedLeader({"shoulder_pan": (0.0, 0.5, 1.0)})


def test_stop_policy_stops_only_the_leader_of_that_robot(world: Simulation) -> None:
    for name in ("left", "right"):
        world.attach_teleop(swinging(), f"leader-{name}", robot_name=name)
        assert world.teleoperate(f"leader-{name}")["status"] == "success"
    answer = world.stop_policy("left")
    assert answer["stopped"] is True
    assert list(world.teleoperating()) == ["leader-right"]
    held = world.body("left").targets
    eventually(lambda: world.teleoperating()["leader-right"].step_count > 20)
    assert world.body("left").targets == held


def test_stop_policy_voids_only_the_loading_policy_of_that_robot(
    world: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready, loading = threading.Event(), threading.Semaphore(0)

    def slow(provider: str, **options: Any) -> ScriptedPolicy:
        loading.release()
        assert ready.wait(60)
        return ScriptedPolicy([], always={"shoulder_pan": 0.5})

    monkeypatch.setattr(task_engine, "create_policy", slow)
    answers: dict[str, Any] = {}
    threads = [
        threading.Thread(target=lambda name=name: answers.update({name: world.start_policy(name, "wave")}))
        for name in ("left", "right")
    ]
    for thread in threads:
        thread.start()
    assert all(loading.acquire(timeout=20) for _ in threads)
    assert world.stop_policy("left")["stopped"] is True
    ready.set()
    for thread in threads:
        thread.join(20)
        assert not thread.is_alive()
    assert answers["left"]["status"] == "error"
    assert answers["right"]["status"] == "success"
    assert [row["robot"] for row in world.list_policies_running()] == ["right"]


def test_reset_that_waited_for_the_lock_is_refused_after_a_halt(
    world: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.step(1)  # by hand from here on
    world.send_action({"shoulder_pan": 0.5}, "left")
    world.step(500)
    before = world.get_observation("left")
    answers: list[Any] = []
    requested: list[str] = []
    permit = world.gate.permit

    def noted(verb: str, request: MotionRequest | None = None) -> Permit:
        granted = permit(verb, request)
        requested.append(verb)
        return granted

    monkeypatch.setattr(world.gate, "permit", noted)
    with world.starting:
        thread = threading.Thread(target=lambda: answers.append(world.reset()))
        thread.start()
        eventually(lambda: "reset" in requested)
        thread.join(0.1)
        assert thread.is_alive(), "it waits for the lock of a world that is being built"
        assert world.halt("test").stopped is True
    thread.join(20)
    assert answers[0]["status"] == "error"
    assert world.get_observation("left")["shoulder_pan"] == pytest.approx(before["shoulder_pan"], abs=0.05)


def test_halt_during_a_reset_leaves_the_world_unchanged(world: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    world.send_action({"shoulder_pan": 0.5}, "left")
    world.step(500)

    def halted_again(answer: Any) -> StopVerdict:
        monkeypatch.undo()
        assert world.halt("another caller").stopped is True
        return read_verdict(answer)

    monkeypatch.setattr(world_module, "read_verdict", halted_again)
    assert world.reset()["status"] == "error"
    assert world.get_observation("left")["shoulder_pan"] > 0.3


def test_locked_world_refuses_create_world(world: Simulation) -> None:
    class Locked:
        def refusal(self, verb: str) -> dict[str, Any]:
            return error(f"{verb} is locked.")

    world.gate.attach(Locked())
    assert world.create_world()["reason"] == "create_world is locked."
    assert world.list_robots() == ["left", "right"]


def test_stop_policy_freezes_only_the_robot_that_runs_to_a_single_target(world: Simulation) -> None:
    world.step(1)  # by hand from here on, so that no robot arrives before the stop
    for name in ("left", "right"):
        world.send_action({"shoulder_pan": 1.0}, name)
    world.step(50)
    answer = world.stop_policy("left")
    assert (answer["stopped"], answer["was_running"]) == (True, False)
    where = world.get_observation("left")["shoulder_pan"]
    assert world.body("left").targets["shoulder_pan"] == pytest.approx(where, abs=0.05)
    assert world.body("right").targets["shoulder_pan"] == 1.0
    world.step(1000)
    assert world.get_observation("right")["shoulder_pan"] > 0.8
    assert world.get_observation("left")["shoulder_pan"] < 0.8


def test_action_overtaken_by_a_stop_of_its_robot_sets_nothing(
    world: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped_meanwhile(robot: str) -> None:
        monkeypatch.undo()
        assert world.stop_policy("left")["stopped"] is True

    for robot, status in (("left", "error"), ("right", "success")):
        monkeypatch.setattr(world.tasks, "require_free", stopped_meanwhile)
        answer = world.send_action({"shoulder_pan": 1.0}, robot)
        assert answer["status"] == status
        assert (world.body(robot).targets["shoulder_pan"] == 1.0) is (status == "success")
