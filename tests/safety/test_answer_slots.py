"""Processes of one machine share the answers to a question."""

from __future__ import annotations

import os
from pathlib import Path

from strands_robots.safety.missed_stops import SWEPT_ABOVE, AnswerSlots
from strands_robots.safety.orders import new_epoch


def test_processes_of_one_machine_give_three_answers_to_a_question(tmp_path: Path) -> None:
    slots, (one, other) = [AnswerSlots(tmp_path) for _ in range(10)], (new_epoch(), new_epoch())
    epochs = [new_epoch()]
    assert [each.take([one], epochs) for each in slots].count([one]) == 3
    assert slots[0].take([one, other], epochs) == [other]
    assert slots[0].take([one], [*epochs, new_epoch()]), "nobody else has these stops"
    assert len(list((tmp_path / "answers").iterdir())) == 5


def test_machine_that_cannot_share_its_answers_gives_them_all(tmp_path: Path) -> None:
    (tmp_path / "answers").mkdir()
    (tmp_path / "answers").chmod(0o777)
    assert all(AnswerSlots(tmp_path).take([new_epoch()], []) for _ in range(5))


def test_slots_of_old_questions_are_removed(tmp_path: Path) -> None:
    slots = AnswerSlots(tmp_path)
    for _ in range(SWEPT_ABOVE + 1):
        slots.take([new_epoch()], [])
    for each in (tmp_path / "answers").iterdir():
        os.utime(each, (1.0, 1.0))
    slots.take([new_epoch()], [])
    assert len(list((tmp_path / "answers").iterdir())) == 1
