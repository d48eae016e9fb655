"""Errors of the commands are sentences: what, why, and what to do."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from tests.cli.conftest import Run

from strands_robots.cli.output import in_words


@pytest.mark.parametrize("number", [1, 2, 13, 17, 20, 21, 28, 30, 98, 111])
def test_errors_of_the_system_are_put_into_words(number: int) -> None:
    said = in_words(f"The key cannot be written: {OSError(number, 'The system says so', 'keys/a.pem')}")
    assert said.startswith("The key cannot be written: keys/a.pem: ")
    assert "Errno" not in said and "The system says so" not in said


def test_other_text_stays_as_it_is() -> None:
    assert in_words("arm-1 refused [Errno none]: 'x'") == "arm-1 refused [Errno none]: 'x'"
    assert in_words("[Errno 5] Input/output error: '/dev/a' -> '/dev/b', twice") == "/dev/a: Input/output error, twice"


@pytest.mark.parametrize(
    "arguments",
    [
        ("grant", "execute@arm-1"),
        ("enroll", "--list"),
        ("lockout",),
        ("resume", "--local"),
        ("keys", "console"),
        ("audit", "verify"),
    ],
    ids=" ".join,
)
def test_file_in_the_place_of_the_state_directory_is_told_in_words(
    arguments: tuple[str, ...], run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = tmp_path / "file"
    taken.write_text("")
    monkeypatch.setenv("STRANDS_STATE_DIR", str(taken))
    monkeypatch.setenv("STRANDS_MESH_AUDIT_DIR", str(taken))
    result = run(*arguments)
    assert result.exit_code == 1
    assert str(taken) in result.stderr and "Errno" not in result.stderr
    assert re.search(r"where a directory has to be|has to be a directory|is there already", result.stderr)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("serve", "so100", "--policies", "absent.json"), "absent.json cannot be read: No such file"),
        (("serve", "so100", "--policies", "."), ". cannot be read: Is a directory"),
        (("serve", "so100", "--set", "colour=red"), "no option colour"),
        (("serve", "so100", "--tls-ca", "."), "--tls-ca . is no file"),
        (("peers", ""), "DEVICE must be"),
        (("call", "", "stop"), "device must be"),
        (("enroll", "--console", "file"), "--console must be the key"),
        (("keys", "estop", "key.pem", "--passphrase-file", "absent"), "absent: there is no such file"),
    ],
    ids=lambda each: " ".join(each) if isinstance(each, tuple) else "",
)
def test_wrong_use_is_exit_2_and_names_what_is_wrong(
    arguments: tuple[str, ...], named: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(*arguments)
    assert (result.exit_code, named in result.stderr) == (2, True), result.stderr
