"""``run`` serves a robot on a real network until a signal, and halts it before it leaves."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
import threading

import pytest
from fixtures.devices import RecordingDevice
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually, free_port

from strands_robots import HardwareRobot
from strands_robots.device_connect import DuplicateDeviceError, loopback_config
from strands_robots.device_connect.client import open_client
from strands_robots.mesh import Mesh
from strands_robots.robot import run
from strands_robots.safety.stopping import StopVerdict

SERVE = """
import logging, threading
from strands_robots import Robot
logging.basicConfig(level=logging.INFO, format="%(message)s")
robot = Robot("so100", peer_id="served-arm")
robot.start_policy("so100", "wave", duration=600)
verdict = robot.run()
print("halted", verdict.stopped, list(verdict.halted), flush=True)
robot.cleanup()
print("threads", [t.name for t in threading.enumerate() if t.name.startswith("rollout")], flush=True)
"""


def status_of(port: int, device: str) -> dict[str, object] | None:
    """Return the answer of a device to getStatus, or None when it does not answer."""

    async def ask() -> dict[str, object] | None:
        client = await open_client(loopback_config(port))
        try:
            request = {"jsonrpc": "2.0", "id": "1", "method": "getStatus", "params": {}}
            answer = await client.request(
                f"device-connect.default.{device}.cmd", json.dumps(request).encode(), timeout=1.0
            )
        except Exception:  # noqa: BLE001 - silence, whatever the transport calls it
            return None
        finally:
            await client.close()
        answered: dict[str, object] = json.loads(answer)
        return answered

    return asyncio.run(ask())


def test_run_serves_until_the_event_and_halts_the_robot(patient_halts: None) -> None:
    robot = HardwareRobot(RecordingDevice(), "arm", control_hz=100)
    robot.connect()
    port, until = free_port(), threading.Event()
    verdicts: list[StopVerdict] = []
    thread = threading.Thread(
        target=lambda: verdicts.append(run(robot, peer_id="run-arm", until=until, link=loopback_config(port)))
    )
    thread.start()
    try:
        assert eventually(lambda: status_of(port, "run-arm"))
        robot.start_task("wave", duration=300)
        eventually(lambda: robot.device.writes)
    finally:
        until.set()
        thread.join(60)
    assert not thread.is_alive()
    assert verdicts[0].stopped is True
    assert verdicts[0].halted == ("task",)
    robot.cleanup()


def test_robot_whose_tags_are_none_of_ours_is_served_on_both_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_BACKEND", "memory")
    joined, until, toy = list[Mesh](), threading.Event(), ToyRobot("toy")
    start = Mesh.start
    monkeypatch.setattr(Mesh, "start", lambda mesh: (joined.append(mesh), start(mesh)))
    toy.tags = {"serial": 12}  # type: ignore[attr-defined]
    until.set()
    try:
        run(toy, peer_id="tagged", until=until, mesh=True, link=loopback_config(free_port()))
    finally:
        toy.close()
    assert [mesh.peer_id for mesh in joined] == ["tagged"]


def test_halt_of_a_stranger_ends_its_run(patient_halts: None) -> None:
    class Stranger:
        halted = 0

        def halt(self) -> dict[str, object]:
            self.halted += 1
            return {"status": "success"}

    stranger, until = Stranger(), threading.Event()
    until.set()
    verdict = run(stranger, peer_id="stranger", until=until, mesh=False, link=loopback_config(free_port()))
    assert (verdict.stopped, stranger.halted) == (True, 1)


def test_second_robot_of_an_id_is_refused_without_the_frames_of_its_loop(
    monkeypatch: pytest.MonkeyPatch, patient_halts: None
) -> None:
    port, until = free_port(), threading.Event()
    monkeypatch.setenv("STRANDS_DC_PORT", str(port))
    toy = ToyRobot("toy")
    first = threading.Thread(target=run, args=(toy,), kwargs={"peer_id": "arm-1", "until": until, "mesh": False})
    first.start()
    try:
        eventually(lambda: status_of(port, "arm-1"))
        with pytest.raises(DuplicateDeviceError, match="'arm-1' is live") as refused:
            run(ToyRobot("second"), peer_id="arm-1", until=threading.Event(), mesh=False)
    finally:
        until.set()
        first.join(30)
        toy.close()
    assert [each.name for each in refused.traceback][1:] == ["run"]
    assert refused.value.__suppress_context__


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_halts_the_robot_and_ends_the_process(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch, patient_halts: None
) -> None:
    monkeypatch.setenv("STRANDS_DC_PORT", str(free_port()))
    process = subprocess.Popen([sys.executable, "-c", SERVE], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        for line in process.stderr:
            if "Serving served-arm" in line:
                break
        else:
            pytest.fail("it never served")
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait(20)
    assert "halted True ['so100']" in out, err
    assert "threads []" in out
    assert process.returncode == 0
