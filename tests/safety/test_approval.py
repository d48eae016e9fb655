"""The operator's approval of verbs that move real hardware."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from strands_robots.safety.authorization import Approval, Grants, Leave, digest
from strands_robots.utils import ValidationError


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def grants(tmp_path: Path, clock: Clock) -> Grants:
    return Grants(tmp_path / "grants", clock)


def approval(grants: Grants, *allow: str, bypass: bool = False) -> Approval:
    return Approval(lambda _: allow, lambda: bypass, lambda: grants)


def test_nothing_is_approved_by_itself(grants: Grants) -> None:
    assert approval(grants).claim("execute", "arm-1") is None


@pytest.mark.parametrize("entry", ["execute", "execute@arm-1"])
def test_a_listed_verb_is_approved_again_and_again(grants: Grants, entry: str) -> None:
    approver = approval(grants, entry)
    for _ in range(3):
        claim = approver.claim("execute", "arm-1")
        assert claim is not None
        claim.settle()


@pytest.mark.parametrize("entry", ["execut", "Execute", "execute@arm-2", "*", "execute@*"])
def test_an_entry_for_something_else_approves_nothing(grants: Grants, entry: str) -> None:
    assert approval(grants, entry).claim("execute", "arm-1") is None


def test_an_entry_may_name_the_caller(grants: Grants) -> None:
    approver = approval(grants, "execute@arm-1:desk")
    assert approver.claim("execute", "arm-1", ("desk", "desk__1")) is not None
    for callers in ((), ("second",), ("desk__1",)):
        assert approver.claim("execute", "arm-1", callers) is None
    assert approver.claim("execute", "arm-2", ("desk",)) is None


def test_caller_of_an_entry_may_be_a_glob_which_no_unnamed_one_fits(grants: Grants) -> None:
    approver = approval(grants, "execute@arm-1:desk-*", "reset@arm-1:*")
    assert approver.claim("execute", "arm-1", ("desk-0a1b",)) is not None
    assert approver.claim("reset", "arm-1", ("alice",)) is not None
    for verb, callers in (("execute", ("my-desk-1",)), ("execute", ()), ("reset", ("anonymous",)), ("reset", ())):
        assert approver.claim(verb, "arm-1", callers) is None
    assert approval(grants, "reset@arm-1:anonymous").claim("reset", "arm-1", ("anonymous",)) is not None


def test_the_bypass_approves_everything(grants: Grants) -> None:
    assert approval(grants, bypass=True).claim("reset", "arm-1") is not None


def test_a_grant_is_good_once(grants: Grants) -> None:
    grants.grant("execute", "arm-1")
    first = grants.claim("execute", "arm-1")
    assert first is not None
    assert grants.claim("execute", "arm-1") is None
    first.settle()
    assert grants.claim("execute", "arm-1") is None
    assert list(grants.folder.iterdir()) == []


def test_a_grant_given_back_may_be_claimed_again(grants: Grants) -> None:
    grants.grant("execute", "arm-1")
    first = grants.claim("execute", "arm-1")
    assert first is not None
    first.settle(begun=False)
    assert grants.claim("execute", "arm-1") is not None


def test_a_grant_is_for_one_verb_of_one_peer(grants: Grants) -> None:
    grants.grant("execute", "arm-1")
    assert grants.claim("reset", "arm-1") is None
    assert grants.claim("execute", "arm-2") is None
    assert grants.claim("execute", "arm") is None
    assert grants.claim("execute", "arm-1") is not None


def test_a_grant_for_a_caller_and_arguments_is_left_alone_by_others(grants: Grants) -> None:
    good, evil = digest({"instruction": "GOOD"}), digest({"instruction": "EVIL"})
    path = grants.grant("execute", "arm-1", caller="desk", arguments_digest=good)
    for callers, arguments in (((), good), (("second",), good), (("desk",), evil), (("desk",), ""), ((), "")):
        assert grants.claim("execute", "arm-1", callers, arguments) is None
        assert grants.fitting("execute", "arm-1", callers, arguments) == []
        assert path.exists()
    assert grants.fitting("execute", "arm-1", ("second", "desk"), good) == [path]
    assert path.exists()
    assert grants.claim("execute", "arm-1", ("second", "desk"), good) is not None


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ({"x": 1}, {"x": 1.0}, True),
        ({"x": -0.0}, {"x": 0}, True),
        ({"x": 1, "y": 2}, {"y": 2.0, "x": 1}, True),
        ({"joints": {"pan": 1}}, {"joints": {"pan": 1.0}}, True),
        ({"at": [1, 2]}, {"at": (1.0, 2.0)}, True),
        ({"x": 1, "approach": None}, {"x": 1}, True),
        ({"x": 1}, {"x": True}, False),
        ({"x": 1}, {"x": "1"}, False),
        ({"x": 1}, {"y": 1}, False),
        ({"x": 0.1}, {"x": 0.1000000001}, False),
        ({"joints": {"pan": 1}}, {"joints": {"pan": 2}}, False),
        ({"x": 2**53}, {"x": 2**53 + 1}, False),
    ],
)
def test_a_digest_is_of_the_values_however_they_were_written(
    one: dict[str, object], other: dict[str, object], same: bool
) -> None:
    assert (digest(one) == digest(other)) is same


@pytest.mark.parametrize("value", [float("nan"), float("inf"), object(), b"raw"])
def test_arguments_that_json_cannot_carry_have_no_digest(value: object) -> None:
    with pytest.raises(ValidationError, match="JSON"):
        digest({"x": value})


def test_a_grant_expires(grants: Grants, clock: Clock) -> None:
    grants.grant("execute", "arm-1", 10)
    clock.now += 10
    assert grants.claim("execute", "arm-1") is None


def test_a_clock_set_back_does_not_stretch_a_grant_beyond_a_day(grants: Grants, clock: Clock) -> None:
    grants.grant("execute", "arm-1")
    clock.now -= 3 * 24 * 3600
    assert grants.claim("execute", "arm-1") is None


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"verb":"execute","peer":"arm-1","expires":"soon"}', "\0"])
def test_a_file_that_is_no_grant_approves_nothing(grants: Grants, text: str) -> None:
    path = grants.grant("execute", "arm-1")
    path.write_text(text)
    assert grants.claim("execute", "arm-1") is None


def test_a_grant_renamed_for_another_verb_approves_nothing(grants: Grants) -> None:
    path = grants.grant("execute", "arm-1")
    path.rename(path.with_name("reset@arm-1+stolen"))
    assert grants.claim("reset", "arm-1") is None


def test_many_claimers_of_one_grant_have_it_once(grants: Grants) -> None:
    grants.grant("execute", "arm-1")
    got: list[Leave] = []

    def take() -> None:
        claim = grants.claim("execute", "arm-1")
        if claim is not None:
            got.append(claim)

    threads = [threading.Thread(target=take) for _ in range(16)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(got) == 1


@pytest.mark.parametrize(
    ("verb", "peer", "seconds"),
    [("", "arm-1", 1), ("../x", "arm-1", 1), ("execute", "*", 1), ("execute", "arm-1", 0), ("execute", "a", 1e9)],
)
def test_a_grant_out_of_domain_is_refused_by_name(grants: Grants, verb: str, peer: str, seconds: float) -> None:
    with pytest.raises(ValidationError, match=r"verb|peer|seconds"):
        grants.grant(verb, peer, seconds)


def test_a_grant_is_for_its_owner_alone(grants: Grants) -> None:
    path = grants.grant("execute", "arm-1")
    assert path.stat().st_mode & 0o077 == 0
    assert grants.folder.stat().st_mode & 0o077 == 0
    assert json.loads(path.read_text())["verb"] == "execute"


def test_the_refusal_names_the_ways_to_approve() -> None:
    refusal = Approval.refusal("execute", "arm-1")
    assert "operator approval" in refusal
    assert "strands-robots grant execute@arm-1" in refusal
    assert "STRANDS_ROBOT_COMMAND_ALLOW" in refusal


def test_the_environment_is_the_default(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path))
    assert Approval().claim("execute", "arm-1") is None
    Grants(tmp_path / "grants").grant("execute", "arm-1")
    assert Approval().claim("execute", "arm-1") is not None


def test_the_folder_around_the_grants_is_closed_to_others_too(tmp_path: Path, clock: Clock) -> None:
    Grants(tmp_path / "state" / "grants", clock).grant("execute", "arm-1")
    assert (tmp_path / "state").stat().st_mode & 0o077 == 0
