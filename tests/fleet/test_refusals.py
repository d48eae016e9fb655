"""Refusals of the mesh, which are texts, as exceptions."""

from __future__ import annotations

import pytest

from strands_robots import errors
from strands_robots.envelope import RefusalReason
from strands_robots.errors import RefusalError, StrandsRobotsError
from strands_robots.fleet.reports import BY_REASON, refusal_of_text, said
from strands_robots.mesh import commands
from strands_robots.safety.authorization import Approval


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        (commands.LOCKED, errors.LockoutError),
        (commands.BUSY, errors.BusyError),
        (commands.DISPATCH, errors.RobotError),
        (commands.REPLAYED, errors.CallerError),
        ("validation: action must be one of status, stop, not 'fly'.", errors.UnknownVerbError),
        ("validation: duration must be above 0, not -1.", errors.ArgumentsError),
        ("start is refused: ana (agent) holds control for 3.0 s more.", errors.ControlError),
        ("start is refused: this lease is over. Acquire control anew.", errors.ControlError),
        (Approval.refusal("start", "arm-1"), errors.ApprovalError),
        ("", errors.RobotError),
        (None, errors.RobotError),
    ],
)
def test_text_is_sorted_by_its_words(text: object, cause: type[RefusalError]) -> None:
    refusal = refusal_of_text("arm-1", "start", text)
    assert type(refusal) is cause
    assert refusal.why
    assert not refusal.why.startswith("validation")


def test_every_reason_of_the_pipeline_has_an_exception() -> None:
    assert BY_REASON.keys() == {each.value for each in RefusalReason}


def test_refusal_says_who_what_why_and_what_to_do() -> None:
    refusal = errors.LockoutError("it is locked", robot="arm-1", verb="pick")
    assert isinstance(refusal, StrandsRobotsError)
    assert (refusal.robot, refusal.verb, refusal.why) == ("arm-1", "pick", "it is locked")
    assert str(refusal) == f"arm-1: it is locked. {refusal.remedy}"
    assert "resume" in refusal.remedy


@pytest.mark.parametrize(
    ("cause", "known_as"),
    [
        (errors.NoAnswerError, TimeoutError),
        (errors.NoSuchRobotError, LookupError),
        (errors.UnreachableError, ConnectionError),
        (errors.UnknownVerbError, AttributeError),
        (errors.ArgumentsError, ValueError),
    ],
)
def test_refusals_keep_the_built_in_that_callers_know(cause: type[RefusalError], known_as: type[Exception]) -> None:
    assert isinstance(cause("why", robot="arm-1"), known_as)
    assert str(cause("why", robot="arm-1", remedy="")) == "arm-1: why."


def test_call_without_an_answer_may_still_be_carried_out() -> None:
    assert said(errors.NoAnswerError("it did not answer")) == "it did not answer. It may still carry the call out."
