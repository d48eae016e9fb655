"""The chunk that is played: positions, stale heads, interpolation, and when to ask."""

from __future__ import annotations

from strands_robots.policies.profiled import ChunkPlayer


def chunk(first: int, count: int = 10) -> list[dict[str, float]]:
    """Actions whose value is the step that they belong to."""
    return [{"a": float(first + step)} for step in range(count)]


def steps(playback: ChunkPlayer, count: int) -> list[float | None]:
    values: list[float | None] = []
    for _ in range(count):
        playback.advance()
        action = playback.play()
        values.append(None if action is None else action["a"])
    return values


def test_a_chunk_is_played_one_action_a_step_and_then_there_is_none() -> None:
    playback = ChunkPlayer(rate=30, hz=30)
    assert steps(playback, 1) == [None]
    playback.take(chunk(0, 3), 0.0, 0.0, 0.0)
    assert steps(playback, 5) == [0.0, 1.0, 2.0, None, None]


def test_what_was_played_while_it_was_computed_is_stale() -> None:
    playback = ChunkPlayer(rate=30, hz=30)
    playback.take(chunk(0), 0.0, 0.0, 0.1)
    assert steps(playback, 5) == [0.0, 1.0, 2.0, 3.0, 4.0]
    # The observation was made at step 2, and the answer comes in the control step of 5.
    playback.advance()
    assert playback.take(chunk(102), 2.0, 0.0, 0.1) == 3
    action = playback.play()
    assert action == {"a": 105.0}
    assert playback.stale == 3


def test_a_robot_that_waited_misses_nothing_of_the_path() -> None:
    playback = ChunkPlayer(rate=30, hz=30)
    playback.take(chunk(0, 3), 0.0, 0.0, 0.1)
    assert steps(playback, 50)[-1] is None
    playback.take(chunk(100), 3.0, 0.0, 0.1)
    assert steps(playback, 2) == [100.0, 101.0]


def test_an_answer_that_is_stale_as_a_whole_changes_nothing() -> None:
    playback = ChunkPlayer(rate=30, hz=30, horizon=2)
    playback.take(chunk(0), 0.0, 0.0, 0.1)
    assert steps(playback, 3) == [0.0, 1.0, None]
    assert playback.take(chunk(100), 0.0, 0.0, 0.1) == 2
    assert steps(playback, 1) == [None]
    assert playback.take(chunk(200), playback.position, 0.0, 0.1) == 0
    assert steps(playback, 2) == [200.0, 201.0]


def test_a_faster_robot_interpolates_between_the_actions() -> None:
    playback = ChunkPlayer(rate=25, hz=50)
    playback.take(chunk(0, 3), 0.0, 0.0, 0.0)
    assert steps(playback, 7) == [0.0, 0.5, 1.0, 1.5, 2.0, 2.0, None]


def test_missed_control_steps_skip_their_actions() -> None:
    playback = ChunkPlayer(rate=30, hz=30)
    playback.take(chunk(0), 0.0, 0.0, 0.0)
    assert steps(playback, 2) == [0.0, 1.0]
    playback.advance(1 + 3)
    assert playback.play() == {"a": 5.0}
    playback.advance(1 + 90)
    assert playback.play() is None, "a chunk that is older than its steps has expired"


def test_the_next_chunk_is_asked_for_while_as_much_is_left_as_the_worst_latency_takes() -> None:
    playback = ChunkPlayer(rate=30, hz=30, horizon=10)
    assert playback.due()
    playback.take(chunk(0, 20), 0.0, 0.0, 0.1)
    assert playback.delay == 3
    asked = []
    for _ in range(10):
        playback.advance()
        asked.append(playback.due())
        playback.play()
    # Three steps of latency, and one because an answer is played at the step after it came.
    assert asked == [False] * 6 + [True] * 4


def test_one_slow_answer_is_forgotten_after_ten_others() -> None:
    playback = ChunkPlayer(rate=30, hz=30)
    playback.take(chunk(0), 0.0, 0.0, 1.0)
    assert playback.latency_s == 1.0
    for _ in range(10):
        playback.take(chunk(0), playback.position, 0.0, 0.1)
    assert playback.latency_s == 0.1


def test_age_is_that_of_the_observation_behind_the_chunk() -> None:
    playback = ChunkPlayer(rate=30, hz=30)
    playback.take(chunk(0), 0.0, 5.0, 0.1)
    assert playback.age_s(7.5) == 2.5


def test_a_chunk_shorter_than_the_latency_is_played_to_its_end_before_the_next_is_asked_for() -> None:
    playback = ChunkPlayer(rate=30, hz=30)
    playback.take(chunk(0, 5), 0.0, 0.0, 0.5)
    asked = []
    for _ in range(6):
        playback.advance()
        asked.append(playback.due())
        playback.play()
    assert asked == [False] * 5 + [True]
