"""What an approval is spent by, and what a refused call leaves behind: nothing."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fixtures.barista import Barista
from fixtures.pan_tilt import ArmDevice, PanTilt
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually

from strands_robots.adapted import adapt
from strands_robots.envelope import RefusalReason, Refused, error, success
from strands_robots.hardware import HardwareRobot
from strands_robots.safety.authorization import Approval, Grants, Leave, digest
from strands_robots.safety.gate import MotionRequest
from strands_robots.serving import control
from strands_robots.serving.peer_verbs import PEER_VERBS
from strands_robots.serving.pipeline import Command, Pipeline, Result
from strands_robots.serving.robot_verbs import TASK_VERBS
from strands_robots.serving.verbs import Arguments, Verb

GOOD = {"instruction": "GOOD", "duration": 300.0}
EVIL = {"instruction": "EVIL", "duration": 300.0}
SECRET = "agent-a's own"


class Locked:
    def refusal(self, verb: str) -> dict[str, Any]:
        return error(f"{verb} refused: locked by epoch abc")


@pytest.fixture
def robot() -> Iterator[ToyRobot]:
    toy = ToyRobot()
    yield toy
    toy.close()


@pytest.fixture
def grants(tmp_path: Path) -> Grants:
    return Grants(tmp_path / "grants")


def pipeline(robot: Any, grants: Grants, *allow: str) -> Pipeline:
    def authorize(command: Command, arguments: Arguments) -> tuple[str, ...]:
        if command.caller == "stranger":
            raise Refused(RefusalReason.CALLER, "not you")
        return (str(command.caller),)

    approval = Approval(lambda _: allow, lambda: False, lambda: grants)
    return Pipeline.of(robot, lambda: "arm-1", hardware=True, authorize=authorize, approval=approval)


def served(
    line: Pipeline,
    caller: str,
    arguments: Arguments = GOOD,
    verb: str = "execute",
    verbs: Mapping[str, Verb] = TASK_VERBS,
) -> Result:
    results: list[Result] = []
    line.serve(Command(verbs[verb], arguments, caller, line.pending.arrive()), results.append)
    return results[0]


def ok(result: Result) -> bool:
    return bool(result.result["status"] == "success")


@pytest.mark.parametrize(
    ("verb", "verbs", "said"),
    [
        ("execute", TASK_VERBS, "arm-1 runs no tasks; it has verbs of its own."),
        ("execute", PEER_VERBS, "arm-1 runs no tasks; it has verbs of its own."),
        ("pick", TASK_VERBS, "pick is refused: arm-1 lacks what it needs"),
        ("releaseTorque", PEER_VERBS, "releaseTorque is refused: arm-1 lacks what it needs"),
        ("nod", PEER_VERBS, "nod is refused: arm-1 lacks what it needs"),
    ],
)
@pytest.mark.parametrize("caller", ["agent-a", "stranger"])
def test_verb_that_a_robot_lacks_asks_for_no_approval_and_no_other_caller(
    grants: Grants, caller: str, verb: str, verbs: Mapping[str, Verb], said: str
) -> None:
    result = served(pipeline(adapt(Barista()), grants), caller, {}, verb, verbs)
    assert result.refusal is None
    assert said in result.result["reason"]


def test_task_of_a_robot_without_tasks_is_refused_by_that_with_arguments_that_fit(grants: Grants) -> None:
    line = pipeline(adapt(Barista()), grants)
    assert served(line, "agent-a").result["reason"] == "arm-1 runs no tasks; it has verbs of its own."
    line.robot.gate.attach(Locked())  # type: ignore[union-attr]
    locked = served(line, "agent-a").refusal
    assert locked is not None and locked.why is RefusalReason.LOCKOUT


def test_verb_for_which_an_arm_has_no_part_asks_for_no_approval(grants: Grants) -> None:
    refused = served(pipeline(HardwareRobot(PanTilt(), "arm"), grants), "agent-a", {"object": "cube"}, "pick")
    assert "pick is refused: arm-1 lacks what it needs" in refused.result["reason"]
    asked = served(pipeline(HardwareRobot(ArmDevice(), "arm"), grants), "agent-a", {"object": "cube"}, "pick")
    assert asked.refusal is not None and asked.refusal.why is RefusalReason.APPROVAL


def test_a_bound_grant_moves_nothing_else_and_is_not_disturbed(robot: ToyRobot, grants: Grants) -> None:
    path = grants.grant("execute", "arm-1", caller="agent-a", arguments_digest=digest(GOOD))
    line = pipeline(robot, grants)
    over, seen = threading.Event(), [0, 0]

    def spam() -> None:
        while not over.is_set():
            seen[0] += 1
            seen[1] += not path.exists()
            for caller, arguments in (("agent-b", EVIL), ("agent-a", EVIL), ("agent-b", GOOD)):
                refusal = served(line, caller, arguments).refusal
                assert refusal is not None
                assert refusal.why is RefusalReason.APPROVAL

    with ThreadPoolExecutor(3) as pool:
        spamming = [pool.submit(spam) for _ in range(3)]
        try:
            while seen[0] < 300 and not any(each.done() for each in spamming):
                assert path.exists()
        finally:
            over.set()
        for each in spamming:
            each.result()
    assert seen[1] == 0, "the grant was renamed by a command that it was not for"
    assert ok(served(line, "agent-a"))
    assert not path.exists()


def test_the_leases_arguments_are_no_part_of_what_was_approved(robot: ToyRobot, grants: Grants) -> None:
    grants.grant("execute", "arm-1", caller="agent-a", arguments_digest=digest({**GOOD, "duration": 300}))
    line = pipeline(robot, grants)
    assert ok(served(line, "agent-a", {**GOOD, "lease_id": SECRET, "lease_ttl_s": 5.0}))


def test_the_narrowest_grant_is_spent_first(robot: ToyRobot, grants: Grants) -> None:
    typed = grants.grant("execute", "arm-1")
    named = grants.grant("execute", "arm-1", caller="agent-a")
    yes = grants.grant("execute", "arm-1", caller="agent-a", arguments_digest=digest(GOOD))
    line = pipeline(robot, grants)
    for spent, left in ((yes, [named, typed]), (named, [typed]), (typed, [])):
        assert ok(served(line, "agent-a"))
        robot.halt()
        assert not spent.exists()
        assert all(each.exists() for each in left)


def refuse_arguments(robot: ToyRobot, line: Pipeline) -> Result:
    return served(line, "agent-b", {**EVIL, "duration": -1})


def refuse_secret(robot: ToyRobot, line: Pipeline) -> Result:
    return served(line, "agent-b", {**EVIL, "lease_ttl_s": 5.0})


def refuse_caller(robot: ToyRobot, line: Pipeline) -> Result:
    return served(line, "stranger", EVIL)


def refuse_lockout(robot: ToyRobot, line: Pipeline) -> Result:
    latch = Locked()
    robot.gate.attach(latch)
    try:
        return served(line, "agent-b", EVIL)
    finally:
        robot.gate.detach(latch)


def refuse_approval(robot: ToyRobot, line: Pipeline) -> Result:
    return served(line, "agent-b", {"opening": 1.0}, "setGripper")


def refuse_late(robot: ToyRobot, line: Pipeline) -> Result:
    results: list[Result] = []
    command = Command(TASK_VERBS["execute"], EVIL, "agent-b", line.pending.arrive())
    robot.gate.revoke()
    line.serve(command, results.append)
    return results[0]


def refuse_by_the_robot(robot: ToyRobot, line: Pipeline) -> Result:
    return served(line, "agent-b", {**EVIL, "policy_provider": "unknown"})


def refuse_with_a_time(robot: ToyRobot, line: Pipeline) -> Result:
    wanted = {**EVIL, "policy_provider": "unknown", "lease_id": "agent-b's own", "lease_ttl_s": 5.0}
    return served(line, "agent-b", wanted)


REFUSALS = [
    *(refuse_arguments, refuse_secret, refuse_caller, refuse_lockout, refuse_approval, refuse_late),
    *(refuse_by_the_robot, refuse_with_a_time),
]


@pytest.mark.parametrize("refuse", REFUSALS)
def test_a_refused_call_leaves_a_free_robot_free(
    robot: ToyRobot, grants: Grants, refuse: Callable[[ToyRobot, Pipeline], Result]
) -> None:
    def no_status() -> None:
        raise OSError("a robot whose state is not known keeps the lease of a motion")

    line = pipeline(robot, grants, "execute")
    assert line.leases is not None
    robot.before["get_task_status"] = no_status
    assert not ok(refuse(robot, line))
    assert line.leases.facts() == {"held": False, "epoch": 0}
    assert ok(served(line, "agent-a"))


@pytest.mark.parametrize("refuse", REFUSALS)
def test_a_refused_call_leaves_the_lease_of_another_as_it_was(
    robot: ToyRobot, grants: Grants, refuse: Callable[[ToyRobot, Pipeline], Result]
) -> None:
    line = pipeline(robot, grants, "execute")
    assert line.leases is not None
    assert ok(served(line, "agent-a"))
    before = line.leases.facts()
    assert before["holder"] == "agent-a"
    assert not ok(refuse(robot, line))
    assert line.leases.facts() == before


def test_calls_that_the_robot_refuses_keep_nobody_from_moving_it(robot: ToyRobot, grants: Grants) -> None:
    line = pipeline(robot, grants, "execute")
    over, tries = threading.Event(), [0]

    def spam() -> None:
        while not over.is_set():
            assert not ok(refuse_by_the_robot(robot, line))
            tries[0] += 1

    with ThreadPoolExecutor(3) as pool:
        spamming = [pool.submit(spam) for _ in range(3)]
        try:
            for _ in range(50):
                eventually(lambda due=tries[0] + 3: tries[0] >= due)
                answer = served(line, "agent-a").result
                assert answer["status"] == "success", answer
                robot.halt()
        finally:
            over.set()
        for each in spamming:
            each.result()


def test_a_start_that_hangs_refuses_others_by_its_callers_name(robot: ToyRobot, grants: Grants) -> None:
    line = pipeline(robot, grants, "execute")
    starting, let_go = threading.Event(), threading.Event()

    def hang() -> None:
        starting.set()
        let_go.wait()

    robot.before["start_task"] = hang
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(served, line, "agent-b", EVIL)
        try:
            assert starting.wait(20.0)
            answer = served(line, "agent-a").result
        finally:
            let_go.set()
        assert ok(first.result())
    assert (answer["code"], answer["holder"]) == ("not_holder", "agent-b")


def test_a_refused_call_gives_its_holder_no_other_time(robot: ToyRobot, grants: Grants) -> None:
    line = pipeline(robot, grants, "execute", "acquireControl")
    assert line.leases is not None
    held = served(line, "agent-a", {"ttl_s": 600.0}, "acquireControl").result["lease_id"]
    due = line.leases.of().due
    wanted = {**EVIL, "policy_provider": "unknown", "lease_id": held, "lease_ttl_s": 2.0}
    assert not ok(served(line, "agent-a", wanted))
    assert line.leases.of().due == due
    assert ok(served(line, "agent-a", {**GOOD, "lease_id": held, "lease_ttl_s": 2.0}))
    shorter = line.leases.of().due
    assert shorter is not None
    assert due is not None
    assert shorter < due


def test_a_second_call_of_the_holder_that_is_refused_does_not_end_the_first(robot: ToyRobot, grants: Grants) -> None:
    line = pipeline(robot, grants, "execute")
    assert line.leases is not None
    assert ok(served(line, "agent-a"))
    assert not ok(served(line, "agent-a", EVIL)), "the robot was not busy"
    assert line.leases.facts()["holder"] == "agent-a"


def test_a_grant_is_kept_while_another_holds_the_robot(robot: ToyRobot, grants: Grants) -> None:
    path = grants.grant("execute", "arm-1", caller="agent-a")
    line = pipeline(robot, grants, "execute@arm-1:agent-b")
    assert ok(served(line, "agent-b"))
    refusal = served(line, "agent-a").refusal
    assert refusal is not None
    assert refusal.why is RefusalReason.CONTROL
    assert path.exists()
    robot.halt()
    assert ok(served(line, "agent-a"))
    assert not path.exists()


def began_and_failed(robot: ToyRobot, request: MotionRequest) -> object:
    robot.gate.permit("execute", request).begin()
    return error("it was stopped")


def raised(robot: ToyRobot, request: MotionRequest) -> object:
    raise OSError("no answer")


def answered_nothing(robot: ToyRobot, request: MotionRequest) -> object:
    return None


def refused(robot: ToyRobot, request: MotionRequest) -> object:
    robot.gate.permit("execute", request)
    return error("it is busy")


@pytest.mark.parametrize(
    ("answer", "spent"), [(began_and_failed, True), (raised, True), (answered_nothing, True), (refused, False)]
)
def test_a_grant_is_spent_by_what_began_or_may_have(
    robot: ToyRobot, grants: Grants, answer: Callable[..., object], spent: bool
) -> None:
    grants.grant("execute", "arm-1")
    line = pipeline(robot, grants)
    line.own = {"execute": lambda arguments, request: answer(robot, request)}
    served(line, "agent-a")
    assert (grants.claim("execute", "arm-1") is None) is spent


def test_another_callers_motion_is_refused_at_once_while_a_call_that_lasts_moves(
    robot: ToyRobot, grants: Grants, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "START_WAIT_S", 600.0)
    moves, end = threading.Event(), threading.Event()

    def last(toy: Any, arguments: Arguments, request: MotionRequest | None) -> Any:
        toy.gate.permit("execute", request).begin()
        moves.set()
        end.wait(120)
        return success("done")

    lasting = replace(TASK_VERBS["execute"], begin=last)
    line, results = pipeline(robot, grants, "execute"), list[Result]()
    with ThreadPoolExecutor(2) as pool:
        try:
            pool.submit(line.serve, Command(lasting, GOOD, "agent-a", line.pending.arrive()), results.append)
            assert moves.wait(20)
            refusal = pool.submit(served, line, "agent-b").result(20).refusal
            assert refusal is not None
            assert refusal.why is RefusalReason.CONTROL
        finally:
            end.set()
    assert ok(results[0])


def test_a_caller_is_answered_though_the_grant_cannot_be_taken_away(
    robot: ToyRobot, grants: Grants, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(leave: Leave, begun: bool) -> None:
        raise OSError("read-only file system")

    grants.grant("execute", "arm-1")
    monkeypatch.setattr(Leave, "settle", fails)
    assert ok(served(pipeline(robot, grants), "agent-a"))
