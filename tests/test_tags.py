"""Tags of a robot: what it may state, and what is read of another one."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from strands_robots.tags import TAG_MAX, TAGS_MAX, own_tags, read_tags, tags_of
from strands_robots.utils import ValidationError


def test_one_tag_or_several_are_stated_each_once(monkeypatch: pytest.MonkeyPatch) -> None:
    assert own_tags("mobile") == ("mobile",)
    assert own_tags(["mobile", "lab-2", "mobile"]) == ("mobile", "lab-2")
    assert own_tags({"b", "a"}) == ("a", "b")
    assert own_tags(()) == ()
    assert own_tags(None) == ()
    monkeypatch.setenv("STRANDS_TAGS", "mobile, lab-2")
    assert own_tags(None) == ("mobile", "lab-2")
    assert own_tags(()) == ()


@pytest.mark.parametrize(
    "tags",
    ["", "two words", "-x", "x" * (TAG_MAX + 1), 3, [3], [["a"]], {"a": 1}, [f"t{i}" for i in range(TAGS_MAX + 1)]],
)
def test_what_is_no_tag_is_refused_by_value(tags: object) -> None:
    with pytest.raises(ValidationError, match="tag"):
        own_tags(tags)  # type: ignore[arg-type]


def test_tags_as_given_win_over_those_of_the_robot_and_the_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_TAGS", "shell")
    robot = SimpleNamespace(tags=("own",))
    assert tags_of(None, robot) == ("own",)
    assert tags_of("given", robot) == ("given",)
    assert tags_of((), robot) == ()
    # An attribute of another meaning is none.
    assert tags_of(None, SimpleNamespace(tags=lambda: 3), SimpleNamespace(tags="text"), None) == ("shell",)


@pytest.mark.parametrize(
    ("stated", "read"),
    [
        (["mobile", "lab-2"], ("mobile", "lab-2")),
        (["ok", "\x1b[31mred", "two words", 3, None, ["x"], "x" * 65, "ok"], ("ok",)),
        ([f"t{i}" for i in range(100)], tuple(f"t{i}" for i in range(TAGS_MAX))),
        ("mobile", ()),
        ({"mobile": 1}, ()),
        (None, ()),
    ],
)
def test_tags_of_others_are_read_within_bounds(stated: object, read: tuple[str, ...]) -> None:
    assert read_tags(stated) == read
