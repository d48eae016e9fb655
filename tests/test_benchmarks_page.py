"""The page of figures: measured parts are replaced, everything else on it stays."""

from __future__ import annotations

from pathlib import Path

from benchmarks.__main__ import PARTS, write


def test_a_measured_part_takes_its_place_and_what_was_written_by_hand_stays(tmp_path: Path) -> None:
    page = tmp_path / "benchmarks.md"
    write(page, {PARTS["rpc"]: "first\n", PARTS["mesh"]: "second\n"})
    page.write_text(page.read_text() + "\n## By hand\n\nWhy a bound is missed.\n")
    write(page, {PARTS["mesh"]: "third\n", PARTS["device"]: "fourth\n"})
    sections = [each.split("\n\n", 1) for each in page.read_text().split("\n## ")[1:]]
    assert [(title, body.strip()) for title, body in sections] == [
        (PARTS["rpc"], "first"),
        (PARTS["device"], "fourth"),
        (PARTS["mesh"], "third"),
        ("By hand", "Why a bound is missed."),
    ]
