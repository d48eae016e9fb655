"""A Reachy Mini served on the network by one command."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
from fixtures.reachy_daemon.process import Daemon, Kind
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect import FleetClient, loopback_config
from strands_robots.robot import Robot

pytestmark = pytest.mark.timeout(90)


@pytest.fixture(scope="module")
def shared() -> Iterator[Daemon]:
    with Daemon(Kind("1.13.0")) as daemon:
        yield daemon


def test_factory_makes_a_reachy_that_connects_by_itself(daemon: Daemon) -> None:
    robot = Robot("reachy_mini", mode="real", host="127.0.0.1", api_port=daemon.port)
    try:
        eventually(lambda: robot.is_connected, what="joint data")
        assert robot.halt("test").stopped is True
    finally:
        robot.cleanup()
    assert not robot.is_connected


def test_serve_puts_a_reachy_on_the_network_and_an_interrupt_stops_it(daemon: Daemon) -> None:
    port = free_port()
    arguments = f"serve reachy_mini --host 127.0.0.1 --set api_port={daemon.port} --peer-id head --port {port}"
    arguments += " --rpc-allow tester --command-allow shake --json"
    serving = subprocess.Popen(
        [sys.executable, "-m", "strands_robots.cli", *arguments.split()], stdout=subprocess.PIPE, text=True
    )
    assert serving.stdout is not None
    try:
        line = json.loads(serving.stdout.readline())
        assert (line["event"], line["peer_id"]) == ("serving", "head")
        with FleetClient(loopback_config(port), "tester") as fleet:
            eventually(lambda: fleet.call("head", "getStatus", {})["connected"], what="the daemon")
            assert fleet.call("head", "shake", {})["status"] == "success"
            eventually(lambda: len(daemon.frames()) > 5, what="frames")
            serving.send_signal(signal.SIGINT)
            serving.wait(60)
        eventually(lambda: daemon.control()["sockets"] == 0, what="every frame that was sent, received")
        sent = len(daemon.frames())
        time.sleep(0.2)
        assert len(daemon.frames()) == sent
    finally:
        serving.kill()
        serving.wait()
