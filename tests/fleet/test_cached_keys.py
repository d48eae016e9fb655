"""Enrolled keys are read at most once in a while."""

from __future__ import annotations

import pytest

from strands_robots.fleet import shared_id
from strands_robots.fleet.shared_id import AGAIN_S, CachedKeys


def test_keys_are_read_again_only_after_their_time(monkeypatch: pytest.MonkeyPatch) -> None:
    now, reads = [100.0], list[float]()

    def load() -> dict[str, bytes]:
        reads.append(now[0])
        return {"arm-1": b"key"}

    monkeypatch.setattr(shared_id.time, "monotonic", lambda: now[0])
    keys = CachedKeys(load)
    assert [keys.read(), keys.read()] == [{"arm-1": b"key"}] * 2
    now[0] += AGAIN_S
    keys.read()
    assert reads == [100.0, 100.0 + AGAIN_S]
