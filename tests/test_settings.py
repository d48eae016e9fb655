"""Settings: defaults, domains, and the safe value of a misspelt switch."""

from __future__ import annotations

import math
from pathlib import Path

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


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that has warned of nothing and set nothing itself."""
    monkeypatch.setattr(settings, "_warned", set())
    monkeypatch.setattr(settings, "_put", set())


def test_no_setting_of_the_older_package_that_is_called_unread_is_read() -> None:
    assert not {setting.name for setting in settings.declared()} & set(settings.UNREAD)
    source = Path(settings.__file__)
    for module in source.parent.rglob("*.py"):
        read = module.read_text(encoding="utf-8") if module != source else ""
        assert not [name for name in settings.UNREAD if f'"{name}"' in read], module


def test_each_unread_setting_says_in_a_sentence_what_to_do() -> None:
    for name, instead in settings.UNREAD.items():
        assert instead.endswith(".") and instead[0].isupper() and "  " not in instead, name


@pytest.mark.parametrize("name", settings.UNREAD)
def test_start_with_an_unread_setting_warns_once(
    fresh: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    monkeypatch.setenv(name, "secret-value")
    settings.warn_of_unread()
    settings.warn_at_join()
    assert [each.getMessage() for each in caplog.records] == [
        f"{name} is set and not read here. {settings.UNREAD[name]}"
    ]


def test_blank_unread_setting_warns_of_nothing(
    fresh: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("STRANDS_MESH_OVERRIDE_CODE", " ")
    settings.warn_at_join()
    assert not caplog.records


@pytest.mark.parametrize(
    ("callers", "sources", "warns"), [("agent-*", "", True), ("agent-*", "safety-*", False), ("", "", False)]
)
def test_callers_that_restrict_no_stop_are_said_once(
    fresh: None,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    callers: str,
    sources: str,
    warns: bool,
) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", callers)
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_ALLOW", sources)
    for _ in range(2):
        settings.warn_at_join()
    assert len(caplog.records) == warns
    assert all("every named source may stop and lock" in each.getMessage() for each in caplog.records)


def test_callers_of_a_flag_are_of_this_version(
    fresh: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "")
    settings.put("DEVICE_CONNECT_RPC_ALLOW", "agent-*")
    settings.warn_at_join()
    assert not caplog.records
