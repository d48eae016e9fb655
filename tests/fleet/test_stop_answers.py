from __future__ import annotations

from strands_robots.envelope import error, success
from strands_robots.fleet.verdicts import combined_verdict


def test_one_silent_robot_makes_a_stop_an_error_that_names_it() -> None:
    answer = combined_verdict({"a": success("ok", stopped=True), "b": error("no answer in 5 s", stopped=None)})
    assert answer["status"] == "error"
    assert answer["silent"] == ["b"]
    assert answer["stopped"] is None
    assert "b" in answer["reason"]


def test_moving_robot_outranks_a_silent_one() -> None:
    answer = combined_verdict(
        {
            "a": success("ok", stopped=True),
            "b": error("no answer", stopped=None),
            "c": error("the bus is wedged", stopped=False),
        }
    )
    assert answer["stopped"] is False
    assert answer["not_stopped"] == ["c"]
    assert "DID NOT STOP: c" in answer["reason"]


def test_stop_without_any_answer_is_an_error() -> None:
    assert combined_verdict({})["status"] == "error"


def test_only_affirmative_answers_are_a_stop() -> None:
    assert combined_verdict({"a": success("ok"), "b": success("ok", stopped=["arm"])})["status"] == "success"
    assert combined_verdict({"a": {"result": "hm"}})["status"] == "error"
