"""The reference policy server: answers observations with actions over a WebSocket, in JSON or MessagePack.

    .venv/bin/python examples/policy_server.py --port 8765
    strands-robots call my-arm execute instruction='wave' policy_provider=remote policy_port=8765

Its policy swings every joint that has a range around where it is. Replace ``Swing`` by your model.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
from typing import Any

import msgpack
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

logger = logging.getLogger("policy_server")

CHUNK = 5
CONTROL_HZ = 50.0


class Swing:
    """One task of one robot: a sine of a tenth of each range around the position at its start."""

    def __init__(self, task: dict[str, Any]) -> None:
        self.ranges: dict[str, list[float]] = task["ranges"]
        self.instruction: str = task["instruction"]
        self._start: dict[str, float] = {}
        self._step = 0

    def actions(self, observation: dict[str, Any]) -> list[dict[str, float]]:
        """The next few actions, one a control step."""
        if not self._start:
            self._start = {key: observation.get(key, sum(pair) / 2) for key, pair in self.ranges.items()}
        chunk = []
        for _ in range(CHUNK):
            swing = 0.1 * math.sin(math.tau * 0.5 * self._step / CONTROL_HZ)
            chunk.append({key: self._start[key] + swing * (high - low) for key, (low, high) in self.ranges.items()})
            self._step += 1
        return chunk


def answer(message: dict[str, Any], swing: Swing | None) -> tuple[dict[str, Any], Swing | None]:
    """The answer to one message, and the task that goes on."""
    if message.get("type") == "reset":
        swing = Swing(message)
        logger.info("New task: %s", swing.instruction)
        return {"type": "ready"}, swing
    if message.get("type") == "act" and swing is not None:
        return {"type": "actions", "actions": swing.actions(message["observation"]), "done": False}, swing
    return {"type": "error", "reason": "say reset first, then act"}, swing


def attend(connection: ServerConnection) -> None:
    """Serve one robot until it leaves."""
    swing: Swing | None = None
    try:
        for frame in connection:
            message = json.loads(frame) if isinstance(frame, str) else msgpack.unpackb(frame)
            said, swing = answer(message, swing)
            said["id"] = message.get("id")
            connection.send(json.dumps(said) if isinstance(frame, str) else msgpack.packb(said))
    except ConnectionClosed:
        logger.info("The robot left without a goodbye.")


def main() -> None:
    """Serve until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8765)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    with serve(attend, options.host, options.port, compression=None) as server:
        port = server.socket.getsockname()[1]
        print(f"serving on ws://{options.host}:{port}", flush=True)
        server.serve_forever()


if __name__ == "__main__":
    main()
