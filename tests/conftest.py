"""What every test gets: a state directory of its own, so that none reads or writes the user's, and a working Ctrl-C."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from strands_robots.audit import flush_audit

# A shell starts background jobs with Ctrl-C ignored, and every process that a test starts would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def state_directory(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The directory of grants, lockouts and the audit of this test, mode 0700."""
    directory = tmp_path_factory.mktemp("state")
    directory.chmod(0o700)
    monkeypatch.setenv("STRANDS_STATE_DIR", str(directory))
    monkeypatch.delenv("STRANDS_MESH_AUDIT_DIR", raising=False)
    yield directory
    flush_audit(0.5)
