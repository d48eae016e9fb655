"""Behaviour of real daemons, to which the stand-in is held by the same tests."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from fixtures.reachy_daemon.process import Daemon
from fixtures.waiting import eventually
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from strands_robots.drivers.reachy.rest import (
    BackendDownError,
    DaemonFaultError,
    DaemonNotFoundError,
    DaemonRefusedError,
    RestClient,
)

UPRIGHT = [1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]


@contextmanager
def socket(daemon: Daemon) -> Iterator[ClientConnection]:
    if daemon.kind.zenoh:
        pytest.skip("daemons before 1.5 have no /ws/sdk")
    url = f"ws://127.0.0.1:{daemon.port}/ws/sdk"
    with connect(url, compression=None, ping_interval=None, proxy=None, close_timeout=0.2) as ws:
        yield ws


def frames(ws: ClientConnection, seconds: float) -> list[dict[str, Any]]:
    received, end = [], time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        try:
            received.append(json.loads(ws.recv(left)))
        except TimeoutError:
            break
    return received


def antennas(ws: ClientConnection) -> list[Any]:
    while True:
        frame = json.loads(ws.recv(20.0))
        if frame["type"] == "joint_positions":
            return list(frame["antennas_joint_positions"])


@pytest.fixture
def rest(daemon: Daemon) -> Iterator[RestClient]:
    client = RestClient("127.0.0.1", daemon.port)
    yield client
    client.close()


def test_status_reports_version_and_state(daemon: Daemon, rest: RestClient) -> None:
    status = rest.get("/api/daemon/status")
    assert status["version"] == daemon.kind.version
    assert ("type" in status) is not daemon.kind.zenoh
    assert status["state"] == "running"
    assert status["backend_status"]["motor_control_mode"] == "enabled"
    assert status["robot_name"] == "reachy_mini"


def test_socket_streams_joints_poses_and_status_unasked(daemon: Daemon) -> None:
    kinds: list[str] = []
    with socket(daemon) as ws:
        while kinds.count("daemon_status") < 4:
            kinds.append(json.loads(ws.recv(20.0))["type"])
    first = kinds.index("daemon_status")
    # The status comes once a second by the daemon's own clock, whatever the machine makes of that.
    whole = kinds[first : len(kinds) - 1 - kinds[::-1].index("daemon_status")]
    assert 60 <= whole.count("joint_positions") <= 165, "of three seconds"
    assert abs(whole.count("joint_positions") - whole.count("head_pose")) <= 3
    assert ("imu_data" in whole) is daemon.kind.wireless


@pytest.mark.parametrize("frame", ["{bad", "", "[1]", '{"type":"nobody"}', '{"head_pose":[[1]]}', '{"a":1}'])
def test_unknown_frame_is_ignored_and_the_socket_stays_open(daemon: Daemon, frame: str) -> None:
    with socket(daemon) as ws:
        ws.send(frame)
        ws.send(json.dumps({"type": "set_antennas", "antennas": [0.31, -0.31]}))
        eventually(lambda: antennas(ws) == pytest.approx([0.31, -0.31], abs=0.05), what="the later command works")


@pytest.mark.parametrize("frame", [b"{}", json.dumps({"type": "set_target", "head": UPRIGHT[:15]})])
def test_binary_and_short_frames_end_the_connection_without_a_close_frame(daemon: Daemon, frame: str | bytes) -> None:
    with socket(daemon) as ws:
        ws.send(frame)
        with pytest.raises(ConnectionClosed) as closed:
            frames(ws, 20.0)
        assert closed.value.rcvd is None


def test_nan_comes_back_as_null_until_a_number_repairs_it(daemon: Daemon) -> None:
    if daemon.kind.simulation == "mujoco":
        pytest.skip("physics keeps its own numbers")
    with socket(daemon) as ws:
        ws.send('{"type":"set_antennas","antennas":[NaN,0]}')
        eventually(lambda: antennas(ws)[0] is None, what="null")
        ws.send('{"type":"set_antennas","antennas":[0,0]}')
        eventually(lambda: antennas(ws) == pytest.approx([0, 0], abs=0.01), what="repaired")


def test_stop_of_an_ended_move_fails_and_the_next_request_works(daemon: Daemon, rest: RestClient) -> None:
    for _ in range(3):
        with pytest.raises(DaemonFaultError) as fault:
            rest.post("/api/move/stop", {"uuid": "00000000-0000-4000-8000-000000000000"})
        assert fault.value.status == 500
        assert "Internal Server Error" in str(fault.value)
        assert rest.get("/api/move/running") == []


@pytest.mark.parametrize(
    ("path", "body", "kind", "message"),
    [
        ("/api/move/stop", {"uuid": "nope"}, DaemonRefusedError, "valid UUID"),
        ("/api/move/goto", {"head_pose": {"yaw": 0.1}}, DaemonRefusedError, "body.duration: Field required"),
        ("/api/move/goto", {"antennas": [0, 0, 0], "duration": 1}, DaemonRefusedError, "at most 2 items"),
        ("/api/motors/set_mode/bogus", None, DaemonRefusedError, "'enabled', 'disabled'"),
        ("/api/daemon/stop", None, DaemonRefusedError, "goto_sleep"),
        ("/api/move/play/nothing", None, DaemonNotFoundError, "Not Found"),
        ("/nope", None, DaemonNotFoundError, "Not Found"),
    ],
)
def test_wrong_request_is_refused_with_the_daemons_message(
    rest: RestClient, path: str, body: dict[str, Any] | None, kind: type[Exception], message: str
) -> None:
    with pytest.raises(kind, match=message):
        rest.post(path, body)


def test_only_local_names_are_answered_since_1_12(daemon: Daemon) -> None:
    answer = daemon.request("GET", "/api/daemon/status", headers={"Host": "robot.example.org"})
    if daemon.kind.zenoh:
        assert answer.status_code == 200
        return
    assert (answer.status_code, answer.text) == (400, '{"detail": "Untrusted Host header"}')
    elsewhere = {"Origin": "http://elsewhere.example.org"}
    answer = daemon.request("POST", "/api/motors/set_mode/enabled", headers=elsewhere)
    assert (answer.status_code, answer.text) == (403, '{"detail": "Cross-origin request rejected"}')


def test_two_moves_run_at_the_same_time(daemon: Daemon, rest: RestClient) -> None:
    moves = [rest.post("/api/move/goto", {"antennas": [a, a], "duration": 60.0})["uuid"] for a in (1.0, -1.0)]
    assert {move["uuid"] for move in rest.get("/api/move/running")} == set(moves)
    for uuid in moves:
        assert uuid in rest.post("/api/move/stop", {"uuid": uuid})["message"]
    assert rest.get("/api/move/running") == []


def test_cached_recorded_moves_need_no_hub(rest: RestClient) -> None:
    path = "/api/move/recorded-move-datasets/list/pollen-robotics/reachy-mini-"
    assert sorted(rest.get(path + "emotions-library")) == ["no1", "yes1"]
    with pytest.raises(DaemonFaultError):
        rest.get(path + "nothing-of-that-name")
    with pytest.raises(DaemonNotFoundError, match="nope"):
        rest.post("/api/move/play/recorded-move-dataset/pollen-robotics/reachy-mini-emotions-library/nope")


def test_old_socket_stays_open_and_silent_after_a_restart(daemon: Daemon, rest: RestClient) -> None:
    with socket(daemon) as ws:
        antennas(ws)
        rest.post("/api/daemon/restart")
        eventually(lambda: not [f for f in frames(ws, 0.5) if f["type"] == "joint_positions"], what="silence")
        eventually(lambda: rest.get("/api/daemon/status")["state"] == "running", what="running again")
        assert not [f for f in frames(ws, 1.0) if f["type"] == "joint_positions"]
        ws.send(json.dumps({"type": "set_antennas", "antennas": [0, 0]}))
    with socket(daemon) as ws:
        assert antennas(ws)


def test_six_joints_end_the_backend_until_a_restart(daemon: Daemon, rest: RestClient) -> None:
    if daemon.kind.simulation == "mujoco":
        pytest.skip("measured on the mock-up only")
    with socket(daemon) as ws:
        ws.send(json.dumps({"type": "set_head_joints", "joints": [0.0] * 6}))
        eventually(lambda: rest.get("/api/daemon/status")["state"] == "error", what="state error")
    assert "length 6 (got 5)" in rest.get("/api/daemon/status")["error"]
    with pytest.raises(BackendDownError, match="Backend not running"):
        rest.get("/api/motors/status")
    rest.post("/api/daemon/restart")
    eventually(lambda: rest.get("/api/daemon/status")["state"] == "running", what="running again")
