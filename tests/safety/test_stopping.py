"""Did it stop? Only an affirmative success is one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.envelope import error, success
from strands_robots.safety.stopping import Outcome, StopVerdict, explain, grade, halt_each


@pytest.mark.parametrize(
    ("answer", "outcome"),
    [
        (success("Stopped."), Outcome.STOPPED),
        (success("Stopped.", stopped=True), Outcome.STOPPED),
        ({"ok": True}, Outcome.STOPPED),
        ({"stopped": True}, Outcome.STOPPED),
        (StopVerdict(), Outcome.STOPPED),
        (StopVerdict(("task",)), Outcome.STOPPED),
        (error("No."), Outcome.REFUSED),
        (success("Stopped.", stopped=False), Outcome.REFUSED),
        (success("Stopped.", running=True), Outcome.REFUSED),
        (success("Stopped.", stopped=np.False_), Outcome.REFUSED),
        (success("Stopped.", running=np.True_), Outcome.REFUSED),
        (success("Stopped.", not_stopped=np.array(["arm", "gripper"])), Outcome.REFUSED),
        ({"status": "success", "ok": np.False_}, Outcome.REFUSED),
        (success("Stopped.", not_stopped={"arm": "wedged"}), Outcome.REFUSED),
        ({"status": "success", "content": [{"json": {"stopped": False}}]}, Outcome.REFUSED),
        ({"ok": False}, Outcome.REFUSED),
        ({"status": "success", "ok": False}, Outcome.REFUSED),
        (StopVerdict(not_stopped={"task": "wedged"}), Outcome.REFUSED),
        (StopVerdict(("leader",), {"task": "wedged"}, {"bus": "?"}), Outcome.REFUSED),
        (RuntimeError("no bus"), Outcome.RAISED),
        (TimeoutError("2 s"), Outcome.TIMED_OUT),
        (StopVerdict(unknown={"bus": "?"}), Outcome.UNKNOWN),
        (success("Stopped.", stopped=None), Outcome.UNKNOWN),
        (None, Outcome.UNKNOWN),
        ({}, Outcome.UNKNOWN),
        (True, Outcome.UNKNOWN),
        ("stopped", Outcome.UNKNOWN),
        ({"status": "stopped"}, Outcome.UNKNOWN),
        ({"status": "accepted", "stopped": True}, Outcome.UNKNOWN),
        ([success("Stopped.")], Outcome.UNKNOWN),
    ],
    ids=lambda value: str(value)[:50],
)
def test_an_answer_is_graded(answer: Any, outcome: Outcome) -> None:
    assert grade(answer) is outcome
    assert outcome.stopped == {Outcome.STOPPED: True, Outcome.UNKNOWN: None}.get(outcome, False)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
KEYS = ("status", "ok", "stopped", "running", "not_stopped", "content", "reason")


@given(st.dictionaries(st.sampled_from(KEYS), JSON))
def test_no_answer_makes_the_grader_raise_and_a_denial_is_never_success(answer: dict[str, Any]) -> None:
    outcome = grade(answer)
    assert explain(answer)
    if answer.get("stopped") is False or answer.get("ok") is False or answer.get("running") is True:
        assert outcome is Outcome.REFUSED


def test_every_source_is_asked_whatever_the_ones_before_it_did() -> None:
    asked: list[str] = []

    def stop(name: str, answer: Any) -> Any:
        def ask() -> Any:
            asked.append(name)
            if isinstance(answer, BaseException):
                raise answer
            return answer

        return ask

    verdict = halt_each(
        {
            "policy": stop("policy", RuntimeError("boom")),
            "leader": stop("leader", error("hangs")),
            "gesture": stop("gesture", success("Stopped.")),
            "idle": stop("idle", None),
            "odd": stop("odd", 5),
        }
    )
    assert asked == ["policy", "leader", "gesture", "idle", "odd"]
    assert verdict.halted == ("gesture",)
    assert set(verdict.not_stopped) == {"policy", "leader"}
    assert "boom" in verdict.not_stopped["policy"]
    assert "hangs" in verdict.not_stopped["leader"]
    assert set(verdict.unknown) == {"odd"}
    assert verdict.stopped is False
    assert verdict.elapsed_ms >= 0


def test_a_verdict_as_an_answer_is_an_error_unless_all_is_known_to_be_still() -> None:
    assert StopVerdict(("task",)).envelope()["status"] == "success"
    assert StopVerdict().envelope()["stopped"] is True
    moving = StopVerdict(("leader",), {"task": "wedged"}, {"bus": "?"}).envelope()
    assert moving["status"] == "error"
    assert "task did not stop: wedged" in moving["reason"]
    assert StopVerdict(unknown={"bus": "?"}).envelope()["stopped"] is None
    for verdict in (StopVerdict(("a",)), StopVerdict(not_stopped={"a": "b"}), StopVerdict(unknown={"a": "b"})):
        assert grade(verdict.envelope()) is grade(verdict)


def test_an_explanation_is_short_and_says_what_came() -> None:
    assert "no bus" in explain(RuntimeError("no bus"))
    assert "no answer" in explain(TimeoutError("2 s"))
    assert explain(error("wedged")) == "did not stop: wedged"
    assert explain(error("did not stop: jam: wedged")) == "did not stop: jam: wedged"
    assert len(explain({"status": "x" * 10**5})) < 300
