"""Value domains, identifiers and quaternions; every refusal names the argument, the value and the domain."""

from __future__ import annotations

import math
import string
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from strands_robots import utils
from strands_robots.envelope import jsonable, uncarried
from strands_robots.mesh.wire import WireError, encode, finite
from strands_robots.utils import ValidationError, near, plain_text, redacted

ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(),
    st.binary(),
    st.lists(st.integers()),
    st.dictionaries(st.text(), st.integers()),
    st.just(10**400),
    st.just(float("nan")),
    st.builds(object),
)


class Boxed:
    """A number as numpy has it: what it is in Python is told by its ``tolist``."""

    def __init__(self, value: object) -> None:
        self.value = value

    def tolist(self) -> object:
        return self.value


def test_a_boxed_number_is_the_number_in_it_and_a_boxed_boolean_is_none() -> None:
    assert utils.number("x", Boxed(0.5)) == 0.5
    assert utils.whole("x", Boxed(4)) == 4
    assert utils.flag("x", Boxed(True)) is True
    utils.finite("x", {"a": Boxed([0.5, 1.5])})
    for check, value in ((utils.number, Boxed(True)), (utils.number, Boxed(math.nan)), (utils.whole, Boxed(4.0))):
        with pytest.raises(ValidationError, match="x must be"):
            check("x", value)
    with pytest.raises(ValidationError, match=r"x\.a\[1\] must be finite"):
        utils.finite("x", {"a": Boxed([0.5, math.inf])})
    assert utils.canonical_json({"b": Boxed([1, 2.5]), "a": Boxed(True)}) == b'{"a":true,"b":[1,2.5]}'
    with pytest.raises(TypeError, match="object"):
        utils.canonical_json({"a": object()})


class Torn:
    def tolist(self) -> object:
        raise RuntimeError("on another device")


@pytest.mark.parametrize(
    "value", [MagicMock(), Torn(), Boxed(Boxed(4)), np.timedelta64(4, "us"), np.datetime64("2026-01-01", "ns")]
)
def test_what_becomes_no_number_of_pythons_is_none_and_no_text_of_json(value: object) -> None:
    assert utils.plain_value(value) is value
    for check in (utils.number, utils.integral):
        with pytest.raises(ValidationError, match="x must be"):
            check("x", value)
    with pytest.raises(TypeError, match="is no value of JSON"):
        utils.canonical_json({"a": value})
    with pytest.raises(WireError, match="is no value of JSON"):
        encode({"a": value}, 1000)
    assert isinstance(jsonable({"a": value})["a"], str)
    assert uncarried({"a": value}).startswith("a is ")


def test_picture_among_numbers_is_not_unpacked() -> None:
    class Picture(Boxed):
        size = 900_000

        def tolist(self) -> object:
            raise AssertionError("unpacked")

    for check in (utils.number, utils.whole, utils.integral, utils.flag):
        with pytest.raises(ValidationError, match="x must be"):
            check("x", Picture([]))
    assert finite(Picture([])) is None


@pytest.mark.parametrize("value", [4, 4.0, Boxed(4), Boxed(4.0)])
def test_an_integer_of_a_message_may_be_an_integral_float(value: object) -> None:
    found = utils.integral("steps", value, low=1, high=9)
    assert (found, type(found)) == (4, int)


@pytest.mark.parametrize("value", [2.5, True, "4", None, math.nan, math.inf, 10.0, 0, -4.0, Boxed(True), Boxed([4])])
def test_any_other_value_is_no_integer_of_a_message(value: object) -> None:
    with pytest.raises(ValidationError, match="steps must be an integer from 1 to 9"):
        utils.integral("steps", value, low=1, high=9)


CHECKS: list[Callable[[str, Any], Any]] = [
    utils.number,
    utils.whole,
    utils.flag,
    utils.text,
    utils.mapping,
    utils.identifier,
    utils.device_id,
    utils.port,
    lambda name, value: utils.choice(name, value, ("a", "b")),
    lambda name, value: utils.number(name, value, low=-1, high=1),
    lambda name, value: utils.number(name, value, above=0),
]


@pytest.mark.parametrize("check", CHECKS)
@given(value=ANYTHING)
def test_a_check_gives_the_value_back_or_refuses_it_by_name_and_briefly(
    check: Callable[[str, Any], Any], value: Any
) -> None:
    try:
        result = check("speed", value)
    except ValidationError as refused:
        assert str(refused).startswith("speed must be ")
        assert str(refused).endswith(".")
        assert len(str(refused)) < 400
        assert refused.code == "INVALID"
    else:
        assert result == (float(value) if isinstance(result, float) else value)


@given(st.floats(allow_nan=True, allow_infinity=True), st.floats(-10, 0), st.floats(0, 10))
def test_a_number_is_finite_and_between_its_bounds(value: float, low: float, high: float) -> None:
    if math.isfinite(value) and low <= value <= high:
        assert utils.number("x", value, low=low, high=high) == value
    else:
        with pytest.raises(ValidationError):
            utils.number("x", value, low=low, high=high)


def test_number_that_is_not_finite_is_named_at_any_level() -> None:
    utils.finite("x", {"a": [1.0, {"b": (2.0, None)}], "c": "nan"})
    with pytest.raises(ValidationError, match=r"x\.a\[1\]\.b\[0\] must be finite"):
        utils.finite("x", {"a": [1.0, {"b": (math.nan, math.inf)}]})


def test_value_of_thousands_of_levels_is_refused() -> None:
    deep: list[object] = []
    for _ in range(5000):
        deep = [deep]
    with pytest.raises(ValidationError, match="x must be nested at most"):
        utils.finite("x", deep)


def test_above_leaves_its_bound_out_and_the_others_include_theirs() -> None:
    assert utils.number("x", 1, low=1, high=1) == 1.0
    with pytest.raises(ValidationError, match="above 0"):
        utils.number("x", 0, above=0)


@given(st.integers(), st.integers(-5, 0), st.integers(1, 5))
def test_an_integer_is_between_its_bounds(value: int, low: int, high: int) -> None:
    if low <= value <= high:
        assert utils.whole("n", value, low=low, high=high) == value
    else:
        with pytest.raises(ValidationError):
            utils.whole("n", value, low=low, high=high)


@pytest.mark.parametrize("value", [True, False, 2.0, "2", None, float("nan")])
def test_what_only_looks_like_an_integer_is_none(value: object) -> None:
    with pytest.raises(ValidationError):
        utils.whole("n", value)


@pytest.mark.parametrize("value", [0, 1, "true", None])
def test_only_a_boolean_is_a_flag(value: object) -> None:
    with pytest.raises(ValidationError, match="true or false"):
        utils.flag("on", value)


@given(st.text())
def test_text_that_passes_has_no_control_characters_and_is_not_blank(value: str) -> None:
    try:
        utils.text("instruction", value, longest=50)
    except ValidationError:
        return
    assert 0 < len(value) <= 50
    assert value.strip()
    assert not any(ord(c) < 32 or 127 <= ord(c) < 160 for c in value)


@pytest.mark.parametrize("value", ["a\x00", "a\nb", "\x7f", "\x85", "\ud800", " ", ""])
def test_text_with_control_characters_or_nothing_in_it_is_refused(value: str) -> None:
    with pytest.raises(ValidationError):
        utils.text("instruction", value)


def test_empty_text_passes_only_where_it_may() -> None:
    assert utils.text("note", "", empty=True) == ""


@given(st.text(string.ascii_letters + string.digits + "._-", min_size=1, max_size=140))
def test_an_identifier_begins_with_a_letter_or_digit_and_is_at_most_128_long(value: str) -> None:
    good = value[0].isalnum() and len(value) <= 128
    try:
        assert utils.identifier("id", value) == value
        assert good
    except ValidationError:
        assert not good


@pytest.mark.parametrize("value", ["a/b", "a*", "a b", "a\n", "é", ".a", "-a", "", "a$", "**", "a" * 129])
def test_what_would_widen_a_key_expression_is_no_identifier(value: str) -> None:
    for check in (utils.identifier, utils.device_id):
        with pytest.raises(ValidationError):
            check("peer_id", value)


def test_a_device_id_has_no_dots() -> None:
    assert utils.identifier("id", "arm.left") == "arm.left"
    with pytest.raises(ValidationError, match="without dots"):
        utils.device_id("id", "arm.left")


@pytest.mark.parametrize("value", ["localhost", "10.0.0.1", "::1", "[::1]", "robot-7.lab.example", "a_b"])
def test_a_hostname_or_an_address_can_be_dialled(value: str) -> None:
    assert utils.dial_host_error(value) is None


@pytest.mark.parametrize(
    "value", ["", "http://x", "a/b", "a:80", "user@host", "a b", "-a", "a..b", "a" * 254, None, 5, b"x", "x\n", "?"]
)
def test_what_is_more_than_a_host_cannot_be_dialled(value: object) -> None:
    assert str(utils.dial_host_error(value)).startswith("host must be")


class _Hostile:
    def __repr__(self) -> str:
        raise RuntimeError("no")


@given(ANYTHING)
def test_what_is_shown_of_a_value_is_short(value: object) -> None:
    assert len(utils.shown(value)) < 200


def test_what_is_shown_of_a_hostile_value_is_short_too() -> None:
    assert "RuntimeError" in utils.shown(_Hostile())
    assert utils.shown("x" * 10**6).endswith("(1000000 long)")
    assert utils.shown([1] * 100) == "a list of 100"
    assert utils.shown(10**5000).startswith("an integer of")
    assert len(utils.shown([["x" * 1000] * 3])) < 200


def test_a_missing_extra_is_one_sentence_that_names_it() -> None:
    error = utils.missing_extra("A simulated robot", "sim")
    assert str(error) == "A simulated robot needs the [sim] extra: in the clone, .venv/bin/pip install -e '.[sim]'."
    assert isinstance(error, ImportError)


def test_outside_a_clone_an_extra_is_installed_by_the_name_of_our_own_distribution(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(utils, "__file__", str(tmp_path / "site-packages" / "strands_robots" / "utils.py"))
    assert utils.install_line("sim") == "pip install 'strands-robots-edge[sim]'"


def test_a_leader_needs_a_callable_get_action() -> None:
    class Leader:
        def get_action(self) -> dict[str, float]:
            return {}

    assert utils.teleoperator_contract_error(Leader()) is None
    assert "get_action" in str(utils.teleoperator_contract_error(object()))


@pytest.mark.parametrize("yaw", [-3.0, -0.5, 0.0, 1.0, 3.1])
@pytest.mark.parametrize("scale", [1.0, -1.0, 2.5])
def test_yaw_of_a_rotation_about_z_does_not_depend_on_sign_and_length(yaw: float, scale: float) -> None:
    quat = [scale * math.cos(yaw / 2), 0.0, 0.0, scale * math.sin(yaw / 2)]
    assert utils.yaw_of(quat) == pytest.approx(yaw)


def test_yaw_is_the_heading_of_the_x_axis_when_the_body_pitches_as_well() -> None:
    yaw, pitch = 0.7, 0.4
    a, b = yaw / 2, pitch / 2
    quat = [math.cos(a) * math.cos(b), -math.sin(a) * math.sin(b), math.cos(a) * math.sin(b), math.sin(a) * math.cos(b)]
    assert utils.yaw_of(quat) == pytest.approx(yaw)


def test_w_positive_picks_the_quaternion_with_a_positive_w() -> None:
    assert utils.w_positive((-0.5, 0.5, -0.5, 0.5)) == [0.5, -0.5, 0.5, -0.5]
    assert utils.w_positive((0.0, 1.0, 0.0, 0.0)) == [0.0, 1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    "text",
    ["nats://ada:secret@host:4222", "no answer from tls://secret@host, nats://ada:secret@other:1", "'//x:secret@h'"],
)
def test_credentials_of_urls_are_left_out(text: str) -> None:
    assert "secret" not in redacted(text) and "***@" in redacted(text)


def test_text_without_credentials_stays() -> None:
    assert redacted("nats://host:4222, mail ada@host") == "nats://host:4222, mail ada@host"


def test_plain_text_has_nothing_that_a_terminal_acts_on() -> None:
    hostile = "a\x1b[2J\x1b]52;c;AAAA\x07\u202e\x00\u200b\r\nb\x9b31m"
    assert (plain_text(hostile), plain_text(hostile, lines=True)) == ("a b", "a \nb")
    assert plain_text(5) == plain_text(None) == ""


def test_cut_text_ends_in_dots() -> None:
    assert plain_text("x" * 100_000, 10) == "xxxxxxx..."


def test_sentence_of_names_has_those_near_or_the_first_ones() -> None:
    assert near("moveTwo", ["moveTo", "stop"]) == " Near it: moveTo."
    assert near("zzz", ["stop"]) == " There is: stop."
    assert near("zzz", []) == ""
    assert near("zzz", (f"v{number:03}" for number in range(500))).endswith("v019 and 480 more.")
