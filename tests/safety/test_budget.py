"""What a source may cost the data plane by signatures that do not hold."""

from __future__ import annotations

from strands_robots.safety.budget import SOURCES_MAX, Budget


def test_a_source_has_so_many_a_second_and_then_waits_for_the_next() -> None:
    budget = Budget(per_s=3)
    for _ in range(3):
        assert budget.left("forger", 10.0)
        budget.spend("forger", 10.0)
    assert not budget.left("forger", 10.9)
    assert budget.left("forger", 11.0)
    budget.spend("forger", 11.0)
    assert budget.left("forger", 11.1)


def test_one_sources_failures_cost_no_other() -> None:
    budget = Budget(per_s=1)
    budget.spend("forger", 10.0)
    assert not budget.left("forger", 10.0)
    assert budget.left("safety-1", 10.0)


def test_invented_names_take_no_memory_and_the_latest_offender_is_remembered() -> None:
    budget = Budget(per_s=1)
    for number in range(10 * SOURCES_MAX):
        budget.spend(f"forger-{number}", 10.0)
    assert not budget.left(f"forger-{10 * SOURCES_MAX - 1}", 10.0)
    assert budget.left("forger-0", 10.0)
