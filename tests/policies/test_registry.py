"""Policies by name."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

import pytest
from fixtures.bodies import ScriptedPolicy

from strands_robots.policies import create_policy, policy_names, registry, resolve_provider
from strands_robots.utils import MissingExtraError, ValidationError


def plug_in(**options: Any) -> ScriptedPolicy:
    return ScriptedPolicy([options])


def test_ours_are_known_by_name_and_by_alias() -> None:
    assert policy_names()[:3] == ("mock", "remote", "lerobot_local")
    assert resolve_provider("lerobot") == "lerobot_local"


@pytest.mark.parametrize("provider", ["mok", "", 5, None, True, "x" * 500, ["mock"]])
def test_an_unknown_provider_is_refused_with_what_there_is(provider: Any) -> None:
    with pytest.raises(ValidationError, match="mock, remote, lerobot_local") as refused:
        create_policy(provider)
    assert len(str(refused.value)) < 400


def test_a_near_name_is_offered() -> None:
    with pytest.raises(ValidationError, match="Did you mean mock"):
        create_policy("mok")


def test_port_zero_is_the_providers_default_and_a_provider_without_ports_ignores_one() -> None:
    assert create_policy("mock", policy_port=0)
    assert create_policy("mock", policy_port=9000)
    assert create_policy("remote", policy_port=0).url == "ws://127.0.0.1:8765"  # type: ignore[attr-defined]
    assert create_policy("remote", policy_port=9000).url == "ws://127.0.0.1:9000"  # type: ignore[attr-defined]


def test_an_option_that_the_provider_does_not_take_is_refused() -> None:
    with pytest.raises(ValidationError, match="mock cannot be made"):
        create_policy("mock", checkpoint="x")


def test_a_plug_in_is_found_by_its_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("dreamer", "tests.policies.test_registry:plug_in", registry.ENTRY_POINT_GROUP)
    wrong = EntryPoint("wrong", "builtins:dict", registry.ENTRY_POINT_GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: [entry, wrong])
    assert policy_names()[3:] == ("dreamer", "wrong")
    monkeypatch.setattr(EntryPoint, "load", lambda self: plug_in if self.name == "dreamer" else dict)
    assert create_policy("dreamer", policy_port=3).act({}) == {"policy_port": 3}
    with pytest.raises(ValidationError, match="lacks"):
        create_policy("wrong")


def test_lerobot_without_its_extra_is_one_sentence() -> None:
    with pytest.raises(MissingExtraError, match=r"needs the \[lerobot\] extra"):
        create_policy("lerobot", pretrained_name_or_path="org/name")
