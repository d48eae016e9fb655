"""No hostile answer of a policy server takes a robot's interpreter for long, or its memory."""

from __future__ import annotations

import pytest
from fixtures.costs import MEMORY_MAX, TIME_MAX_S, cost, policy_decoders

INPUTS = 300
"""``make bench ARGS=attacks`` has 10,000."""


@pytest.mark.parametrize("name", list(policy_decoders()))
def test_no_hostile_input_takes_long_or_much_memory(name: str) -> None:
    found = cost(policy_decoders()[name], INPUTS)
    assert found.inputs > INPUTS
    # Beside other tests a thread's own time doubles; the benchmark holds it to the bound itself.
    assert found.seconds <= 2 * TIME_MAX_S, found
    assert found.memory <= MEMORY_MAX, found
