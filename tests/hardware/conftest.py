"""Fixtures of the tests of real robots."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def patient(patient_halts: None) -> None:
    """A halt has as long as a busy machine takes; where one is to give up, the test says when."""
