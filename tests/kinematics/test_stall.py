"""A joint that stands still against its setpoints is found; delay, sag and rest are not contact."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from strands_robots.kinematics.stall import StallWatch

HZ = 50


def setpoint(seconds: float, way: float, duration: float) -> float:
    share = min(max(seconds / duration, 0.0), 1.0)
    return way * share**3 * (share * (6 * share - 15) + 10)


def first_stall(observed: Callable[[float], float], way: float, duration: float, lag: float = 0.01) -> float | None:
    """Return the time at which one joint of two is found still; the other one rests."""
    watch = StallWatch(lag)
    for step in range(round(duration * HZ)):
        now = step / HZ
        told = np.array([0.3, setpoint(now, way, duration)])
        if watch.stalled(now, told, np.array([0.3, observed(now)])) == 1:
            return now
    return None


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
