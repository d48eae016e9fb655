from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

from strands_robots.safety import ed25519

Run = Callable[..., Result]
STRONG = "Plenty of 4 different words"


@pytest.mark.parametrize(
    ("kind", "setting"),
    [("resume", "STRANDS_MESH_RESUME_PUBLIC_KEY"), ("estop", "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS")],
)
def test_a_key_is_made_once_and_its_public_half_told(run: Run, tmp_path: Path, kind: str, setting: str) -> None:
    words = tmp_path / "words"
    words.write_text(STRONG + "\n", encoding="utf-8")
    made = ("keys", kind, str(tmp_path / "key.pem"), "--passphrase-file", str(words), "--json")
    told = json.loads(run(*made).stdout)
    key = ed25519.load_signing_key(tmp_path / "key.pem", STRONG)
    assert told[setting] == ed25519.encode(ed25519.public_half(key))
    assert run(*made).exit_code == 1


def test_a_weak_passphrase_makes_no_key(run: Run, tmp_path: Path) -> None:
    words = tmp_path / "words"
    words.write_text("secret", encoding="utf-8")
    result = run("keys", "resume", str(tmp_path / "key.pem"), "--passphrase-file", str(words))
    assert result.exit_code == 2
    assert "passphrase must have" in result.stderr
    assert not (tmp_path / "key.pem").exists()


def test_a_passphrase_is_asked_for_on_a_terminal_only(run: Run, tmp_path: Path) -> None:
    result = run("keys", "resume", str(tmp_path / "key.pem"))
    assert result.exit_code == 2
    assert "--passphrase-file" in result.stderr
