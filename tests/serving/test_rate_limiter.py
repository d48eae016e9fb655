"""The rate limiter that both networks use."""

from __future__ import annotations

from strands_robots.rate_limits import RateLimiter


class Clock:
    """A clock that the test turns."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_steady_source_at_the_rate_loses_nothing_to_jitter() -> None:
    clock = Clock()
    limiter = RateLimiter(50, clock=clock)
    admitted = 0
    for number in range(500):
        clock.now += 0.02 + (0.004 if number % 2 else -0.004)
        admitted += limiter.admit()
    assert admitted >= 495


def test_fast_source_is_thinned_out_to_the_rate() -> None:
    clock = Clock()
    limiter = RateLimiter(10, clock=clock)
    admitted = 0
    for _ in range(1000):
        clock.now += 0.001
        admitted += limiter.admit()
    assert 10 <= admitted <= 12


def test_rate_of_zero_admits_none() -> None:
    assert RateLimiter(0).admit() is False


def test_keys_have_limits_of_their_own() -> None:
    clock = Clock()
    limiter = RateLimiter(1, burst=1, clock=clock)
    assert limiter.admit("arm-1") and not limiter.admit("arm-1")
    assert limiter.admit("arm-2")


def test_forgotten_key_starts_over() -> None:
    clock = Clock()
    limiter = RateLimiter(1, burst=1, clock=clock)
    limiter.admit("arm-1")
    limiter.forget("arm-1")
    assert limiter.admit("arm-1")
