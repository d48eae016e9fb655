"""The operator's choice that only signed stops count."""

from __future__ import annotations

from pathlib import Path

import pytest

from strands_robots.safety.estop_listener import EstopListener
from strands_robots.safety.orders import REQUIRE_SIGNED, StopRules
from strands_robots.safety.persistence import LockoutStore
from strands_robots.safety.plane import SafetyPlane
from strands_robots.utils import ValidationError


@pytest.mark.parametrize("keys", ["", "mistyped"])
def test_listener_without_a_usable_key_is_refused_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keys: str
) -> None:
    monkeypatch.setenv(REQUIRE_SIGNED, "true")
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", keys)
    listener = EstopListener(SafetyPlane(LockoutStore(tmp_path)))

    def link() -> None:
        raise AssertionError("no link is made")

    with pytest.raises(ValidationError, match=f"{REQUIRE_SIGNED}.*no usable key"):
        listener.register("arm-1", "net", link)  # type: ignore[arg-type]
    assert listener.registrations == ()


def test_mistyped_key_without_that_choice_leaves_the_fleet_stoppable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_PUBLIC_KEYS", "mistyped")
    rules = StopRules()
    rules.require_keys()
    assert not (rules.signed or rules.required)
