"""Policies by name."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from typing import Any

import pytest
from fixtures.bodies import ScriptedPolicy

from strands_robots import plug_ins, policies
from strands_robots.policies import create_policy, policy_names, resolve_provider
from strands_robots.utils import MissingExtraError, ValidationError


def plug_in(**options: Any) -> ScriptedPolicy:
    return ScriptedPolicy([options])


def test_built_in_policies_have_names_and_aliases() -> None:
    assert policy_names()[:6] == ("mock", "remote", "openpi", "groot", "lerobot_async", "lerobot_local")
    assert resolve_provider("lerobot") == "lerobot_local"


@pytest.mark.parametrize("provider", ["mok", "", 5, None, True, "x" * 500, ["mock"]])
def test_unknown_provider_is_refused_with_the_known_ones(provider: Any) -> None:
    with pytest.raises(ValidationError, match="mock, remote, openpi, groot, lerobot_async, lerobot_local") as refused:
        create_policy(provider)
    assert len(str(refused.value)) < 400


def test_similar_name_is_suggested() -> None:
    with pytest.raises(ValidationError, match="Did you mean mock"):
        create_policy("mok")


def test_port_zero_is_the_default_and_a_provider_without_port_refuses_another() -> None:
    assert create_policy("mock", policy_port=0)
    with pytest.raises(ValidationError, match="policy_port must be 0 for policy_provider mock"):
        create_policy("mock", policy_port=9000)
    assert create_policy("remote", policy_port=0).url == "ws://127.0.0.1:8765"  # type: ignore[attr-defined]
    assert create_policy("remote", policy_port=9000).url == "ws://127.0.0.1:9000"  # type: ignore[attr-defined]


def test_unknown_option_is_refused() -> None:
    with pytest.raises(ValidationError, match="mock cannot be made"):
        create_policy("mock", checkpoint="x")


def test_plug_in_is_found_by_its_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("dreamer", "tests.policies.test_policies:plug_in", policies.PLUG_INS.group)
    wrong = EntryPoint("wrong", "builtins:dict", policies.PLUG_INS.group)
    monkeypatch.setattr(plug_ins, "entry_points", lambda group: [entry, wrong])
    assert policy_names()[6:] == ("dreamer", "wrong")
    monkeypatch.setattr(EntryPoint, "load", lambda self: plug_in if self.name == "dreamer" else dict)
    assert create_policy("dreamer", policy_port=3).act({}) == {"policy_port": 3}
    with pytest.raises(ValidationError, match="lacks"):
        create_policy("wrong")


def test_missing_lerobot_is_reported_with_the_extra() -> None:
    with pytest.raises(MissingExtraError, match=r"needs the \[lerobot\] extra"):
        create_policy("lerobot", pretrained_name_or_path="org/name")
