"""Fixtures for pytest; an installed package has them without a conftest.

pytest imports this file at its start, whatever it tests, so nothing else is imported before a fixture is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from strands_robots.testing.robot_lab import RobotLab


@pytest.fixture
def robots() -> Iterator[Callable[..., RobotLab]]:
    """Serve simulated robots, once in a test: ``lab = robots(50)``.

    The arguments are those of ``RobotLab``.
    """
    from strands_robots.testing import RobotLab  # noqa: PLC0415 - loads the network, which few tests need

    with ExitStack() as stack:

        def serve(count: int = 1, more: Mapping[str, str] | None = None) -> RobotLab:
            return stack.enter_context(RobotLab(count, more))

        yield serve
