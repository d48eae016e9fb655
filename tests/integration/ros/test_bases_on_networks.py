"""Bases on the networks: driven by RPC, stopped by the real stop lane and by the mesh, held by the lockout.

The base is a process on loopback DDS, and a listener of its own there says what really went out on its velocity topic.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.base_process import base_process
from fixtures.mesh_peer import MeshPeer
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect import (
    FleetClient,
    LinkConfig,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.device_connect.safety_controller import safety_controller
from strands_robots.drivers.ros.rtps_robot import RtpsRobot
from strands_robots.mesh import init_mesh
from strands_robots.ros.dds import DdsLink
from strands_robots.safety import ed25519
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.estop_listener import estop_listener
from strands_robots.safety.plane import plane
from strands_robots.safety.resume import sign

DOMAIN = 83
RATE_HZ = 20.0
ROOT = Path(__file__).resolve().parents[3]
DRIVE = {"linear": 0.5, "angular": 0.0, "duration": 30.0}


class Sent:
    """What went out on the velocity topic, with its time."""

    def __init__(self) -> None:
        self.all: list[tuple[float, float]] = []

    def __call__(self, message: Mapping[str, Any]) -> None:
        self.all.append((time.monotonic(), message["linear"]["x"]))

    def zeros(self) -> int:
        """Return once the last word is a zero, which is in the order of sending; how many words that were."""
        return eventually(lambda: (seen := list(self.all))[-1][1] == 0 and len(seen), what="a zero")

    def only_zeros_since(self, count: int) -> bool:
        return all(speed == 0 for _, speed in self.all[count:])


@pytest.fixture(autouse=True)
def surroundings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "tester")
    monkeypatch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", "drive")
    monkeypatch.setenv("STRANDS_ROS2_COMMAND_ALLOW", "cmd_vel")


@pytest.fixture
def wheels() -> Iterator[None]:
    with base_process(DOMAIN):
        yield


@pytest.fixture
def sent() -> Iterator[Sent]:
    link, found = DdsLink(DOMAIN), Sent()
    link.watch("/cmd_vel", "geometry_msgs/msg/Twist", found)
    yield found
    link.close()


Made = Callable[[str | None], RtpsRobot]


@pytest.fixture
def made(wheels: None) -> Iterator[Made]:
    """Makes the base, with an odometry topic or without."""
    with ExitStack() as stack:

        def make(odom_topic: str | None) -> RtpsRobot:
            robot = RtpsRobot("rover", "/cmd_vel", odom_topic=odom_topic, domain_id=DOMAIN, publish_rate=RATE_HZ)
            stack.callback(robot.disconnect)
            assert robot.advertise()["status"] == "success"
            return robot

        yield make


@pytest.fixture(params=["zenoh", "nats"])
def link(request: pytest.FixtureRequest) -> Iterator[LinkConfig]:
    if request.param == "nats":
        with NatsServer() as server:
            yield LinkConfig(transport="nats", connect=(server.url,))
    else:
        yield loopback_config(free_port())


class Site:
    """The base as the device ``base-1``, an agent that drives it, and a controller that stops it."""

    def __init__(self, robot: RtpsRobot, link: LinkConfig) -> None:
        self.robot = robot
        self._stack = ExitStack()
        runtime = init_device_connect_sync(robot, peer_id="base-1", link=link, allow_insecure=True)
        self._stack.callback(stop_device_connect, runtime)
        self._agent = self._stack.enter_context(FleetClient(link, "tester"))
        self.controller: SafetyController = safety_controller("safety-1", link)
        self._stack.callback(self.controller.close)
        eventually(lambda: self.controller.link_up and all(each.link.up for each in estop_listener().registrations))

    def call(self, verb: str, arguments: dict[str, Any]) -> dict[str, Any]:
        answer: dict[str, Any] = self._agent.call("base-1", verb, arguments)
        return answer

    def close(self) -> None:
        self._stack.close()


@pytest.fixture
def site(link: LinkConfig) -> Iterator[Callable[[RtpsRobot], Site]]:
    with ExitStack() as stack:

        def serve(robot: RtpsRobot) -> Site:
            served = Site(robot, link)
            stack.callback(served.close)
            return served

        yield serve


def test_locked_base_gets_zeros_until_still_and_no_drive_until_a_signed_resume(
    made: Made, site: Callable[[RtpsRobot], Site], sent: Sent, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = Ed25519PrivateKey.generate()
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", ed25519.encode(ed25519.public_half(key)))
    robot = made("/odom")
    here = site(robot)
    assert "duration" in here.call("drive", {"linear": 0.5, "angular": 0.0})["reason"]
    began = time.monotonic()
    assert here.call("drive", DRIVE)["status"] == "success"
    assert time.monotonic() - began < DRIVE["duration"] - 5
    eventually(lambda: sent.all and sent.all[-1][1] == 0.5)
    report = here.controller.stop(["base-1"], "test")
    assert report.ok, report
    stopped = sent.zeros()
    assert robot.get_state()["still"] is True
    refused = here.call("drive", DRIVE)
    assert (refused["status"], report.estop_id in refused["reason"], "safety-1" in refused["reason"]) == (
        "error",
        True,
        True,
    )
    assert report.estop_id in robot.drive(0.5)["reason"]
    eventually(lambda: not robot.holding)
    assert sent.only_zeros_since(stopped)
    (assertion,) = sign(key, report.estop_id, ["base-1"])
    assert here.call("resume", {"assertion": assertion})["locked"] is False
    assert sent.only_zeros_since(stopped)
    locked = len(sent.all)
    assert here.call("drive", DRIVE | {"duration": 0.3})["status"] == "success"
    eventually(lambda: 0.5 in [speed for _, speed in sent.all[locked:]])
    sent.zeros()


@pytest.mark.parametrize("link", ["zenoh"], indirect=True)
def test_a_locked_base_without_odometry_gets_zeros_for_five_seconds_at_its_rate(
    made: Made, site: Callable[[RtpsRobot], Site], sent: Sent
) -> None:
    robot = made(None)
    here = site(robot)
    assert here.call("drive", DRIVE)["status"] == "success"
    eventually(lambda: sent.all and sent.all[-1][1] == 0.5)
    report = here.controller.stop(["base-1"], "test")
    assert report.ok, report
    stopped = sent.zeros()
    eventually(lambda: not robot.holding)
    assert sent.only_zeros_since(stopped)
    zeros = sent.all[1 + max(at for at, (_, speed) in enumerate(sent.all) if speed) :]
    assert 4.0 < zeros[-1][0] - zeros[0][0] < 15.0
    # A hold whose rate is not the base's own sends five.
    assert len(zeros) > 0.2 * 5.0 * RATE_HZ
    assert report.estop_id in here.call("drive", DRIVE)["reason"]
    assert "base-1" in plane().clear_local("test")


def test_emergency_stop_over_the_mesh_locks_a_base(
    made: Made, sent: Sent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = str(free_port())
    monkeypatch.setenv("STRANDS_MESH_PORT", port)
    tmp_path.chmod(0o700)
    robot = made("/odom")
    mesh = init_mesh(robot, "base-1", "robot")
    assert mesh is not None
    try:
        with ExitStack() as stack:
            console = MeshPeer("console", "none", {"STRANDS_MESH_PORT": port, "STRANDS_STATE_DIR": str(tmp_path)})
            stack.callback(console.close)
            console.sees("base-1")
            assert robot.start_drive(0.5, 0.0, 30.0)["status"] == "success"
            eventually(lambda: sent.all and sent.all[-1][1] == 0.5)
            assert console.ask("send", "base-1", {"action": "stop"}, 20)["result"]["ok"] is True
            assert robot.get_task_status()["task_status"] == "stopped"
            assert robot.start_drive(0.5, 0.0, 30.0)["status"] == "success"
            eventually(lambda: sent.all and sent.all[-1][1] == 0.5)
            console.ask("estop")
            eventually(lambda: mesh.lockout_epoch)
            stopped = sent.zeros()
            eventually(
                lambda: mesh.lockout_epoch in robot.drive(0.5)["reason"], what="the lockout, once the drive ended"
            )
            eventually(lambda: robot.get_state()["still"] and not robot.holding)
            assert sent.only_zeros_since(stopped)
            plane().clear_local("test")
    finally:
        mesh.close()
