"""A joint that stands still against its setpoints is found; delay, sag and rest are not contact."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from strands_robots.kinematics.chain import Floats
from strands_robots.kinematics.motion import RISE_A, StallWatch

HZ = 50


def setpoint(seconds: float, way: float, duration: float) -> float:
    share = min(max(seconds / duration, 0.0), 1.0)
    return way * share**3 * (share * (6 * share - 15) + 10)


Current = Callable[[float, float], float]
"""Current of a joint (A) by the time and its distance from the setpoint."""

A_RAD = 22.0
"""Current for one radian of distance from the setpoint: an STS3215 that draws 2.4 A from 6 degrees on."""


def first_stall(
    observed: Callable[[float], float],
    way: float,
    duration: float,
    lag: float = 0.01,
    current: Current | None = None,
    reads: list[float] | None = None,
) -> float | None:
    """Return the time at which one joint of two is found still; the other one rests."""
    watch = StallWatch(lag)
    for step in range(round(duration * HZ)):
        now = step / HZ
        told, joints = np.array([0.3, setpoint(now, way, duration)]), np.array([0.3, observed(now)])

        def currents(now: float = now, distance: float = told[1] - joints[1]) -> Floats:
            if reads is not None:
                reads.append(now)
            return np.array([0.0, np.nan if current is None else current(now, distance)])

        if watch.stalled(now, told, joints, currents if current is not None else None) == 1:
            return now
    return None


def pressing(_: float, distance: float) -> float:
    return A_RAD * distance


def at_wall(
    way: float, duration: float, share: float = 0.5, delay: float = 0.05
) -> tuple[Callable[[float], float], float]:
    """Return the positions of a joint that meets a wall at a share of its way, and when it does."""
    met = next(t for t in np.arange(0, duration, 0.001) if abs(setpoint(t - delay, way, duration)) >= share * abs(way))
    return lambda now: setpoint(min(now, met) - delay, way, duration), met


@pytest.mark.parametrize("way", [1.2, -1.2, 0.2])
@pytest.mark.parametrize("duration", [1.0, 3.0, 6.0])
@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_contact_is_found_within_300_ms(way: float, duration: float, share: float) -> None:
    wall = share * way
    met = next(t for t in np.arange(0, duration, 0.001) if abs(setpoint(t, way, duration)) >= abs(wall))
    stopped = first_stall(lambda t: setpoint(min(t, met), way, duration), way, duration)
    assert stopped is not None
    assert met < stopped <= met + 0.3


@pytest.mark.parametrize("delay", [0.0, 0.04, 0.1])
@pytest.mark.parametrize("duration", [0.5, 1.0, 5.0])
@pytest.mark.parametrize("sag", [0.0, 0.08, -0.08])
def test_delay_and_sag_are_no_contact(delay: float, duration: float, sag: float) -> None:
    def observed(now: float) -> float:
        # The arm sags as it stretches out.
        at = setpoint(now - delay, 1.2, duration)
        return at - sag * at / 1.2

    assert first_stall(observed, 1.2, duration) is None


@pytest.mark.parametrize("speed", [0.006, 0.02, 0.04])
@pytest.mark.parametrize("lag", [0.01, 0.05])
def test_contact_of_a_slow_joint_is_found_once_it_lags_behind(speed: float, lag: float) -> None:
    watch, met = StallWatch(lag), 3.0
    stopped = None
    for step in range(round((met + 3.0 + lag / speed) * HZ)):
        now = step / HZ
        told, at = np.array([speed * now]), np.array([speed * min(now, met)])
        if watch.stalled(now, told, at) == 0:
            stopped = now
            break
    assert stopped is not None
    assert met < stopped <= met + max(lag / speed, 0.01 / speed + 0.2) + 0.1


@pytest.mark.parametrize("speed", [0.006, 0.02, 0.04])
def test_slow_joint_that_sags_while_another_stretches_the_arm_is_no_contact(speed: float) -> None:
    watch = StallWatch(0.01)
    for step in range(6 * HZ):
        now = step / HZ
        stretched = setpoint(now, 1.2, 6.0)
        told = np.array([speed * now, stretched])
        assert watch.stalled(now, told, np.array([speed * now - 0.08 * stretched / 1.2, stretched])) is None


def test_gear_that_sticks_for_two_degrees_is_no_contact_of_a_real_arm() -> None:
    def observed(now: float) -> float:
        return max(0.0, setpoint(now - 0.05, 0.8, 3.0) - 0.035)

    assert first_stall(observed, 0.8, 3.0, lag=0.05) is None


def test_body_whose_time_stands_still_is_not_judged() -> None:
    watch = StallWatch(0.01)
    for step in range(50):
        assert watch.stalled(1.0, np.array([step * 0.02]), np.zeros(1)) is None


@pytest.mark.parametrize("way", [1.2, -1.2])
@pytest.mark.parametrize("duration", [20.0, 40.0, 80.0])
def test_contact_of_a_real_arm_at_low_speed_is_found_sooner_by_its_current(way: float, duration: float) -> None:
    observed, met = at_wall(way, duration)
    by_lag = first_stall(observed, way, duration, lag=0.05)
    by_current = first_stall(observed, way, duration, lag=0.05, current=pressing)
    assert by_lag is not None
    assert by_current is not None
    assert met < by_current <= met + 0.75 * (by_lag - met)


@pytest.mark.parametrize("duration", [1.0, 3.0, 6.0, 12.0])
def test_current_makes_no_contact_be_found_later(duration: float) -> None:
    observed, met = at_wall(1.2, duration)
    by_lag = first_stall(observed, 1.2, duration, lag=0.05)
    by_current = first_stall(observed, 1.2, duration, lag=0.05, current=pressing)
    assert by_lag is not None
    assert by_current is not None
    assert met < by_current <= by_lag


@pytest.mark.parametrize("duration", [1.0, 6.0, 12.0, 40.0])
@pytest.mark.parametrize("sag", [0.0, 0.08, -0.08])
def test_following_joint_under_a_high_or_rising_current_is_no_contact_and_not_read(duration: float, sag: float) -> None:
    reads: list[float] = []

    def observed(now: float) -> float:
        at = setpoint(now - 0.08, 1.2, duration)
        return at - sag * at / 1.2

    for current in (lambda *_: 2.4, lambda now, _: 2.4 * now / duration):
        assert first_stall(observed, 1.2, duration, lag=0.05, current=current, reads=reads) is None
    assert reads == []


@pytest.mark.parametrize("load_a", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("share", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("duration", [6.0, 12.0, 40.0])
def test_gear_that_sticks_under_a_payload_is_no_contact(load_a: float, share: float, duration: float) -> None:
    # The joint was lowered before, so friction helps to carry its load; it rises once the current is load and friction.
    low, high = (1 - share) * load_a / A_RAD, (1 + share) * load_a / A_RAD
    slack = min(high - low, 0.045)

    def observed(now: float) -> float:
        return max(0.0, setpoint(now, 1.2, duration) - slack)

    def current(_: float, distance: float) -> float:
        return A_RAD * (low + distance)

    assert first_stall(observed, 1.2, duration, lag=0.05, current=current) is None


@pytest.mark.parametrize(
    "current",
    [
        lambda *_: float("nan"),
        lambda *_: float("inf"),
        lambda *_: 0.0,
        lambda *_: 2.4,
        lambda _, distance: 0.9 * RISE_A * min(distance / 0.05, 1.0),
    ],
)
def test_current_that_is_absent_or_does_not_rise_leaves_the_lag_alone(current: Current) -> None:
    observed, _ = at_wall(1.2, 20.0)
    by_lag = first_stall(observed, 1.2, 20.0, lag=0.05)
    assert by_lag is not None
    assert first_stall(observed, 1.2, 20.0, lag=0.05, current=current) == by_lag


def test_direction_of_a_current_does_not_count() -> None:
    observed, _ = at_wall(1.2, 20.0)
    forward = first_stall(observed, 1.2, 20.0, lag=0.05, current=pressing)
    assert first_stall(observed, 1.2, 20.0, lag=0.05, current=lambda now, off: -pressing(now, off)) == forward


def test_current_that_reverses_rises_from_zero() -> None:
    # A joint that lowers its load meets a table: its motor lets go of the load before it presses.
    observed, met = at_wall(-1.2, 20.0)
    by_lag = first_stall(observed, -1.2, 20.0, lag=0.05)
    by_current = first_stall(observed, -1.2, 20.0, lag=0.05, current=lambda _, off: 0.45 + A_RAD * off)
    assert by_lag is not None
    assert by_current is not None
    assert met < by_current < by_lag


def test_one_reading_that_leaps_is_no_contact() -> None:
    observed, met = at_wall(1.2, 20.0)
    by_lag = first_stall(observed, 1.2, 20.0, lag=0.05)
    leap = round((met + 0.35) * HZ) / HZ
    found = first_stall(observed, 1.2, 20.0, lag=0.05, current=lambda now, _: 2.0 if now == leap else 0.1)
    assert found == by_lag


def test_currents_that_are_not_known_are_asked_for_once() -> None:
    reads: list[int] = []

    def unknown() -> Floats:
        reads.append(1)
        return np.array([np.nan])

    watch = StallWatch(0.05)
    found = None
    for step in range(100):
        told = np.array([0.1 * step / HZ])
        stalled = watch.stalled(step / HZ, told, np.minimum(told, 0.05), unknown)
        found = found or (step / HZ if stalled == 0 else None)
    assert reads == [1]
    assert found is not None
    assert 1.0 <= found <= 1.1, "the lag alone of 0.05 rad at 0.1 rad/s"


@pytest.mark.parametrize("sinks_s", [0.04, 0.1, 0.3, 1.0])
@pytest.mark.parametrize("duration", [2.0, 6.0, 12.0, 20.0, 40.0])
@pytest.mark.parametrize("sag", [0.02, 0.035, 0.045])
def test_joint_that_sinks_under_its_payload_as_a_motion_begins_is_no_contact(
    sag: float, duration: float, sinks_s: float
) -> None:
    # The first setpoint is where the arm sagged to, so it sags anew, and its current rises from nothing to the load's.
    def observed(now: float) -> float:
        return setpoint(now - 0.04, 1.2, duration) - sag * (1 - math.exp(-now / sinks_s))

    assert first_stall(observed, 1.2, duration, lag=0.05, current=pressing) is None
