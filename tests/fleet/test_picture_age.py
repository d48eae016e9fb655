"""Age of the newest picture: one that comes again, or late, is no fresh one."""

from __future__ import annotations

import numpy as np
import pytest

from strands_robots.fleet.picture_age import PictureAge


class Camera:
    """Pictures that an operator gets, ten a second."""

    def __init__(self) -> None:
        self.at = 100.0
        self.age = PictureAge(lambda: self.at)

    def show(self, *pictures: int, late_s: float | None = None) -> list[bool]:
        """Have each arrive, and return which were new."""
        new = []
        for number in pictures:
            taken = None if late_s is None else self.at - late_s - 77.0
            new.append(self.age.came(bytes([number]), taken))
            self.at += 0.1
        return new


def test_changed_picture_is_as_old_as_its_arrival() -> None:
    camera = Camera()
    camera.at += 0.4
    assert camera.age.age_s == pytest.approx(0.4), "no picture has come yet"
    assert camera.show(1, 2, 3) == [True, True, True]
    assert camera.age.age_s == pytest.approx(0.1)


def test_picture_that_comes_again_is_no_new_one() -> None:
    camera = Camera()
    camera.show(1, 2)
    assert camera.show(2, 2, 1, 2) == [False] * 4, "a loop of a buffer is none either"
    assert camera.age.age_s == pytest.approx(0.5)
    assert camera.show(3) == [True]


def test_picture_that_was_taken_long_ago_is_as_old_as_that() -> None:
    camera = Camera()
    camera.show(1, 2, 3, late_s=0.05)
    camera.show(4, late_s=0.45)
    assert camera.age.age_s == pytest.approx(0.2), "the one before it was younger"
    camera.show(5, 6, 7, 8, 9, late_s=0.45)
    assert camera.age.age_s == pytest.approx(0.5)


def test_pictures_that_queued_in_an_outage_are_as_old_as_it_was() -> None:
    camera = Camera()
    camera.show(1, 2, 3, late_s=0.05)
    camera.at += 30.0
    camera.show(4, late_s=30.0)
    assert camera.age.age_s == pytest.approx(30.05)


def test_array_is_a_picture() -> None:
    age, pixels = PictureAge(), np.zeros((4, 4, 3), dtype=np.uint8)
    assert [age.came(pixels), age.came(pixels)] == [True, False]
    pixels[2, 2] = 1
    assert age.came(pixels)
