"""Which commands of a peer wait for which."""

from __future__ import annotations

import threading
from typing import Any

from fixtures.mesh_robots import World
from tests.mesh.peers import Fleet


def test_reads_and_resumes_wait_for_no_motion_that_lasts(peers: Fleet) -> None:
    release = threading.Event()

    class Slow(World):
        def reset(self) -> dict[str, Any]:
            release.wait(60)
            return super().reset()

    console = peers.join(None, "console")
    peers.join(Slow("left"), "sim-1", "sim")
    stranger = peers.stranger()
    for turn in range(8):
        reset = {
            "sender_id": "agent",
            "turn_id": f"t{turn}",
            "timestamp": peers.clock(),
            "command": {"action": "reset"},
        }
        stranger.put("strands/sim-1/cmd", reset)
    try:
        assert console.send("sim-1", {"action": "status"}, timeout=20)["type"] == "response"
        assert console.send("sim-1", {"action": "teleop_stop"}, timeout=20)["type"] == "response"
    finally:
        release.set()
