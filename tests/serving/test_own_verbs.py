"""Verbs that a robot declares: which are served, what they answer, and what the pipeline does with them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fixtures.barista import Barista, Careless, Stubborn

from strands_robots import Permit, verb
from strands_robots.adapted import adapt
from strands_robots.envelope import success, text_of
from strands_robots.serving.advertised import RobotDescription
from strands_robots.serving.offered_verbs import answer_of, own_verbs
from strands_robots.serving.pipeline import Command, Pipeline, Result
from strands_robots.serving.verbs import Kind, described
from strands_robots.utils import ValidationError


def with_verb(method: Callable[..., Any], **options: Any) -> Any:
    return adapt(type("Robot", (), {"method": verb(**options)(method)})())


def served(robot: Any, name: str, **arguments: Any) -> Result:
    """Serve one call on this thread and return its answer."""
    seen = adapt(robot)
    pipeline = Pipeline.of(seen, lambda: "robot-1", hardware=False, authorize=lambda command, given: ("tester",))
    answers: list[Result] = []
    asked = pipeline.pending.arrive()
    pipeline.serve(Command(own_verbs(seen)[name], arguments, "tester", asked), answers.append)
    return answers[0]


@pytest.mark.parametrize(
    "name", ["stop", "halt", "estop", "emergencyStop", "stopMotion", "execute", "getStatus", "pick", "resume", "state"]
)
def test_name_of_a_stop_or_of_another_verb_is_refused_by_name(name: str) -> None:
    def method(self: object, permit: Permit) -> None: ...

    method.__annotations__["permit"] = Permit
    with pytest.raises(ValidationError, match=f"cannot be the verb {name}"):
        own_verbs(with_verb(method, name=name))


@pytest.mark.parametrize(
    "name", ["robot_name", "source_device", "lease_id", "lease_ttl_s", "action", "timeout", "function_name"]
)
def test_parameter_of_a_name_that_travels_in_another_sense_is_refused_by_name(name: str) -> None:
    namespace: dict[str, Any] = {}
    exec(f"def brew(self, {name}: str) -> None: ...", namespace)
    with pytest.raises(ValidationError, match=f"brew cannot have the parameter {name}, which goes with a call"):
        own_verbs(with_verb(namespace["brew"], motion=False))


def test_verb_that_callers_could_not_read_is_refused() -> None:
    def brew(self: object, cups: object) -> None: ...

    cups: Any = int
    for _ in range(7):
        cups = list[cups]
    brew.__annotations__["cups"] = cups
    with pytest.raises(ValidationError, match="would not see parameter cups of brew, nested deeper than 8"):
        own_verbs(with_verb(brew, motion=False))


def test_motion_that_no_stop_would_end_is_refused_at_registration() -> None:
    def brew(self: object) -> None: ...

    with pytest.raises(ValidationError, match="a motion that no stop would end"):
        own_verbs(with_verb(brew))
    assert own_verbs(with_verb(brew, motion=False))["brew"].kind is Kind.READ

    class Halts:
        def halt(self, reason: str = "") -> dict[str, Any]:
            return {"status": "success"}

        @verb
        def brew(self) -> None: ...

    assert own_verbs(adapt(Halts()))["brew"].kind is Kind.MOTION


def test_change_is_a_motion_to_its_callers_and_says_that_it_moves_nothing() -> None:
    def dim(self: object) -> None: ...

    dimmed = own_verbs(with_verb(dim, motion=False, changes=True))["dim"]
    assert (dimmed.kind, dimmed.leased) == (Kind.CHANGE, False)
    advertised = RobotDescription.of([described(dimmed)]).verbs["dim"]
    assert (advertised.kind, advertised.changes) == ("motion", True)
    with pytest.raises(ValidationError, match="changes=True goes with motion=False"):
        with_verb(dim, changes=True)


def test_description_beyond_64_kb_is_refused() -> None:
    def brew(self: object, permit: Permit) -> None: ...

    brew.__annotations__["permit"] = Permit
    long = {f"brew{n}": verb(name=f"brew{n}")(brew) for n in range(101)}
    with pytest.raises(ValidationError, match="declares 101 verbs"):
        own_verbs(adapt(type("Robot", (), long)()))


def test_own_verb_is_served_with_its_arguments_checked() -> None:
    answer = served(Barista(), "brewCoffee", cups=2).result
    assert (answer["status"], answer["cups"], answer["strength"]) == ("success", 2, "mild")
    refused = served(Barista(), "brewCoffee", cups=9)
    assert refused.refusal is not None
    assert "cups must be an integer from 1 to 8, not 9" in refused.result["reason"]
    assert "it has no mugs" in served(Barista(), "brewCoffee", cups=1, mugs=2).result["reason"]


def test_numpy_is_numbers_and_lists() -> None:
    answer = served(Careless(), "weigh").result
    assert (answer["grams"], answer["samples"], answer["count"]) == (12.5, [[1.0, 2.0]], 3)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (float("nan"), "result is nan"),
        (np.float32("inf"), "result is inf"),
        ({"x": [1, {"y": -np.inf}]}, "x[1].y is -inf"),
        (np.array([0.5, np.nan]), "result[1] is nan"),
        ({"x": object}, "x is <class 'object'>"),
        ({"x": {(1, 2): 3}}, "x has the key (1, 2)"),
        (b"raw", "result is b'raw'"),
        pytest.param(1 << 300, "result is an integer of 301 bits", id="long integer"),
    ],
)
def test_what_json_cannot_carry_is_an_error_that_names_verb_and_place(given: object, said: str) -> None:
    answer = answer_of("weigh", given, "completed")
    assert (answer["status"], answer["task_status"]) == ("error", "completed")
    assert answer["reason"] == f"weigh completed. It returned what JSON cannot carry: {said}."


def test_value_that_holds_itself_is_an_error() -> None:
    loop: list[object] = []
    loop.append(loop)
    assert answer_of("weigh", loop)["status"] == "error"


def test_stopped_verb_keeps_the_shape_of_an_answer_whatever_it_returned() -> None:
    given = {"status": "success", "content": [{"json": {"content": 5, "grams": 1}}]}
    answer = answer_of("weigh", given, "stopped", "it was stopped")
    assert (answer["status"], answer["grams"]) == ("error", 1)
    assert text_of(answer).startswith("weigh stopped: it was stopped.")


def test_motion_that_a_stop_ended_is_an_error_with_what_it_returned() -> None:
    robot = Barista()
    answers: list[Result] = []
    brewing = threading.Thread(target=lambda: answers.append(served(robot, "brewCoffee", cups=8)))
    brewing.start()
    assert robot.brewing.wait(20.0)
    adapt(robot).halt()
    brewing.join(20.0)
    answer = answers[0].result
    assert (answer["status"], answer["reason"]) == ("error", "brewCoffee stopped: it was stopped.")
    assert (answer["task_status"], answer["why"], answer["cups"]) == ("stopped", "it was stopped", 8)


def test_motion_that_returned_long_after_its_stop_is_an_error_too() -> None:
    robot = Stubborn()
    answers: list[Result] = []
    grinding = threading.Thread(target=lambda: answers.append(served(robot, "grind")))
    grinding.start()
    assert robot.started.wait(20.0)
    adapt(robot).gate.revoke()
    robot.released.set()
    grinding.join(20.0)
    assert (answers[0].result["status"], answers[0].result["task_status"]) == ("error", "stopped")


def test_motion_whose_time_was_over_is_an_error_with_that_reason() -> None:
    class Slow:
        @verb(motion=True)
        def brew(self, permit: Permit) -> None:
            permit.end_at(0.0)

    assert served(Slow(), "brew").result["reason"] == "brew stopped: its time was over before it was done."


@pytest.mark.parametrize(
    ("given", "said", "fields"),
    [
        (None, "", {}),
        (3, "", {"result": 3}),
        ({"reason": "it felt something", "task_status": "completed"}, " it felt something", {"task_status": "stopped"}),
        (success("Two cups.", cups=2), " Two cups.", {"cups": 2}),
    ],
)
def test_words_and_fields_of_a_stopped_motion_are_kept(given: object, said: str, fields: dict[str, Any]) -> None:
    answer = answer_of("brew", given, "stopped", "it was stopped")
    assert (answer["status"], answer["reason"]) == ("error", f"brew stopped: it was stopped.{said}")
    assert {name: answer[name] for name in fields} == fields


def test_verb_that_raises_failed_inside_the_device() -> None:
    answer = served(Careless(), "spill")
    assert answer.refusal is not None
    assert "failed inside the device" in answer.result["reason"]


def test_read_that_moves_is_refused() -> None:
    assert "peek is declared a read" in served(Careless(), "peek").result["reason"]


def test_every_other_motion_waits_for_the_verb_to_return() -> None:
    robot = Barista()
    working = threading.Thread(target=robot.brew_coffee, args=(8,))
    working.start()
    try:
        assert robot.brewing.wait(20.0)
        assert "brewCoffee of this robot has not returned" in served(robot, "brewCoffee", cups=1).result["reason"]
        assert served(robot, "beansLeft").result["result"] == 250.0
    finally:
        adapt(robot).halt()
        working.join(20.0)


@pytest.mark.parametrize(
    ("given", "fields"),
    [
        (None, {"status": "success"}),
        (3, {"status": "success", "result": 3}),
        ([1], {"status": "success", "result": [1]}),
        (np.float64(2.5), {"status": "success", "result": 2.5}),
        ({"a": 1, "status": "odd"}, {"status": "success", "a": 1}),
        ({"status": "error", "reason": "no beans"}, {"status": "error", "reason": "no beans"}),
        ({"status": "success", "cups": 1}, {"status": "success", "cups": 1}),
    ],
)
def test_answer_is_an_envelope_whatever_the_verb_returns(given: object, fields: dict[str, Any]) -> None:
    answer = answer_of("brew", given)
    assert answer["content"][0]["text"]
    assert {name: answer[name] for name in fields} == fields


def test_default_that_a_method_changes_is_none_for_the_next_call() -> None:
    class Collects:
        @verb(motion=False)
        def collect(self, items: list[int] = []) -> int:  # noqa: B006 - what an author may write
            items.append(1)
            return len(items)

    robot = Collects()
    assert [served(robot, "collect").result["result"] for _ in range(3)] == [1, 1, 1]


def test_stop_of_a_robot_of_a_world_voids_what_waits_on_another_network() -> None:
    robot = Barista()
    first, second = (
        Pipeline.of(adapt(robot), lambda: "robot-1", hardware=False, authorize=lambda command, given: ("tester",))
        for _ in range(2)
    )
    asked = first.pending.arrive("left")
    second.pending.void("left")
    assert asked is not None
    assert asked.given_up
