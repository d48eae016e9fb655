"""What every test gets: a state directory of its own, so that none reads or writes the user's."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from strands_robots.audit import flush_audit


@pytest.fixture(autouse=True)
def state_directory(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The directory of grants, lockouts and the audit of this test, mode 0700."""
    directory = tmp_path_factory.mktemp("state")
    directory.chmod(0o700)
    monkeypatch.setenv("STRANDS_STATE_DIR", str(directory))
    monkeypatch.delenv("STRANDS_MESH_AUDIT_DIR", raising=False)
    yield directory
    flush_audit(0.5)
