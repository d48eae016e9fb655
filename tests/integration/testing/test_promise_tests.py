"""Promises as tests of pytest: one for each check, with what a failed one breaks and where to look."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fixtures.child_pytest import ChildRun, child_pytest
from fixtures.faulty_robots import Rig, subject

from strands_robots.testing import conformance_tests
from strands_robots.utils import ValidationError

pytestmark = pytest.mark.system

FILE = """
from dataclasses import replace
from fixtures.faulty_robots import IgnoresHalt, Rig, subject
from strands_robots.testing import BusRecorder, Subject, Tier, conformance_tests

def portless():
    raise OSError("no such port")

TestRig = conformance_tests(lambda: subject(Rig), Tier.SILVER, proven=Tier.SILVER)
TestBare = conformance_tests(Subject(lambda: Rig(BusRecorder())), Tier.SILVER)
TestUnproven = conformance_tests(Subject(lambda: Rig(BusRecorder())), Tier.SILVER, proven=Tier.SILVER)
exempt = {"silver.halts": "it has one wire", "bronze.verbs": "it has none"}
TestExempt = conformance_tests(replace(subject(IgnoresHalt), exempt=exempt), Tier.SILVER)
TestPortless = conformance_tests(Subject(portless), Tier.BRONZE)
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> ChildRun:
    folder = tmp_path_factory.mktemp("promises")
    (folder / "test_promises.py").write_text(FILE, encoding="utf-8")
    return child_pytest(folder, "-rxs", "-k", "made or verbs or silver.halts or silver.again")


def test_each_check_is_a_test_of_its_own(run: ChildRun) -> None:
    wanted = ("bronze.made", "bronze.verbs", "silver.halts", "silver.again")
    assert [run.results[f"TestRig::test_promise[{each}]"] for each in wanted] == ["passed"] * 4, run.said


def test_promise_that_is_not_proven_is_skipped_by_name_and_fails_where_it_has_to_be_proven(run: ChildRun) -> None:
    assert run.results["TestBare::test_promise[silver.halts]"] == "skipped"
    assert "silver.halts is not proven: the subject has no recorder of its bus" in run.said
    assert run.results["TestUnproven::test_promise[silver.halts]"] == "failed"
    assert run.results["TestUnproven::test_promise[silver.again]"] == "skipped"  # it waits for the one that failed


def test_exempt_promise_is_an_expected_failure_with_its_reason_and_a_stale_exemption_fails(run: ChildRun) -> None:
    assert run.results["TestExempt::test_promise[silver.halts]"] == "xfail"
    assert "it has one wire" in run.said
    assert run.results["TestExempt::test_promise[bronze.verbs]"] == "failed"
    assert "STALE EXEMPTION bronze.verbs: it is kept, and exempt because: it has none" in run.said


def test_failed_test_says_promise_reason_and_place_and_no_traceback(run: ChildRun) -> None:
    assert run.results["TestPortless::test_promise[bronze.made]"] == "failed"
    assert run.results["TestPortless::test_promise[bronze.verbs]"] == "skipped"
    failed = run.said.partition("TestPortless.test_promise[bronze.made] _")[2]
    assert "FAILED bronze.made: it could not be served: OSError: no such port" in failed
    for line in ("promise: It is made, and served", "matters: Whatever else", "look at: the callable"):
        assert line in failed
    assert "Traceback" not in run.said


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: conformance_tests(Rig.tool_name_str), "subject"),
        (lambda: conformance_tests(subject(Rig), "gold"), "most"),
        (lambda: conformance_tests(subject(Rig), proven=3), "proven"),
        (lambda: conformance_tests(subject(Rig), most=None), "most"),
    ],
)
def test_wrong_argument_is_refused_by_name(make: Callable[[], Any], named: str) -> None:
    with pytest.raises(ValidationError, match=rf"^{named} must be a "):
        make()
