"""Keys of robots: made once, private, refused by name otherwise; and the keys that an operator enrolled."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from strands_robots.safety import ed25519
from strands_robots.safety.identity import (
    ROBOTS,
    EnrolledKeys,
    KeyChangedError,
    KeyFile,
    KeyFileError,
    SigningIdentity,
    fingerprint,
)
from strands_robots.utils import ValidationError


@pytest.fixture
def key_file(tmp_path: Path) -> KeyFile:
    return KeyFile(ROBOTS, "arm-1", tmp_path)


def mode_of(path: Path) -> int:
    return path.stat().st_mode & 0o777


def test_a_key_is_made_at_the_first_start_and_is_the_same_ever_after(key_file: KeyFile) -> None:
    assert key_file.load() is None
    made = key_file.load_or_make()
    again = key_file.load_or_make()
    assert again.public == made.public
    signature = ed25519.decode(again.sign(b"message"), 64)
    assert signature is not None
    assert ed25519.signed_by_one_of([made.public], signature, b"message")


def test_a_key_and_its_folders_are_for_its_owner_alone(key_file: KeyFile) -> None:
    key_file.load_or_make()
    assert mode_of(key_file.path) == 0o600
    assert mode_of(key_file.path.parent) == mode_of(key_file.path.parent.parent) == 0o700
    assert [each.name for each in key_file.path.parent.iterdir()] == ["arm-1.key"]


def test_keys_are_kept_in_the_state_directory_by_default(state_directory: Path) -> None:
    assert KeyFile("consoles", "ann").path == state_directory / "keys" / "consoles" / "ann.key"


def test_each_name_and_each_folder_has_a_key_of_its_own(tmp_path: Path) -> None:
    places = [(ROBOTS, "arm-1"), (ROBOTS, "arm-2"), ("consoles", "arm-1")]
    assert len({KeyFile(folder, name, tmp_path).load_or_make().public for folder, name in places}) == 3


def test_processes_that_start_at_once_end_up_with_one_key(key_file: KeyFile) -> None:
    ready, made = threading.Barrier(8), list[SigningIdentity]()

    def start() -> None:
        ready.wait()
        made.append(key_file.load_or_make())

    threads = [threading.Thread(target=start) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 8
    assert len({each.public for each in made}) == 1


@pytest.mark.parametrize("mode", [0o640, 0o620, 0o604, 0o602])
def test_a_key_that_others_may_read_or_write_is_refused_by_name(key_file: KeyFile, mode: int) -> None:
    key_file.load_or_make()
    key_file.path.chmod(mode)
    with pytest.raises(KeyFileError, match=rf"arm-1\.key has mode 0{mode:o}"):
        key_file.load()


def test_a_key_in_a_folder_that_others_may_write_is_refused_by_name(key_file: KeyFile) -> None:
    key_file.load_or_make()
    key_file.path.parent.chmod(0o770)
    with pytest.raises(KeyFileError, match="robots has mode 0770"):
        key_file.load_or_make()


def test_a_key_of_another_user_is_refused_by_name(key_file: KeyFile, monkeypatch: pytest.MonkeyPatch) -> None:
    key_file.load_or_make()
    monkeypatch.setattr(os, "getuid", lambda: 4711)
    with pytest.raises(KeyFileError, match=r"arm-1\.key belongs to uid \d+ and not to you"):
        key_file.load()


def test_a_link_in_the_place_of_a_key_is_not_followed(key_file: KeyFile, tmp_path: Path) -> None:
    other = KeyFile(ROBOTS, "other", tmp_path)
    other.load_or_make()
    key_file.path.symlink_to(other.path)
    with pytest.raises(OSError, match="symbolic link"):
        key_file.load_or_make()


@pytest.mark.parametrize("content", ["", "no key", "A" * 42, "A" * 44 + "\nA"])
def test_a_file_without_a_key_is_refused_and_not_written_over(key_file: KeyFile, content: str) -> None:
    key_file.load_or_make()
    key_file.path.write_text(content)
    with pytest.raises(KeyFileError, match="holds no key"):
        key_file.load_or_make()
    assert key_file.path.read_text() == content


@pytest.mark.parametrize("name", ["", "../arm", "a/b", ".hidden", "arm\n"])
def test_a_name_that_is_no_identifier_has_no_key(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValidationError, match="name must be"):
        KeyFile(ROBOTS, name, tmp_path)


def test_an_identity_shows_no_private_key(key_file: KeyFile) -> None:
    identity = key_file.load_or_make()
    assert key_file.path.read_text().strip() not in repr(identity)
    assert "_key" not in repr(identity)


def test_a_fingerprint_is_short_and_differs_between_keys() -> None:
    one, other = fingerprint(b"\0" * 32), fingerprint(b"\1" + b"\0" * 31)
    assert one == "6668-7aad-f862-bd77-6c8f"
    assert one != other


def test_enrolled_keys_are_kept_beside_one_another(tmp_path: Path) -> None:
    enrolled = EnrolledKeys(tmp_path / "state")
    assert enrolled.load() == {}
    enrolled.enroll({"arm-1": b"1" * 32})
    enrolled.enroll({"arm-2": b"2" * 32, "arm-1": b"1" * 32})
    assert enrolled.load() == {"arm-1": b"1" * 32, "arm-2": b"2" * 32}
    assert mode_of(enrolled.path) == 0o600
    assert [each.name for each in enrolled.path.parent.iterdir()] == ["enrolled.json"]


def test_a_changed_key_is_refused_by_name_unless_it_is_replaced_on_purpose(tmp_path: Path) -> None:
    enrolled = EnrolledKeys(tmp_path)
    enrolled.enroll({"arm-1": b"1" * 32})
    with pytest.raises(KeyChangedError, match="arm-1 shows the key"):
        enrolled.enroll({"arm-2": b"2" * 32, "arm-1": b"3" * 32})
    assert enrolled.load() == {"arm-1": b"1" * 32}
    enrolled.enroll({"arm-1": b"3" * 32}, replace=True)
    assert enrolled.load() == {"arm-1": b"3" * 32}


def test_a_robot_can_be_forgotten(tmp_path: Path) -> None:
    enrolled = EnrolledKeys(tmp_path)
    enrolled.enroll({"arm-1": b"1" * 32})
    assert enrolled.forget("arm-1")
    assert not enrolled.forget("arm-1")
    assert enrolled.load() == {}


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{}",
        "[]",
        '{"v": 1, "robots": []}',
        '{"v": 2, "robots": {}}',
        '{"v": 1, "robots": {"arm-1": {"key": "short"}}}',
        '{"v": 1, "robots": {"arm-1": "AAAA"}}',
    ],
)
def test_an_unreadable_list_of_enrolled_keys_is_never_an_empty_one(tmp_path: Path, content: str) -> None:
    enrolled = EnrolledKeys(tmp_path)
    enrolled.enroll({"arm-1": b"1" * 32})
    enrolled.path.write_text(content)
    with pytest.raises(KeyFileError, match=r"enrolled\.json holds no enrolled keys"):
        enrolled.load()


def test_enrolled_keys_that_others_may_write_are_refused(tmp_path: Path) -> None:
    enrolled = EnrolledKeys(tmp_path)
    enrolled.enroll({"arm-1": b"1" * 32})
    enrolled.path.chmod(0o666)
    with pytest.raises(KeyFileError, match="mode 0666"):
        enrolled.load()
