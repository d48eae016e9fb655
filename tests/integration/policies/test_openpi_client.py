"""Our client and our server of openpi's wire against openpi's own client package. Run by `make lerobot`."""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy
import pytest
from fixtures.openpi_server import OpenPiServer
from websockets.sync.server import ServerConnection, serve

from strands_robots.policies.openpi import OpenPiPolicy
from strands_robots.policies.policy_server import PolicyServerError
from strands_robots.policies.profiles import CameraMap, Profile

if importlib.util.find_spec("torch") is None or importlib.util.find_spec("openpi_client") is None:
    pytest.skip("torch and openpi-client are not installed; `make lerobot` runs this", allow_module_level=True)

from examples.openpi_server import serve_checkpoint
from fixtures import lerobot_checkpoints as tiny
from openpi_client import msgpack_numpy as own
from openpi_client import websocket_client_policy as client

KEYS = ("pan.pos", "lift.pos", "grip.pos")
SEEN = {"pan.pos": 1.0, "lift.pos": 2.0, "grip.pos": 3.0}
FRONT = (CameraMap("front", "observation/image", size=(6, 8)),)


@contextmanager
def served(answer: Any) -> Iterator[tuple[str, list[bytes]]]:
    """A server whose every byte is packed by openpi's own module; its address, and the frames that it got."""
    frames: list[bytes] = []

    def talk(connection: ServerConnection) -> None:
        connection.send(own.packb({"action_horizon": 4}))
        for frame in connection:
            frames.append(frame)
            connection.send(own.packb(answer))

    with serve(talk, "127.0.0.1", 0, compression=None, max_size=None) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}", frames
        server.shutdown()
        thread.join(20)


def reset(url: str) -> OpenPiPolicy:
    entries = {"first_deadline_s": 20.0, "deadline_s": 20.0, "cameras": FRONT}
    policy = OpenPiPolicy(Profile("pi", "openpi", KEYS, KEYS, url=url, **entries))
    policy.reset("pick up the cube", {})
    return policy


def test_answers_packed_by_openpi_are_read_with_scalars_and_all() -> None:
    answer = {
        "actions": numpy.arange(12, dtype=numpy.float64).reshape(4, 3),
        "policy_timing": {"infer_ms": numpy.float32(12.5), "warm": numpy.bool_(True), "step": numpy.int64(3)},
    }
    with served(answer) as (url, _):
        policy = reset(url)
        actions = policy.act({**SEEN, "observation/image": numpy.zeros((6, 8, 3), numpy.uint8)})
        policy.close()
    assert [list(each.values()) for each in actions] == answer["actions"].tolist()


def test_an_observation_is_byte_for_byte_what_openpi_would_send() -> None:
    image = numpy.arange(6 * 8 * 3, dtype=numpy.uint8).reshape(6, 8, 3)
    with served({"actions": numpy.zeros((4, 3))}) as (url, frames):
        policy = reset(url)
        policy.act({**SEEN, "observation/image": image})
        policy.close()
    observation = {
        "observation/state": numpy.array([1.0, 2.0, 3.0], numpy.float32),
        "observation/image": image,
        "prompt": "pick up the cube",
    }
    assert frames[-1] == own.Packer().pack(observation)


def test_the_stand_in_answers_and_fails_openpis_own_client_as_its_server_does() -> None:
    values = numpy.arange(12, dtype=numpy.float32).reshape(4, 3)
    answers = iter([{"actions": values, "took": numpy.float64(1.5)}, "Traceback\nRuntimeError: bad camera"])
    with OpenPiServer(lambda observation: next(answers), metadata={"robot": "so101"}, token="sesame") as server:
        theirs = client.WebsocketClientPolicy(server.url, api_key="sesame")
        assert theirs.get_server_metadata() == {"robot": "so101"}
        seen = {"observation/state": numpy.ones(3, numpy.float32), "prompt": "pick"}
        assert (theirs.infer(seen)["actions"] == values).all()
        assert server.seen[0]["observation/state"].tolist() == [1.0, 1.0, 1.0]
        with pytest.raises(RuntimeError, match="bad camera"):
            theirs.infer(seen)


def test_the_example_serves_a_checkpoint_to_openpis_own_client(tmp_path: Path) -> None:
    folder = tiny.act(tmp_path / "act")
    with serve_checkpoint(folder, len(KEYS)) as url:
        theirs = client.WebsocketClientPolicy(url)
        chunk = theirs.infer({"observation/state": numpy.zeros(5, numpy.float32), "prompt": ""})["actions"]
        state = (*KEYS, "x", "y")
        policy = OpenPiPolicy(Profile("pi", "openpi", state, KEYS, url=url, first_deadline_s=20.0, deadline_s=20.0))
        policy.reset("", {})
        ours = policy.act(dict.fromkeys(state, 0.0))
        policy.close()
    assert numpy.allclose([list(each.values()) for each in ours], chunk)


def test_a_token_that_is_absent_is_told() -> None:
    with (
        OpenPiServer(lambda observation: {"actions": numpy.zeros((4, 3))}, token="sesame") as server,
        pytest.raises(PolicyServerError, match=r"no policy server answers|was lost|failed"),
    ):
        reset(server.url)
