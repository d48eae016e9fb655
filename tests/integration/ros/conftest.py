"""What every test of a graph gets: DDS that stays on this machine."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def confined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
