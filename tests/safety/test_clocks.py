"""Two clocks, compared by a round trip and by one-way messages."""

from __future__ import annotations

import pytest

from strands_robots.safety.orders import KEPT_S, SOURCES_MAX, ObservedClocks, RoundTrip


def test_a_round_trip_shows_the_lead_of_the_other_clock_and_the_time_on_the_network() -> None:
    trip = RoundTrip(sent=100.0, received_there=130.01, answered_there=130.05, received=100.06)
    assert trip.ahead_s == pytest.approx(30.0)
    assert trip.on_network_s == pytest.approx(0.02)


def test_the_first_message_of_a_source_compares_with_nothing() -> None:
    clocks = ObservedClocks()
    assert clocks.note("safety-1", 30.0, 0.0) is None
    assert clocks.note("safety-1", 31.0, 1.0) == 30.0
    assert clocks.note("safety-2", 5.0, 1.0) is None


def test_the_quickest_message_shows_the_difference_best() -> None:
    clocks = ObservedClocks()
    for difference in (30.5, 30.1, 33.0):
        clocks.note("safety-1", difference, 0.0)
    assert clocks.note("safety-1", 30.2, 0.0) == 30.1


def test_an_old_comparison_gives_way() -> None:
    clocks = ObservedClocks()
    clocks.note("safety-1", 30.0, 0.0)
    clocks.note("safety-1", 40.0, KEPT_S + 1)
    assert clocks.note("safety-1", 40.0, KEPT_S + 2) == 40.0


def test_names_without_end_take_no_memory() -> None:
    clocks = ObservedClocks()
    for number in range(4 * SOURCES_MAX):
        clocks.note(f"source-{number}", 0.0, 0.0)
    assert clocks.note(f"source-{4 * SOURCES_MAX - 1}", 0.0, 0.0) == 0.0
    assert clocks.note("source-0", 0.0, 0.0) is None
