"""Random edits, cuts, swaps, deletions and rollbacks of the audit's files: all found.

Ten thousand of them: ``pytest tests/audit/test_audit_property.py --hypothesis-profile=ten-thousand --timeout 0``.
"""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.audit_files import entry, signed_journal
from hypothesis import assume, event, given, settings
from hypothesis import strategies as st

from strands_robots.audit.journal import Journal
from strands_robots.audit.verification import verify

pytestmark = pytest.mark.usefixtures("no_disk")

MEMORY = Path("/dev/shm")
ROTATE_BYTES = 1500


@pytest.fixture(scope="module")
def no_disk() -> Iterator[None]:
    """Leave out what is only slow: the disk, and a line in the log for each thing found."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logging.getLogger("strands_robots.audit.journal"), "disabled", True)
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


Files = dict[str, bytes]


def read_all(directory: Path) -> Files:
    """Return what counts: the log, the head, the anchor; an empty log is none."""
    paths = [each for each in directory.rglob("*") if each.is_file() and each.suffix not in (".lock", ".draft")]
    found = {str(each.relative_to(directory)): each.read_bytes() for each in paths}
    return {name: data for name, data in found.items() if data or not name.endswith(".jsonl")}


class Attacker:
    """Changes files by what hypothesis draws; knows every earlier state of them, and no secret."""

    def __init__(self, directory: Path, earlier: list[Files], data: st.DataObject) -> None:
        self.directory = directory
        self.earlier = earlier
        self.data = data

    def act(self) -> None:
        """Do one change."""
        moves = [self.edit, self.cut, self.cut_out, self.add, self.swap_lines, self.delete, self.swap_files]
        move = self.data.draw(st.sampled_from([*moves, self.roll_back, self.roll_back]))
        event(move.__name__)
        move()

    def edit(self) -> None:
        path, data = self._draw_file()
        at = self._draw_place(data)
        new = self.data.draw(st.binary(min_size=1, max_size=3))
        # Always a change: what a signature has there depends on the number of an inode.
        fresh = bytes([new[0] ^ 1]) if new == data[at : at + 1] else new
        path.write_bytes(data[:at] + fresh + data[at + 1 :])

    def cut(self) -> None:
        path, data = self._draw_file()
        path.write_bytes(data[: self._draw_place(data)])

    def cut_out(self) -> None:
        path, data = self._draw_file()
        lines = data.splitlines(keepends=True)
        first = self.data.draw(st.integers(0, len(lines)))
        path.write_bytes(b"".join(lines[:first] + lines[self.data.draw(st.integers(first, len(lines))) :]))

    def add(self) -> None:
        path, data = self._draw_file()
        old = self.data.draw(st.sampled_from([path.name, *self.earlier[-1]]))
        lines = self.earlier[-1].get(old, b"").splitlines(keepends=True) or [b"\n"]
        more = self.data.draw(st.one_of(st.binary(min_size=1, max_size=20), st.sampled_from(lines)))
        path.write_bytes(data + more)

    def swap_lines(self) -> None:
        path, data = self._draw_file()
        lines = data.splitlines(keepends=True)
        path.write_bytes(b"".join(self.data.draw(st.permutations(lines))))

    def delete(self) -> None:
        path, _ = self._draw_file()
        path.unlink()

    def swap_files(self) -> None:
        (one, first), (other, second) = self._draw_file(), self._draw_file()
        one.write_bytes(second)
        other.write_bytes(first)

    def roll_back(self) -> None:
        """Put back any of the files of an earlier state, and remove those that were not there."""
        then = self.data.draw(st.sampled_from(self.earlier))
        names = sorted({*then, *read_all(self.directory)})
        for name in names:
            if self.data.draw(st.booleans()):
                path = self.directory / name
                if name in then:
                    path.write_bytes(then[name])
                else:
                    path.unlink(missing_ok=True)

    def _draw_place(self, data: bytes) -> int:
        # A share of the length: the number of an inode may have one digit more the next time.
        return len(data) * self.data.draw(st.integers(0, 9_999)) // 10_000

    def _draw_file(self) -> tuple[Path, bytes]:
        found = read_all(self.directory)
        assume(found)
        name = self.data.draw(st.sampled_from(sorted(found)))
        return self.directory / name, found[name]


def intact(directory: Path) -> bool:
    return bool(verify(signed_journal(directory, ROTATE_BYTES), keyed=True)["ok"])


def write(journal: Journal, numbers: range, states: list[Files]) -> None:
    for number in numbers:
        journal.append([entry(number, f"arm-{number % 2}")])
        states.append(read_all(journal.directory))


@settings(max_examples=max(200, settings.default.max_examples if settings.default else 0))
@given(st.data())
def test_every_change_of_the_files_is_found_at_once_and_for_good(data: st.DataObject) -> None:
    directory = Path(tempfile.mkdtemp(dir=MEMORY if MEMORY.is_dir() else None))
    try:
        states: list[Files] = [{}]
        journal = signed_journal(directory, ROTATE_BYTES)
        write(journal, range(data.draw(st.integers(1, 30))), states)
        assert intact(directory)
        attacker = Attacker(directory, states, data)
        for _ in range(data.draw(st.integers(1, 3))):
            attacker.act()
        now = read_all(directory)
        assume(now != states[-1])
        rolled_back_whole = now in states
        restarted = data.draw(st.booleans())
        event("rolled back whole" if rolled_back_whole else "changed")
        assert intact(directory) is (rolled_back_whole and bool(now))
        writer = signed_journal(directory, ROTATE_BYTES) if restarted else journal
        for number in range(100, 100 + data.draw(st.integers(1, 12))):
            writer.append([entry(number)])
            # A new process has nothing left to remember it by, unless the inode is another one.
            assert (rolled_back_whole and restarted) or not intact(directory)
    finally:
        shutil.rmtree(directory)
