"""A robot with one body as a device, without a network."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from itertools import pairwise
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
from fixtures.driver_bench import DriverBench, drive
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import until
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from strands_robots.device_connect._compat import rpc
from strands_robots.device_connect.robot_driver import RobotDeviceDriver
from strands_robots.device_connect.telemetry import step_limiter
from strands_robots.envelope import error, success
from strands_robots.safety.authorization import Grants
from strands_robots.state_files import state_dir
from strands_robots.utils import ValidationError


async def test_execute_starts_a_task_and_returns_at_once(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        answer = await bench.call("execute", instruction="wave", duration=300.0)
        assert answer["status"] == "success"
        assert (await bench.call("getStatus"))["task_status"] == "running"
        robot.rollouts["toy"].duration = 0.0  # its time is over
        await bench.until(lambda: bench.of("taskComplete"))
        assert bench.of("taskStarted")[0]["instruction"] == "wave"
        assert bench.of("taskComplete")[0]["steps"] == robot.rollouts["toy"].steps


@pytest.mark.parametrize("caller", [None, "stranger", "Operator", "", 7, ["operator"], {"a": 1}])
async def test_only_an_allowed_caller_moves_hardware(robot: ToyRobot, caller: object) -> None:
    async with DriverBench(drive(robot)) as bench:
        answer = await bench.call("execute", caller, instruction="wave")
        assert answer["status"] == "error"
        assert "DEVICE_CONNECT_RPC_ALLOW" in answer["reason"]
        assert robot.rollouts == {}
        assert (await bench.call("getState", caller))["status"] == "success"


async def test_hardware_needs_the_operators_approval_besides(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot, approved=False)) as bench:
        answer = await bench.call("execute", instruction="wave")
        assert "operator approval" in answer["reason"]
        assert "execute@bench-1" in answer["reason"]


async def test_a_grant_is_spent_by_a_motion_and_not_by_a_refusal(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot, approved=False)) as bench:
        Grants(state_dir() / "grants").grant("execute", "bench-1")
        refused = [
            await bench.call("execute", "stranger", instruction="wave"),
            await bench.call("execute", instruction=""),
            await bench.call("execute", instruction="wave", policy_provider="no_such"),
        ]
        assert [answer["status"] for answer in refused] == ["error"] * 3
        assert (await bench.call("execute", instruction="wave", duration=0.1))["status"] == "success"
        await bench.call("stop")
        assert "operator approval" in (await bench.call("execute", instruction="wave"))["reason"]


async def test_a_locked_robot_refuses_and_still_answers(robot: ToyRobot) -> None:
    class Locked:
        def refusal(self, verb: str) -> Any:
            return error(f"{verb} refused: locked by epoch abc")

    robot.gate.attach(Locked())
    async with DriverBench(drive(robot)) as bench:
        assert "epoch abc" in (await bench.call("execute", instruction="wave"))["reason"]
        assert (await bench.call("getStatus"))["status"] == "success"
        assert (await bench.call("stop"))["stopped"] is True


async def test_a_closed_list_of_providers_closes_the_others(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot, STRANDS_MESH_POLICY_TYPE_ALLOW=("lerobot_local",))) as bench:
        answer = await bench.call("execute", instruction="wave")
        assert "STRANDS_MESH_POLICY_TYPE_ALLOW" in answer["reason"]


WRONG: dict[str, list[Any]] = {
    "instruction": ["", "  ", "x" * 2001, "a\nb", "\x00", "\ud800", None, 1, True, [], {}],
    "policy_provider": ["", "a b", "../x", "x" * 200, None, 1, []],
    "duration": [0, -1, 3600.1, math.nan, math.inf, -math.inf, True, "30", None, [], 10**400],
    "policy_port": [-1, 65536, 1.5, True, "80", None, math.nan, 10**100],
}


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, values in WRONG.items() for v in values])
async def test_an_argument_out_of_its_domain_is_refused_by_name(robot: ToyRobot, name: str, value: Any) -> None:
    async with DriverBench(drive(robot)) as bench:
        answer = await bench.call("execute", **{"instruction": "wave", name: value})
        assert answer["status"] == "error"
        assert name in answer["reason"]
        assert robot.rollouts == {}


SLOW_OR_SHARED = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]


@given(
    st.dictionaries(
        st.sampled_from(["instruction", "policy_provider", "duration", "policy_port", "self", "function_name", "x"]),
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=50),
            lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
            max_leaves=5,
        ),
    )
)
@hypothesis_settings(max_examples=100, deadline=None, suppress_health_check=SLOW_OR_SHARED)
def test_whatever_is_sent_the_answer_is_an_envelope(params: dict[str, Any]) -> None:
    toy = ToyRobot()

    async def call() -> dict[str, Any]:
        return await DriverBench(drive(toy)).call("execute", **params)

    answer = asyncio.run(call())
    toy.close()
    assert answer["status"] in ("success", "error")
    assert (answer["status"] == "success") == bool(toy.rollouts)


@pytest.mark.parametrize("params", [{}, {"instruction": "wave", "speed": 3}, {"self": 1, "instruction": "wave"}])
async def test_missing_and_extra_parameters_are_refused_by_name(robot: ToyRobot, params: dict[str, Any]) -> None:
    async with DriverBench(drive(robot)) as bench:
        answer = await bench.call("execute", **params)
        assert answer["reason"].startswith("execute takes instruction, policy_provider, duration, policy_port")


async def test_an_exception_is_an_envelope_without_its_detail(
    robot: ToyRobot, caplog: pytest.LogCaptureFixture
) -> None:
    def fail() -> None:
        raise OSError("secret path")

    robot.before["start_task"] = fail
    async with DriverBench(drive(robot)) as bench:
        answer = await bench.call("execute", instruction="wave")
    assert answer["status"] == "error"
    assert "secret" not in str(answer)
    assert "secret path" in caplog.text


async def test_an_answer_in_a_shape_nobody_knows_is_an_error(robot: ToyRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot, "start_task", lambda *_, **__: "ok")
    async with DriverBench(drive(robot)) as bench:
        assert (await bench.call("execute", instruction="wave"))["status"] == "error"


async def test_status_presence_and_heartbeat_tell_what_the_robot_does(robot: ToyRobot) -> None:
    driver = drive(robot)
    assert driver.status.availability == "idle"
    robot.start_task("wave", duration=300)
    await until(lambda: driver.status.availability == "busy")
    async with DriverBench(driver) as bench:
        await bench.until(lambda: bench.runtime.status.get("availability") == "busy")
        beat = driver.heartbeat()
        assert beat["busy_score"] == 1.0
        assert beat["state"]["instruction"] == "wave"
        await bench.call("stop")
        await bench.until(lambda: bench.runtime.status["availability"] == "idle")


async def test_a_robot_whose_state_cannot_be_read_says_so(robot: ToyRobot) -> None:
    def fail() -> None:
        raise OSError("bus is gone")

    robot.before["get_task_status"] = fail
    async with DriverBench(drive(robot)) as bench:
        await bench.until(lambda: "bus is gone" in str(bench.runtime.status.get("error_state")))
        robot.before.clear()
        await bench.until(lambda: bench.runtime.status["error_state"] is None)


async def test_every_step_of_a_50_hz_task_is_told_in_order(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        await bench.call("execute", instruction="wave", duration=1.0)
        await bench.until(lambda: bench.of("taskComplete"))
        steps = [event["step"] for event in bench.of("streamStep")]
        assert steps == list(range(1, robot.rollouts["toy"].steps + 1))


async def test_a_faster_loop_is_told_at_50_hz(robot: ToyRobot) -> None:
    robot.hz = 400
    async with DriverBench(drive(robot)) as bench:
        await bench.call("execute", instruction="wave", duration=1.0)
        await bench.until(lambda: bench.of("taskComplete"))
        clock = iter(robot.writes)
        limiter = step_limiter(50.0, lambda: next(clock))
        passing = sum(limiter.admit("toy") for _ in robot.writes)
        # Between a step's own time and its telling the machine may put a pause.
        assert abs(len(bench.of("streamStep")) - passing) <= 3


async def test_state_is_told_when_it_changes_at_most_ten_times_a_second(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        await bench.until(lambda: bench.of("stateUpdate"))
        began = time.monotonic()
        await bench.call("execute", instruction="wave", duration=300.0)
        await bench.until(lambda: sum(e["task_status"] == "running" for e in bench.of("stateUpdate")) >= 8)
        await bench.call("stop")
        await bench.until(lambda: bench.of("stateUpdate")[-1]["task_status"] == "stopped")
        told = bench.of("stateUpdate")
        assert len(told) <= (time.monotonic() - began) * 10.0 + 2
        assert all(one != other for one, other in pairwise(told))


async def test_idle_robot_is_told_once_and_read_on_one_worker(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        await bench.until(lambda: bench.of("stateUpdate"))
        looks: list[str] = []
        robot.before["get_task_status"] = lambda: looks.append(threading.current_thread().name)
        await bench.until(lambda: len(looks) >= 2)
        assert len(bench.of("stateUpdate")) == 1


async def test_task_that_a_foreign_robot_starts_by_itself_is_told() -> None:
    class Foreign:
        tool_name_str, status = "foreign", "idle"

        def start_task(self, instruction: str, **_: Any) -> Any:
            return success("started")

        def stop_task(self) -> Any:
            return success("stopped", stopped=True)

        def get_task_status(self) -> Any:
            return {"task_status": self.status}

        def get_features(self) -> Any:
            return success("none")

    foreign = Foreign()
    async with DriverBench(drive(foreign)) as bench:
        await bench.until(lambda: bench.of("stateUpdate"))
        foreign.status = "running"
        await bench.until(lambda: bench.of("taskStarted"))
        foreign.status = "completed"
        await bench.until(lambda: bench.of("taskComplete"))
        assert [each["task_status"] for each in bench.of("stateUpdate")] == ["idle", "running", "completed"]


async def test_no_event_carries_a_number_that_json_cannot(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        await bench.driver.streamStep(step=1, observation={"a": math.nan}, action={})
        assert bench.of("streamStep")[0]["observation"] == {"a": None}


async def test_a_foreign_thread_may_emit(robot: ToyRobot) -> None:
    async with DriverBench(drive(robot)) as bench:
        await asyncio.to_thread(lambda: asyncio.run(bench.driver.emergencyStop(reason="from a thread")))
        assert bench.of("emergencyStop")[0]["reason"] == "from a thread"


async def test_any_object_with_the_four_verbs_is_a_robot() -> None:
    class Foreign:
        tool_name_str = "foreign"
        stopped = 0

        def start_task(self, instruction: str, **_: Any) -> Any:
            return success("started")

        def stop_task(self) -> Any:
            self.stopped += 1
            return success("stopped", stopped=True)

        def get_task_status(self) -> Any:
            return {"task_status": "idle"}

        def get_features(self) -> Any:
            return {"observation_features": {"a": float}, "action_features": {}}

        def get_observation(self) -> Any:
            return {"a": 1.5}

    foreign = Foreign()
    async with DriverBench(drive(foreign)) as bench:
        assert (await bench.call("execute", instruction="wave"))["status"] == "success"
        assert (await bench.call("stop"))["stopped"] is True
        assert foreign.stopped == 1
        assert (await bench.call("getStatus"))["task_status"] == "idle"
        assert (await bench.call("getFeatures"))["status"] == "success"
        state = await bench.call("getState")
        assert (state["joints"], state["task"]) == ({"a": 1.5}, {"task_status": "idle"})


def test_plain_value_is_refused_as_a_robot() -> None:
    with pytest.raises(ValidationError, match="robot must be an object"):
        RobotDeviceDriver("so100")


@pytest.mark.parametrize("double", [object(), SimpleNamespace(tool_name_str="x"), MagicMock()])
async def test_partial_robot_joins_and_is_refused_by_name(
    double: object, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "operator")
    driver = RobotDeviceDriver(double)
    offered = {function.name for function in driver.functions}
    partial = not isinstance(double, MagicMock)
    assert ("execute" not in offered and "getFeatures" not in offered) is partial
    async with DriverBench(driver) as bench:
        stopped = await bench.call("stop")
        assert (stopped["status"], stopped["stopped"]) == ("error", False if partial else None)
        for verb in ("execute", "getStatus", "getFeatures"):
            arguments = {"instruction": "wave"} if verb == "execute" else {}
            assert (await bench.call(verb, **arguments))["status"] == "error"
    assert ("bench-1 cannot be stopped" in caplog.text) is partial


async def test_a_foreign_robot_that_tells_nothing_has_its_tasks_told_all_the_same() -> None:
    class Mute:
        tool_name_str = "mute"
        status = "idle"

        def start_task(self, instruction: str, **_: Any) -> Any:
            self.status = "running"
            return success("started")

        def stop_task(self) -> Any:
            self.status = "stopped"
            return success("stopped", stopped=True)

        def get_task_status(self) -> Any:
            return {"task_status": self.status, "instruction": "wave", "step_count": 4}

        def get_features(self) -> Any:
            return {}

    async with DriverBench(drive(Mute())) as bench:
        await bench.call("execute", instruction="wave")
        await bench.until(lambda: bench.of("taskStarted"))
        await bench.call("stop")
        await bench.until(lambda: bench.of("taskComplete"))
        assert bench.of("taskStarted")[0]["policy_provider"] == "mock"
        done = bench.of("taskComplete")[0]
        assert (done["instruction"], done["steps"], done["state"]) == ("wave", 4, "stopped")
        assert len(bench.of("taskStarted")) == len(bench.of("taskComplete")) == 1


async def test_rpc_that_a_subclass_overrides_is_the_one_that_is_called(robot: ToyRobot) -> None:
    called: list[str] = []

    class Careful(RobotDeviceDriver):
        @rpc()
        async def stop(self) -> dict[str, Any]:
            """Stop, and ring."""
            called.append("stop")
            return await self.stop_answer("stop")

    class Heir(Careful):
        """Adds nothing."""

    for driver in (Careful(robot), Heir(robot)):
        async with DriverBench(driver) as bench:
            assert (await bench.call("stop"))["stopped"] is True
    assert called == ["stop", "stop"]


@pytest.mark.parametrize(("allow", "said"), [(("*",), True), (("op", "anonymous"), True), (("operator-*",), False)])
async def test_hardware_that_callers_without_a_stated_name_move_says_so_at_start(
    robot: ToyRobot, caplog: pytest.LogCaptureFixture, allow: tuple[str, ...], said: bool
) -> None:
    async with DriverBench(drive(robot, DEVICE_CONNECT_RPC_ALLOW=allow)):
        assert ("callers that are not named may move it: DEVICE_CONNECT_RPC_ALLOW holds" in caplog.text) is said
