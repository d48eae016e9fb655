"""Budget of events in a window of time."""

from __future__ import annotations

from strands_robots.rate_limits import KEYS_MAX, EventBudget


def test_budget_of_a_key_lasts_until_the_next_window() -> None:
    budget = EventBudget(3)
    for _ in range(3):
        assert budget.allows("forger", 10.0)
        budget.count("forger", 10.0)
    assert not budget.allows("forger", 10.9)
    assert budget.allows("forger", 11.0)
    budget.count("forger", 11.0)
    assert budget.allows("forger", 11.1)


def test_events_of_one_key_cost_no_other() -> None:
    budget = EventBudget(1)
    budget.count("forger", 10.0)
    assert not budget.allows("forger", 10.0)
    assert budget.allows("safety-1", 10.0)


def test_events_under_made_up_keys_use_up_the_budget_of_all() -> None:
    budget = EventBudget(20, 3)
    for number in range(3):
        assert budget.allows(f"forger-{number}", 10.0)
        budget.count(f"forger-{number}", 10.0)
    assert not budget.allows("forger-4", 10.9)
    assert budget.allows("forger-4", 11.0)


def test_invented_keys_are_bounded_and_the_latest_is_remembered() -> None:
    budget = EventBudget(1, 11 * KEYS_MAX)
    for number in range(10 * KEYS_MAX):
        budget.count(f"forger-{number}", 10.0)
    assert not budget.allows(f"forger-{10 * KEYS_MAX - 1}", 10.0)
    assert budget.allows("forger-0", 10.0)


def test_count_tells_how_many_were_too_many_in_the_window_before() -> None:
    budget = EventBudget(1, window_s=10.0)
    assert [budget.count("forger", 10.0) for _ in range(4)] == [0, 0, 0, 0]
    assert budget.count("forger", 20.0) == 3
    assert budget.count("forger", 30.0) == 0


def test_invented_keys_of_a_pooled_budget_share_one() -> None:
    budget = EventBudget(1, pooled=True)
    for number in range(KEYS_MAX):
        assert budget.take(f"source-{number}", 10.0)
    assert budget.take("invented-1", 10.0)
    assert not budget.take("invented-2", 10.0)
