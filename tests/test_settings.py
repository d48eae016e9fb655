"""Settings: defaults, domains, and the safe value of a misspelt switch."""

from __future__ import annotations

import math

import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from strands_robots import settings

NAME = "DEVICE_CONNECT_ALLOW_INSECURE"
RATE = "STRANDS_CONTROL_HZ"

TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=20)


def test_every_setting_is_declared_once_with_a_usable_default() -> None:
    names = [each.name for each in settings.declared()]
    assert len(names) == len(set(names))
    for each in settings.declared():
        assert each.meaning.endswith("."), each.name
        if each.kind == "number":
            assert math.isfinite(settings.number(each.name)), each.name
        elif each.kind == "integer":
            assert isinstance(settings.integer(each.name), int)
        elif each.kind == "boolean":
            assert each.default in ("true", "false", "auto", "0", "1"), each.name


@hypothesis_settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(spelling=TEXTS, safe=st.booleans())
def test_unknown_spelling_of_a_boolean_gives_the_safe_value(
    monkeypatch: pytest.MonkeyPatch, spelling: str, safe: bool
) -> None:
    monkeypatch.setenv(NAME, spelling)
    value = settings.boolean(NAME, safe=safe)
    spelled = spelling.strip().lower()
    if not spelled or spelled in settings.FALSE_SPELLINGS:
        assert value is False
    elif spelled in settings.TRUE_SPELLINGS:
        assert value is True
    else:
        assert value is safe


@hypothesis_settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(spelling=st.one_of(TEXTS, st.floats().map(str), st.integers().map(str)))
def test_number_is_always_in_its_domain(monkeypatch: pytest.MonkeyPatch, spelling: str) -> None:
    monkeypatch.setenv(RATE, spelling)
    assert 1 <= settings.number(RATE) <= 2000


def test_number_out_of_its_domain_gives_the_default_and_one_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv(RATE, "1e99")
    assert settings.number(RATE) == settings.number(RATE) == 50.0
    assert len([record for record in caplog.records if "1e99" in record.getMessage()]) == 1


def test_integer_that_is_not_whole_gives_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_DC_PORT", "7000.5")
    assert settings.integer("STRANDS_DC_PORT") == 7447
    monkeypatch.setenv("STRANDS_DC_PORT", "7000")
    assert settings.integer("STRANDS_DC_PORT") == 7000


@pytest.mark.parametrize("blank", ["", " ", "\t"])
def test_blank_value_means_unset(monkeypatch: pytest.MonkeyPatch, blank: str) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", blank)
    assert not settings.is_set("DEVICE_CONNECT_RPC_ALLOW")
    assert settings.items("DEVICE_CONNECT_RPC_ALLOW") == ()
    monkeypatch.setenv(RATE, blank)
    assert settings.number(RATE) == 50.0


def test_list_has_its_items_without_blanks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", " a , ,b*,")
    assert settings.items("DEVICE_CONNECT_RPC_ALLOW") == ("a", "b*")


def test_undeclared_setting_cannot_be_read() -> None:
    for read in (settings.raw, settings.is_set, settings.boolean, settings.number, settings.items):
        with pytest.raises(KeyError):
            read("STRANDS_NO_SUCH_THING")
