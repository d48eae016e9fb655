"""More keys than declared publishers, as with hundreds of robots in one process."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
from fixtures.waiting import free_port

from strands_robots.mesh.transport import zenoh
from strands_robots.mesh.transport.config import Posture
from strands_robots.mesh.transport.zenoh import ZenohTransport

THREADS = 8
MESSAGES = 2000


def test_a_publisher_that_makes_place_breaks_no_message_of_another_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh, "PUBLISHERS_MAX", 2)
    hub = f"tcp/127.0.0.1:{free_port()}"
    transport = ZenohTransport(Posture("strands", (), (), hub, None, None, False, 16))
    transport.connect()

    def publish(thread: int) -> int:
        for number in range(MESSAGES):
            transport.put(f"strands/arm-{(thread + number) % 4}/presence", {"robot_id": "arm", "timestamp": 0.0})
        return MESSAGES

    try:
        with ThreadPoolExecutor(THREADS) as threads:
            assert list(threads.map(publish, range(THREADS))) == [MESSAGES] * THREADS
    finally:
        transport.close()
