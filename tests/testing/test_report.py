"""The report of a robot's checks: its tier, its words, its exemptions, and the recorder that proves a stop."""

from __future__ import annotations

import json
import logging
import re
from dataclasses import replace
from typing import Any

import pytest

from strands_robots.testing import (
    BusRecorder,
    CheckMark,
    ConformanceReport,
    LongMotion,
    Subject,
    Tier,
    conform,
    promises,
)
from strands_robots.testing.bench import DriftError, NotKeptError, NotProvenError
from strands_robots.testing.promise import Promise
from strands_robots.testing.raised import CABLE_OUT, RaisedExceptions
from strands_robots.utils import ValidationError


class Bench:
    """All that a promise asks of a bench besides its robot."""

    def __init__(self, **subject: Any) -> None:
        self.subject = Subject(object, **subject)
        self.raised = RaisedExceptions()


def kept(tier: Tier, name: str = "x.y", raises: Exception | None = None, *, needs_recorder: bool = False) -> Promise:
    def proof(_: Any) -> str:
        if raises is not None:
            raise raises
        return "seen"

    return Promise(name, tier, "It stops.", "People stand beside it.", "halt()", proof, needs_recorder)


@pytest.mark.parametrize(
    ("raises", "mark"),
    [
        (None, CheckMark.PASSED),
        (NotKeptError("it wrote"), CheckMark.FAILED),
        (DriftError("it has an elbow"), CheckMark.DRIFT),
        (NotProvenError("no motion"), CheckMark.NOT_PROVEN),
        (ValidationError("no such thing"), CheckMark.FAILED),
        (RuntimeError("a robot raises what it likes"), CheckMark.FAILED),
    ],
)
def test_what_a_check_raises_is_its_mark(raises: Exception | None, mark: CheckMark) -> None:
    result = kept(Tier.BRONZE, raises=raises).check(Bench())  # type: ignore[arg-type]
    assert result.mark is mark
    assert raises is None or str(raises) in result.said


def test_promise_about_writes_is_not_proven_without_a_recorder() -> None:
    promise = kept(Tier.SILVER, needs_recorder=True)
    assert promise.check(Bench()).mark is CheckMark.NOT_PROVEN  # type: ignore[arg-type]
    assert promise.check(Bench(recorder=BusRecorder())).mark is CheckMark.PASSED  # type: ignore[arg-type]


def test_exemption_has_its_reason_and_is_stale_where_the_promise_is_kept() -> None:
    bench: Any = Bench(exempt={"x.y": "it has no brake"})
    exempt = kept(Tier.GOLD, raises=NotKeptError("it rolls")).check(bench)
    assert (exempt.mark, exempt.said) == (CheckMark.EXEMPT, "it has no brake")
    stale = kept(Tier.GOLD).check(bench)
    assert stale.mark is CheckMark.STALE
    assert "it has no brake" in stale.said


@pytest.mark.parametrize(
    ("marks", "tier"),
    [
        ({Tier.BRONZE: CheckMark.PASSED, Tier.SILVER: CheckMark.PASSED}, Tier.SILVER),
        ({Tier.BRONZE: CheckMark.PASSED, Tier.SILVER: CheckMark.NOT_PROVEN, Tier.GOLD: CheckMark.PASSED}, Tier.BRONZE),
        ({Tier.BRONZE: CheckMark.FAILED, Tier.SILVER: CheckMark.PASSED}, None),
        ({Tier.BRONZE: CheckMark.EXEMPT}, Tier.BRONZE),
        ({Tier.BRONZE: CheckMark.STALE}, None),
        ({Tier.SILVER: CheckMark.PASSED}, None),
    ],
)
def test_tier_is_that_below_which_everything_is_kept(marks: dict[Tier, CheckMark], tier: Tier | None) -> None:
    report = ConformanceReport("rig", [kept(each).result(mark, "said") for each, mark in marks.items()])
    assert report.tier is tier
    assert json.loads(json.dumps(report.facts()))["tier"] == (None if tier is None else tier.label)


def test_words_name_the_promise_the_reason_and_the_place_of_what_failed() -> None:
    results = [kept(Tier.BRONZE).result(CheckMark.PASSED, ""), kept(Tier.SILVER).result(CheckMark.FAILED, "it wrote")]
    words = ConformanceReport("rig", results).words()
    assert words.splitlines() == [
        "rig: bronze",
        "  bronze: 1 passed",
        "  silver: 1 failed",
        "FAILED x.y: it wrote",
        "  promise: It stops.",
        "  matters: People stand beside it.",
        "  look at: halt()",
        "To silver: x.y.",
    ]


def test_words_say_what_waits_for_which_check() -> None:
    failed = kept(Tier.SILVER, "silver.halts").result(CheckMark.FAILED, "it wrote")
    waiting = [
        replace(kept(tier, name).result(CheckMark.NOT_PROVEN, "it waits"), waits_for="silver.halts")
        for tier, name in ((Tier.SILVER, "silver.again"), (Tier.GOLD, "gold.starts"))
    ]
    lines = ConformanceReport("rig", [failed, *waiting]).words().splitlines()
    assert lines[-2:] == ["To silver: silver.halts.", "Waiting for that: silver.again, gold.starts."]
    assert not any(line.startswith("NOT PROVEN") for line in lines)


def test_every_promise_says_what_why_and_where_and_its_name_begins_with_its_tier() -> None:
    names = [each.name for each in promises()]
    assert len(set(names)) == len(names)
    for each in promises():
        assert each.name.partition(".")[0] == each.tier.label
        assert all((each.text, each.why, each.look))
    assert {each.tier for each in promises(Tier.SILVER)} == {Tier.BRONZE, Tier.SILVER}


@pytest.mark.parametrize("arguments", [{"only": ["silver.halt"]}, {"exempt": {"silver.halt": "why"}}])
def test_unknown_check_is_refused_with_the_near_one(arguments: dict[str, Any]) -> None:
    exempt = arguments.pop("exempt", {})
    with pytest.raises(ValidationError, match=r"no check silver\.halt\..*silver\.halts"):
        conform(Subject(object, exempt=exempt), **arguments)


@pytest.mark.parametrize(
    "arguments",
    [{"make": 3}, {"deadline_s": 0}, {"watch_s": float("nan")}, {"name": 3}, {"exempt": {"x": ""}}],
    ids=str,
)
def test_bad_argument_of_a_subject_is_refused_by_name(arguments: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=next(iter(arguments))):
        Subject(**{"make": object, **arguments})


class Bus:
    def __init__(self) -> None:
        self.sent: list[int] = []

    def write(self, value: int) -> int:
        self.sent.append(value)
        return value


def test_recorder_records_each_write_and_lets_it_through() -> None:
    recorder, bus = BusRecorder(), Bus()
    recorder.watch(bus, "write")
    assert bus.write(3) == 3
    mark = recorder.count
    bus.write(4)
    assert (bus.sent, [each.what for each in recorder.since(mark)]) == ([3, 4], ["write"])
    with pytest.raises(ValidationError, match="methods"):
        recorder.watch(bus, "no_such_method")


def test_write_that_raises_does_not_reach_the_bus_and_is_not_recorded() -> None:
    recorder, bus = BusRecorder(), Bus()
    recorder.watch(bus, "write")
    with recorder.raising(OSError("cable")), pytest.raises(OSError, match="cable"):
        bus.write(3)
    assert (bus.sent, recorder.count) == ([], 0)
    assert LongMotion("turn").arguments == {}


def test_words_name_together_what_is_not_proven_for_one_reason() -> None:
    results = [kept(Tier.SILVER, name).result(CheckMark.NOT_PROVEN, "no recorder") for name in ("x.a", "x.b")]
    failed = [kept(Tier.SILVER, name).result(CheckMark.FAILED, "it wrote") for name in ("x.c", "x.d")]
    lines = ConformanceReport("rig", [*results, *failed]).words().splitlines()
    assert "NOT PROVEN x.a, x.b: no recorder" in lines
    assert [each for each in lines if each.startswith("FAILED")] == ["FAILED x.c: it wrote", "FAILED x.d: it wrote"]


def test_exceptions_that_were_logged_are_kept_with_their_place_once_and_those_of_a_check_are_not() -> None:
    raised, log = RaisedExceptions(), logging.getLogger("of a robot")
    log.propagate = False
    log.addHandler(raised)
    for problem in (ValueError("no sensor"), ValueError("no sensor"), OSError(5, CABLE_OUT)):
        try:
            raise problem
        except Exception:
            log.exception("It failed.")
    log.error("It failed without one.")
    (told,) = raised.take()
    assert re.fullmatch(r"ValueError: no sensor \(test_report\.py:\d+ in test_\w+\)", told)
    assert raised.take() == []
