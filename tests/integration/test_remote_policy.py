"""The remote policy against the reference server as a process, and against servers that misbehave."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually, free_port
from websockets.sync.server import ServerConnection, serve

from strands_robots.hardware import HardwareRobot
from strands_robots.policies.policy_server import PolicyServerError
from strands_robots.policies.remote import RemotePolicy
from strands_robots.utils import ValidationError

SERVER = Path(__file__).resolve().parents[2] / "examples" / "policy_server.py"
ARM = {"pan": (-1.0, 1.0), "free": (-math.inf, math.inf)}


class Server:
    """The reference server in its own process."""

    def __init__(self, port: int) -> None:
        self.port = port
        self._process = subprocess.Popen(
            [sys.executable, str(SERVER), "--port", str(port)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self._process.stdout is not None
        assert "serving" in self._process.stdout.readline()

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(20)
        if self._process.stdout is not None:
            self._process.stdout.close()


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server(free_port())
    yield made
    made.kill()


@contextmanager
def answering(answer: Callable[[dict[str, Any]], Any]) -> Iterator[int]:
    """A server in this process: ``answer`` returns the reply to each act, or a raw frame."""

    def attend(connection: ServerConnection) -> None:
        for frame in connection:
            message = json.loads(frame)
            reply = {"type": "ready"} if message["type"] == "reset" else answer(message)
            if reply is not None:
                connection.send(reply if isinstance(reply, str | bytes) else json.dumps({"id": message["id"], **reply}))

    with serve(attend, "127.0.0.1", 0) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        try:
            yield running.socket.getsockname()[1]
        finally:
            running.shutdown()
            thread.join(20)


@contextmanager
def policy(port: int, **options: Any) -> Iterator[RemotePolicy]:
    made = RemotePolicy(policy_port=port, **{"deadline_s": 20.0, **options})
    try:
        made.reset("wave", ARM)
        yield made
    finally:
        made.close()


@pytest.mark.parametrize("frames", ["json", "msgpack"])
def test_reference_server_answers_in_both_kinds_of_frames(server: Server, frames: str) -> None:
    with policy(server.port, frames=frames) as remote:
        chunk = remote.act({"pan": 0.2, "free": 0.0})
        assert chunk is not None
        assert len(chunk) == 5
        assert chunk[0] == {"pan": pytest.approx(0.2)}


def test_robot_runs_a_task_of_a_policy_server(server: Server) -> None:
    robot = HardwareRobot(RecordingDevice(), "arm", control_hz=100)
    robot.connect()
    answer = robot.run_task("wave", policy_provider="remote", policy_port=server.port, duration=3.0, deadline_s=20.0)
    assert answer["task_status"] == "completed", answer
    assert answer["step_count"] > 20
    assert robot.device.positions["pan.pos"] != 10.0
    robot.cleanup()


def test_restarted_server_is_reconnected_within_the_step() -> None:
    port = free_port()
    first = Server(port)
    with policy(port) as remote:
        assert remote.act({"pan": 0.0})
        first.kill()
        second = Server(port)
        try:
            assert remote.act({"pan": 0.0})
        finally:
            second.kill()


def test_lost_server_ends_the_task_in_error_and_the_robot_holds(server: Server) -> None:
    robot = HardwareRobot(RecordingDevice(), "arm", control_hz=100)
    robot.connect()
    robot.start_task("wave", policy_provider="remote", policy_port=server.port, duration=300.0)
    eventually(lambda: len(robot.device.writes) > 10)
    server.kill()
    eventually(lambda: robot.get_task_status()["task_status"] == "error")
    assert "lost" in robot.get_task_status()["error"]
    assert len(robot.device.writes[-1].action) == 3
    robot.cleanup()


def test_closed_port_is_an_error_that_names_it() -> None:
    port = free_port()
    with pytest.raises(PolicyServerError, match=str(port)):
        RemotePolicy(policy_port=port).reset("wave", ARM)


def test_late_server_is_an_error() -> None:
    with answering(lambda message: None) as port, policy(port, deadline_s=0.2) as remote:
        began = time.monotonic()
        with pytest.raises(PolicyServerError, match="in time"):
            remote.act({"pan": 0.0})
        assert time.monotonic() - began < 20


def test_stop_does_not_wait_for_a_slow_server() -> None:
    asked = threading.Event()
    with answering(lambda message: asked.set()) as port:
        robot = HardwareRobot(RecordingDevice(), "arm")
        robot.connect()
        robot.start_task("think", policy_provider="remote", policy_port=port, duration=300.0, deadline_s=60.0)
        assert asked.wait(20)
        assert robot.stop_task()["stopped"] is True
        assert robot.get_task_status()["task_status"] == "stopped"
        robot.cleanup()


@pytest.mark.parametrize(
    "reply",
    [
        {"type": "actions", "actions": [{"elbow": 0.1}]},
        {"type": "actions", "actions": [{"pan": None}]},
        {"type": "actions", "actions": [{"pan": True}]},
        {"type": "actions", "actions": [5]},
        {"type": "actions", "actions": {"pan": 0.1}},
        {"type": "actions", "actions": [{}] * 10_001},
        {"type": "actions"},
        {"type": "dance"},
        {"type": "error", "reason": "no such checkpoint"},
        "not json",
        '"a string"',
        "[" * 100_000,
        b"\xc1",
    ],
    ids=lambda reply: str(reply)[:40],
)
def test_unusable_answer_is_refused(reply: Any) -> None:
    with answering(lambda message: reply) as port, policy(port) as remote:
        with pytest.raises(PolicyServerError) as refused:
            remote.act({"pan": 0.0})
        assert len(str(refused.value)) < 500


def test_target_that_is_not_finite_is_refused() -> None:
    frame = '{"id": 2, "type": "actions", "actions": [{"pan": NaN}]}'
    with answering(lambda message: frame) as port, policy(port) as remote:
        with pytest.raises(PolicyServerError, match="finite"):
            remote.act({"pan": 0.0})


def test_done_ends_the_task_after_its_last_actions() -> None:
    reply = {"type": "actions", "actions": [{"pan": 0.5}], "done": True}
    with answering(lambda message: reply) as port, policy(port) as remote:
        assert remote.act({"pan": 0.0}) == [{"pan": 0.5}]
        assert remote.act({"pan": 0.0}) is None


def test_images_travel_in_msgpack_frames() -> None:
    seen: list[dict[str, Any]] = []

    def attend(connection: ServerConnection) -> None:
        for frame in connection:
            message = msgpack.unpackb(frame)
            seen.append(message)
            reply = {"type": "ready"} if message["type"] == "reset" else {"type": "actions", "actions": []}
            connection.send(msgpack.packb({"id": message["id"], **reply}))

    with serve(attend, "127.0.0.1", 0) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        image = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
        with policy(running.socket.getsockname()[1], frames="msgpack", uses_cameras=True) as remote:
            assert remote.act({"pan": 0.1, "front": image}) == []
        running.shutdown()
        thread.join(20)
    front = seen[1]["observation"]["front"]
    assert np.array_equal(np.frombuffer(front["data"], front["dtype"]).reshape(front["shape"]), image)


@pytest.mark.parametrize(
    "options",
    [
        {"policy_host": "http://x"},
        {"policy_host": ""},
        {"policy_host": "a/b"},
        {"policy_port": -1},
        {"policy_port": 70000},
        {"policy_port": True},
        {"deadline_s": 0},
        {"deadline_s": float("nan")},
        {"frames": "xml"},
        {"uses_cameras": True},
        {"uses_cameras": 1},
    ],
    ids=str,
)
def test_option_outside_its_domain_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        RemotePolicy(**options)
