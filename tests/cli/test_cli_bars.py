from __future__ import annotations

import io
import math

from rich.console import Console

from strands_robots.cli.bars import WIDTH, bar, joints_table, progress, ranges


def drawn(thing: object) -> str:
    sink = io.StringIO()
    Console(file=sink, width=120).print(thing)
    return sink.getvalue()


def test_a_bar_stands_between_its_limits() -> None:
    assert bar(-1.0, (-1.0, 1.0)).plain.index("●") == 0
    assert bar(1.0, (-1.0, 1.0)).plain.index("●") == WIDTH - 1
    assert bar(99.0, (-1.0, 1.0)).plain.index("●") == WIDTH - 1
    assert len(bar(0.0, (-1.0, 1.0)).plain) == WIDTH


def test_joints_without_a_finite_number_are_left_out() -> None:
    text = drawn(joints_table({"pan": 0.5, "lift": math.nan, "name": "x", "flag": True}, {}))
    assert "+0.500" in text
    assert "lift" not in text and "name" not in text and "flag" not in text


def test_a_hostile_joint_name_is_shown_and_not_obeyed() -> None:
    assert "[red]" in drawn(joints_table({"[red]\x1b[2J": 1.0}, {}))
    assert "\x1b[2J" not in drawn(joints_table({"[red]\x1b[2J": 1.0}, {}))


def test_many_joints_are_counted_and_not_all_drawn() -> None:
    assert "and 976 more" in drawn(joints_table({f"j{i}": 0.0 for i in range(1000)}, {}))


def test_limits_are_read_from_a_simulation_and_from_a_robot() -> None:
    one = {"joints": {"pan": [-1, 1], "lift": None, "odd": [2, 1], "text": ["a", "b"]}}
    assert ranges(one) == {"pan": (-1.0, 1.0)}
    assert ranges({"robots": {"arm": one, "other": {}}}) == {"pan": (-1.0, 1.0)}
    assert ranges({"robots": {"arm": one, "other": {"joints": {"x": [0, 2]}}}}, "other") == {"x": (0.0, 2.0)}
    assert ranges({"robots": "nonsense"}) == {}


def test_progress_never_exceeds_its_end() -> None:
    assert "4.0 / 4.0 s" in drawn(progress("wave", 9.0, 4.0))
