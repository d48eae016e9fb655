"""The toy robot that the drivers of these tests serve, and the patience of those who wait for its halt."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fixtures.toy_robots import ToyRobot


@pytest.fixture(autouse=True)
def patient(patient_halts: None) -> None:
    """No test here fails because the machine was busy when something halted."""


@pytest.fixture
def robot() -> Iterator[ToyRobot]:
    toy = ToyRobot()
    yield toy
    toy.close()
