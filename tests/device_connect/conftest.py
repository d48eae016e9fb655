"""The toy robot that the drivers of these tests serve, and the patience of those who wait for its halt."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fixtures.toy_robots import ToyRobot


@pytest.fixture(autouse=True)
def patient_halts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A halt that comes late on a busy machine is a halt; a test of the deadline sets its own."""
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "20")


@pytest.fixture
def robot() -> Iterator[ToyRobot]:
    toy = ToyRobot()
    yield toy
    toy.close()
