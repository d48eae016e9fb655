"""Callers that may move a robot or stop it, and policies that they may ask for."""

from __future__ import annotations

import logging
from fnmatch import fnmatchcase

import pytest
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.safety.authorization import (
    Authorization,
    caller_name,
    estop_refusal,
    matcher,
    matches,
    motion_refusal,
    provider_refusal,
)

nobodies = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.lists(st.text()),
    st.dictionaries(st.text(), st.text()),
    st.text(alphabet=" \t\n"),
    st.text(alphabet=st.characters(categories=["Cc", "Cs"]), min_size=1),
    st.text(alphabet="ab", min_size=256, max_size=300),
)
names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_-]{0,20}", fullmatch=True)
blanks = st.lists(st.text(alphabet=" \t"))


@given(nobodies)
def test_what_is_no_printable_name_names_nobody(source: object) -> None:
    assert caller_name(source) is None


@given(st.one_of(nobodies, names), blanks)
def test_without_a_list_a_simulation_moves_for_anybody_and_hardware_for_nobody(
    source: object, blank: list[str]
) -> None:
    assert motion_refusal(source, blank, hardware=False) is None
    refusal = motion_refusal(source, blank, hardware=True)
    assert refusal is not None
    assert "DEVICE_CONNECT_RPC_ALLOW" in refusal


@given(nobodies, st.lists(names), st.booleans())
def test_only_the_entry_anonymous_admits_the_unnamed(source: object, others: list[str], hardware: bool) -> None:
    others = [name for name in others if name != "anonymous"]
    assert motion_refusal(source, ["*", *others], hardware=hardware) is not None
    assert motion_refusal(source, ["anonymous", *others], hardware=hardware) is None


@given(names, st.booleans())
def test_a_star_admits_every_named_caller(name: str, hardware: bool) -> None:
    assert motion_refusal(name, ["*"], hardware=hardware) is None


@given(names, st.lists(st.one_of(names, names.map(lambda n: n[:2] + "*")), min_size=1))
def test_a_named_caller_needs_a_glob_that_fits_letter_by_letter(name: str, allow: list[str]) -> None:
    fits = any(fnmatchcase(name, word) for word in allow if word != "anonymous")
    assert (motion_refusal(name, allow, hardware=True) is None) == fits


def test_letter_case_counts() -> None:
    assert motion_refusal("Operator", ["operator"], hardware=True) is not None
    assert estop_refusal("Safety-1", ["safety-*"]) is not None


@given(names, blanks)
def test_without_a_list_every_named_source_may_stop(name: str, blank: list[str]) -> None:
    assert estop_refusal(name, blank) is None


@given(nobodies, st.lists(st.sampled_from(["*", "anonymous", "safety-*"])))
def test_an_unnamed_source_never_stops_by_event(source: object, allow: list[str]) -> None:
    assert estop_refusal(source, allow) is not None


def test_a_list_of_providers_closes_the_others() -> None:
    assert provider_refusal("mock", []) is None
    assert provider_refusal("mock", ["mock", "lerobot*"]) is None
    assert provider_refusal("lerobot_local", ["mock", "lerobot*"]) is None
    refusal = provider_refusal("remote", ["mock"])
    assert refusal is not None
    assert "'remote'" in refusal


def test_the_lists_are_read_when_they_are_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Authorization(hardware=True)
    assert robot.motion("operator", "execute") is not None
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", " operator ,")
    assert robot.motion("operator", "execute") is None


def test_an_open_simulation_says_so_once(caplog: pytest.LogCaptureFixture) -> None:
    robot = Authorization(hardware=False, read_list=lambda _: (), robot="arm-1")
    with caplog.at_level(logging.WARNING):
        assert robot.motion(None, "execute") is None
        assert robot.motion(None, "execute") is None
    assert sum("moves for any caller" in message for message in caplog.messages) == 1


def test_a_refused_caller_is_logged_as_self_declared(caplog: pytest.LogCaptureFixture) -> None:
    robot = Authorization(hardware=True, read_list=lambda _: ("operator",), robot="arm-1")
    with caplog.at_level(logging.WARNING):
        assert robot.motion("stranger", "execute") is not None
    assert "'stranger' (self-declared)" in caplog.text


@given(names, st.lists(st.one_of(names, names.map(lambda n: n[:2] + "*"), st.sampled_from(["*", "?x", "[a-c]*"]))))
def test_compiled_list_admits_the_names_that_the_list_admits(name: str, allow: list[str]) -> None:
    assert bool(matcher(allow)(name)) == matches(name, allow)
