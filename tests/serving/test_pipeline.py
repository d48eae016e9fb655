"""The stages of a command, in order, and what each refusal says."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.toy_robots import ToyRobot

from strands_robots.envelope import RefusalReason, Refused, error
from strands_robots.safety.authorization import Approval, Grants
from strands_robots.serving.pipeline import Command, Pipeline, Result
from strands_robots.serving.robot_verbs import TASK_VERBS
from strands_robots.serving.verbs import Arguments
from strands_robots.serving.workers import shares_of


class Locked:
    def refusal(self, verb: str) -> dict[str, Any]:
        return error(f"{verb} refused: locked by epoch abc")


@pytest.fixture
def robot() -> Iterator[ToyRobot]:
    toy = ToyRobot()
    yield toy
    toy.close()


def pipeline(robot: Any, *, allow: bool = True, approved: bool = True, grants: Path | None = None) -> Pipeline:
    def authorize(command: Command, arguments: Arguments) -> None:
        if not allow:
            raise Refused(RefusalReason.CALLER, "not you")

    listed = ("execute",) if approved else ()
    approval = Approval(lambda _: listed, lambda: False, lambda: Grants(grants or Path("nowhere")))
    return Pipeline.of(robot, lambda: "arm-1", hardware=True, authorize=authorize, approval=approval)


def served(line: Pipeline, name: str = "execute", **arguments: Any) -> Result:
    results: list[Result] = []
    line.serve(Command(TASK_VERBS[name], arguments, "agent", line.pending.arrive()), results.append)
    return results[0]


def test_a_command_that_passes_every_stage_starts_the_robot(robot: ToyRobot) -> None:
    result = served(pipeline(robot), instruction="wave", duration=300.0)
    assert result.refusal is None
    assert result.result["status"] == "success"
    assert robot.rollouts["toy"].running


@pytest.mark.parametrize(
    ("allow", "approved", "locked", "arguments", "why"),
    [
        (False, False, True, {"instruction": ""}, RefusalReason.ARGUMENTS),
        (False, False, True, {"instruction": "wave"}, RefusalReason.CALLER),
        (True, False, True, {"instruction": "wave"}, RefusalReason.LOCKOUT),
        (True, False, False, {"instruction": "wave"}, RefusalReason.APPROVAL),
    ],
)
def test_the_first_stage_that_refuses_is_the_one_that_is_named(
    robot: ToyRobot, allow: bool, approved: bool, locked: bool, arguments: dict[str, Any], why: RefusalReason
) -> None:
    if locked:
        robot.gate.attach(Locked())
    result = served(pipeline(robot, allow=allow, approved=approved), **arguments)
    assert result.refusal is not None
    assert result.refusal.why is why
    assert result.result["status"] == "error"
    assert result.result["refused"] == why.value
    assert robot.rollouts == {}


def test_a_grant_is_spent_by_a_start_and_kept_by_a_refusal_of_the_robot(robot: ToyRobot, tmp_path: Path) -> None:
    Grants(tmp_path).grant("execute", "arm-1")
    line = pipeline(robot, approved=False, grants=tmp_path)
    assert served(line, instruction="wave", policy_provider="unknown").refusal is None
    assert served(line, instruction="wave", duration=300.0).result["status"] == "success"
    again = served(line, instruction="wave").refusal
    assert again is not None
    assert again.why is RefusalReason.APPROVAL


def test_an_exception_of_the_robot_is_a_refusal_without_its_detail(
    robot: ToyRobot, caplog: pytest.LogCaptureFixture
) -> None:
    def fail() -> None:
        raise OSError("secret path")

    robot.before["start_task"] = fail
    result = served(pipeline(robot), instruction="wave")
    assert result.refusal is not None
    assert result.refusal.why is RefusalReason.FAILED
    assert "secret" not in str(result)
    assert "secret path" in caplog.text


def test_a_stop_of_one_robot_voids_the_commands_for_it_and_for_any(robot: ToyRobot) -> None:
    world = pipeline(robot).pending
    left, right, any_robot = world.arrive("left"), world.arrive("right"), world.of("left").arrive()
    unnamed = world.arrive()
    world.void("left")
    given_up = [each is not None and each.given_up for each in (left, right, any_robot, unnamed)]
    assert given_up == [True, False, True, True]


def test_a_closed_pipeline_refuses_and_names_what_still_runs(robot: ToyRobot) -> None:
    started, let_go = threading.Event(), threading.Event()

    def wait_in_the_robot() -> None:
        started.set()
        let_go.wait()

    robot.before["start_task"] = wait_in_the_robot
    line = pipeline(robot)
    results: list[Result] = []
    command = Command(TASK_VERBS["execute"], {"instruction": "wave"}, "agent", line.pending.arrive())
    line.shares.motion.submit(lambda: line.serve(command, results.append))
    assert started.wait(20.0)
    assert line.close() == ["execute"]
    refused = served(line, instruction="wave").refusal
    assert refused is not None
    assert refused.why is RefusalReason.BUSY
    let_go.set()
    assert line.close(20.0) == []


def test_one_robot_has_the_same_threads_on_every_network(robot: ToyRobot) -> None:
    assert pipeline(robot).shares is pipeline(robot).shares is shares_of(robot)


def test_a_peer_without_a_robot_answers_that_it_has_none() -> None:
    line = Pipeline.of(None, lambda: "console", hardware=False, authorize=lambda command, arguments: None)
    assert "no robot" in served(line, "getStatus").result["reason"]
