"""Processes that freeze, die and come back around a stop: the robot ends still, and the record says so."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fixtures.nats_server import NatsServer
from fixtures.robot_process import RobotProcess
from fixtures.waiting import eventually
from fixtures.zenoh_router import ZenohRouter

from strands_robots.audit import read_audit_log, verify_audit_integrity
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.safety_controller import safety_controller
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.persistence import LockoutStore, hardware_key

DIES_AFTER_THE_PUBLISH = """
import os, signal, sys, time
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.safety_controller import safety_controller
transport, endpoint = sys.argv[1:]
link = LinkConfig(transport=transport, connect=(endpoint,), mode="client" if transport == "zenoh" else "auto")

def die(progress):
    time.sleep(1.0)  # the bytes are with the kernel by then, and nothing else is sent meanwhile
    os.kill(os.getpid(), signal.SIGKILL)

controller = safety_controller("safety-1", link)
controller.wait_link(20)
controller.stop(["arm-1"], "last words", on_progress=die)
"""


@pytest.fixture(params=["zenoh", "nats"])
def network(request: pytest.FixtureRequest) -> Iterator[tuple[LinkConfig, ZenohRouter | NatsServer]]:
    if request.param == "nats":
        with NatsServer() as server:
            yield LinkConfig(transport="nats", connect=(server.url,)), server
    else:
        with ZenohRouter() as router:
            yield LinkConfig(connect=(router.endpoint,), mode="client"), router


@pytest.fixture
def start(network: tuple[LinkConfig, ZenohRouter | NatsServer]) -> Iterator[Callable[[str], RobotProcess]]:
    made: list[RobotProcess] = []

    def one(name: str) -> RobotProcess:
        made.append(RobotProcess(network[0], name))
        return made[-1]

    yield one
    for process in made:
        process.close()


@pytest.fixture
def controller(network: tuple[LinkConfig, ZenohRouter | NatsServer]) -> Iterator[SafetyController]:
    made = safety_controller("safety-1", network[0])
    assert made.wait_link(20)
    yield made
    made.close()


def test_a_controller_killed_right_after_its_publish_has_stopped_the_robot(
    network: tuple[LinkConfig, object], start: Callable[[str], RobotProcess]
) -> None:
    robot = start("arm-1")
    assert robot.ask()["moving"]
    run = subprocess.run(
        [sys.executable, "-c", DIES_AFTER_THE_PUBLISH, network[0].transport, network[0].connect[0]],
        cwd=Path(__file__).parents[3],
        timeout=60,
        check=False,
    )
    assert run.returncode == -signal.SIGKILL
    eventually(lambda: robot.ask()["locked"])
    eventually(lambda: not robot.ask()["moving"])


def test_a_frozen_robot_is_silent_by_name_and_stops_when_it_thaws(
    controller: SafetyController, start: Callable[[str], RobotProcess]
) -> None:
    frozen, well = start("arm-1"), start("arm-2")
    frozen.signal(signal.SIGSTOP)
    report = controller.stop(["arm-1", "arm-2"], deadline_s=2.5)
    assert report.silent == ("arm-1",)
    assert set(report.stopped) == {"arm-2"}
    assert well.ask()["locked"]
    frozen.signal(signal.SIGCONT)
    eventually(lambda: frozen.ask()["locked"])
    again = controller.stop(["arm-1"], estop_id=report.estop_id, deadline_s=20)
    assert again.ok
    assert frozen.ask()["halts"] == 1


def test_a_robot_killed_while_locked_comes_back_locked_under_the_same_epoch(
    controller: SafetyController, start: Callable[[str], RobotProcess]
) -> None:
    def kept() -> bool:
        return LockoutStore().load(hardware_key("recording", "arm-1")).state.epochs == (report.estop_id,)

    first = start("arm-1")
    report = controller.stop(["arm-1"], deadline_s=20)
    assert report.ok
    # A verdict does not wait for a slow disk.
    eventually(kept)
    first.signal(signal.SIGKILL)
    for _ in range(2):
        second = start("arm-1")
        # Whatever may have set it moving since, it is halted as it comes up locked.
        eventually(lambda robot=second: robot.ask()["halts"])
        assert second.ask() == {"locked": True, "epochs": [report.estop_id], "moving": False, "writes": 0, "halts": 1}
        second.signal(signal.SIGKILL)
    assert kept()


def test_four_processes_are_stopped_together_and_leave_one_whole_record(
    controller: SafetyController, start: Callable[[str], RobotProcess]
) -> None:
    names = [f"arm-{n}" for n in range(4)]
    robots = [start(name) for name in names]
    report = controller.stop(names, deadline_s=20)
    assert report.ok
    assert not any(robot.ask()["moving"] for robot in robots)
    engaged = eventually(
        lambda: len(all_ := [e for e in read_audit_log() if e["event"] == "remote_estop_engaged"]) == 4 and all_
    )
    assert {each["peer_id"] for each in engaged} == set(names)
    assert verify_audit_integrity()["ok"]


def test_a_broker_killed_and_restarted_in_the_middle_of_a_stop_delivers_it(
    network: tuple[LinkConfig, ZenohRouter | NatsServer],
    controller: SafetyController,
    start: Callable[[str], RobotProcess],
) -> None:
    robot = start("arm-1")
    network[1].kill()
    network[1].start()
    report = controller.stop(["arm-1"], deadline_s=60)
    assert report.ok
    assert robot.ask()["locked"]
