"""Rounds of a stop to a daemon: a round serves a halt only if it knows of its motion."""

from __future__ import annotations

import threading

from strands_robots.drivers.reachy.rest import StopRounds


def test_a_round_from_before_a_motion_does_not_stand_for_the_motions_stop() -> None:
    sent: list[str | None] = []
    answered = threading.Event()

    def work(about: str | None, deadline: float) -> object:
        sent.append(about)
        answered.wait(60)
        return about

    rounds: StopRounds[str | None] = StopRounds(work)
    try:
        rounds.order(None, 60.0)
        stop = rounds.claim("move", 60.0)
        assert stop.about == "move"
        rounds.order("move", 60.0)
        same = rounds.claim("move", 60.0)
        assert same.about == "move"
        rounds.order("move", 60.0)
        assert rounds.claim(None, 60.0).about == "move", "a round that knows more serves as well"
    finally:
        answered.set()
    assert stop.wait() == "move"
