"""The dead-man check-in, by time alone."""

from __future__ import annotations

import pytest

from strands_robots.safety.checkin import CONTROLLERS_MAX, CheckIn


def test_it_is_off_while_the_timeout_is_zero() -> None:
    check = CheckIn(0.0, now=0.0)
    assert not check.on
    assert check.lapsed(1e9) is None
    assert check.time_left(1e9) is None


def test_a_robot_that_never_hears_a_controller_stops_too() -> None:
    check = CheckIn(1.0, now=0.0)
    assert check.lapsed(0.99) is None
    assert check.lapsed(1.0) == ()


def test_it_lapses_once_when_the_last_of_several_is_silent_and_names_them() -> None:
    check = CheckIn(1.0, now=0.0)
    check.record("b", 0.5)
    check.record("a", 0.9)
    assert check.lapsed(1.6) is None
    assert check.lapsed(2.0) == ("a", "b")
    assert check.lapsed(5.0) is None
    assert check.time_left(5.0) == 0.0


def test_it_watches_again_after_a_new_check_in_or_a_resume() -> None:
    check = CheckIn(1.0, now=0.0)
    assert check.lapsed(1.0) == ()
    check.record("a", 2.0)
    assert check.lapsed(3.0) == ("a",)
    check.rearm(10.0)
    assert check.time_left(10.25) == 0.75
    assert check.lapsed(11.0) == ()


def test_the_status_names_the_controllers_and_the_time_left() -> None:
    check = CheckIn(2.0, now=0.0)
    check.record("safety-1", 1.0)
    assert check.fields(1.5) == {
        "required": True,
        "timeout_s": 2.0,
        "time_left_s": 1.5,
        "controllers": {"safety-1": 0.5},
    }


@pytest.mark.parametrize("count", [CONTROLLERS_MAX, 10 * CONTROLLERS_MAX])
def test_a_flood_of_names_is_held_to_a_few(count: int) -> None:
    check = CheckIn(1.0, now=0.0)
    for number in range(count):
        check.record(f"c{number}", float(number))
    assert len(check.fields(0.0)["controllers"]) == CONTROLLERS_MAX  # type: ignore[arg-type]
