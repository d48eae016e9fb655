"""The toy robot that the drivers of these tests serve."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fixtures.toy_robots import ToyRobot


@pytest.fixture
def robot() -> Iterator[ToyRobot]:
    toy = ToyRobot()
    yield toy
    toy.close()
