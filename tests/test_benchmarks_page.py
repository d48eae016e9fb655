"""The page of figures: measured parts are replaced, and the other sections stay."""

from __future__ import annotations

import re
from pathlib import Path

from benchmarks.__main__ import INTRODUCTION, PARTS, write

PAGE = Path(__file__).resolve().parent.parent / "docs" / "benchmarks.md"


def test_measured_part_takes_its_place_and_handwritten_section_stays(tmp_path: Path) -> None:
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


def test_the_page_begins_with_the_introduction_that_the_benchmarks_write() -> None:
    written = re.escape(INTRODUCTION).replace(r"\{cores\}", r"\d+").replace(r"\{python\}", r"\d+\.\d+\.\d+")
    assert re.match(written, PAGE.read_text(encoding="utf-8"))
