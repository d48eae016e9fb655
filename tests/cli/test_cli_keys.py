from __future__ import annotations

import json
from pathlib import Path

import pytest
from tests.cli.conftest import Run

from strands_robots.safety import ed25519

STRONG = "Plenty of 4 different words"


@pytest.mark.parametrize(
    ("kind", "setting"),
    [("resume", "STRANDS_MESH_RESUME_PUBLIC_KEY"), ("estop", "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS")],
)
def test_key_is_made_once_and_its_public_half_printed(run: Run, tmp_path: Path, kind: str, setting: str) -> None:
    passphrase = tmp_path / "passphrase"
    passphrase.write_text(STRONG + "\n", encoding="utf-8")
    made = ("keys", kind, str(tmp_path / "key.pem"), "--passphrase-file", str(passphrase), "--json")
    result = json.loads(run(*made).stdout)
    key = ed25519.load_signing_key(tmp_path / "key.pem", STRONG)
    assert result[setting] == ed25519.encode(ed25519.public_half(key))
    assert run(*made).exit_code == 1


def test_weak_passphrase_makes_no_key(run: Run, tmp_path: Path) -> None:
    passphrase = tmp_path / "passphrase"
    passphrase.write_text("secret", encoding="utf-8")
    result = run("keys", "resume", str(tmp_path / "key.pem"), "--passphrase-file", str(passphrase))
    assert result.exit_code == 2
    assert "passphrase must have" in result.stderr
    assert not (tmp_path / "key.pem").exists()


def test_passphrase_is_asked_for_on_a_terminal_only(run: Run, tmp_path: Path) -> None:
    result = run("keys", "resume", str(tmp_path / "key.pem"))
    assert result.exit_code == 2
    assert "--passphrase-file" in result.stderr


def test_console_key_is_made_once_and_printed_for_robots_elsewhere(run: Run) -> None:
    first, again = (json.loads(run("keys", "console", "--json").stdout) for _ in range(2))
    assert len(first["STRANDS_MESH_CONSOLE_PUBLIC_KEYS"]) == 44
    assert first == again
