"""A LeRobot checkpoint behind openpi's wire: MessagePack on a WebSocket. Needs `make lerobot`.

    .venv-policies/bin/python examples/openpi_server.py CHECKPOINT --port 8000

The server sends its metadata first, then answers each observation with ``actions``: (horizon, dimension). What
``observation/state`` has beyond the checkpoint's state is its environment state.
"""

from __future__ import annotations

import argparse
import contextlib
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

STATE, ENVIRONMENT = "observation.state", "observation.environment_state"


def packed(value: Any) -> Any:
    """Return an array as openpi's map."""
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    raise TypeError(type(value).__name__)


def unpacked(found: dict[Any, Any]) -> Any:
    """Return the array behind a map of the wire."""
    if b"__ndarray__" in found:
        return np.ndarray(buffer=found[b"data"], dtype=found[b"dtype"], shape=found[b"shape"])
    return found


class Checkpoint:
    """A checkpoint, which answers one observation at a time.

    Args:
        folder: a directory of LeRobot's.
        state: length of its state; the rest of what arrives is its environment state.
    """

    def __init__(self, folder: Path, state: int) -> None:
        config = PreTrainedConfig.from_pretrained(folder)
        config.device = "cpu"
        self._policy = get_policy_class(config.type).from_pretrained(folder, config=config, strict=True)
        on_cpu = {"device_processor": {"device": "cpu"}}
        self._before, self._after = make_pre_post_processors(config, str(folder), preprocessor_overrides=on_cpu)
        self._state = state
        self._one = threading.Lock()

    def answer(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the chunk for an observation."""
        vector = np.array(observation["observation/state"], np.float32)
        frame = {STATE: vector[: self._state]}
        if len(vector) > self._state:
            frame[ENVIRONMENT] = vector[self._state :]
        with self._one, torch.inference_mode():
            task = str(observation.get("prompt", ""))
            batch = self._before(prepare_observation_for_inference(frame, torch.device("cpu"), task, ""))
            chunk = self._after(self._policy.predict_action_chunk(batch))
        return {"actions": chunk[0].numpy()}


def answer_all(checkpoint: Checkpoint, connection: ServerConnection) -> None:
    """Answer one client until it leaves."""
    with contextlib.suppress(ConnectionClosed):
        connection.send(msgpack.packb({}))
        for frame in connection:
            observation = msgpack.unpackb(frame, object_hook=unpacked, strict_map_key=False)
            connection.send(msgpack.packb(checkpoint.answer(observation), default=packed))


@contextlib.contextmanager
def serve_checkpoint(folder: Path, state: int, port: int = 0) -> Iterator[str]:
    """Serve a checkpoint on this machine while the context is open; its address is the value."""
    checkpoint = Checkpoint(folder, state)
    with serve(lambda each: answer_all(checkpoint, each), "127.0.0.1", port, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever, name="openpi-server", daemon=True)
        thread.start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        server.shutdown()
        thread.join()


def main() -> None:
    """Serve until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--state", type=int, required=True, help="Length of the checkpoint's state.")
    parser.add_argument("--port", type=int, default=8000)
    options = parser.parse_args()
    with (
        serve_checkpoint(options.checkpoint, options.state, options.port) as url,
        contextlib.suppress(KeyboardInterrupt),
    ):
        print(f"Serving {options.checkpoint} at {url}; Ctrl-C ends it.")
        threading.Event().wait()


if __name__ == "__main__":
    main()
