"""What ``serve`` says of a robot that is up and yet not ready, with real ports and processes."""

from __future__ import annotations

import getpass
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from fixtures.command_line import WITHIN_S, Machine
from fixtures.waiting import eventually, free_port

from strands_robots.cli import readiness
from strands_robots.cli.readiness import (
    driver_problem,
    meeting_problem,
    mesh_port_problem,
    other_user,
    port_holder,
    state_problem,
)
from strands_robots.device_connect.backends import loopback_config
from strands_robots.device_connect.backends.zenoh import acquire, release
from strands_robots.device_connect.reachy_mini_driver import ReachyMiniDriver
from strands_robots.drivers.reachy.rest import DaemonUnreachableError, RestClient


@pytest.fixture
def held() -> Iterator[int]:
    """A loopback port on which this process listens, and answers nothing."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        yield listener.getsockname()[1]


def router(port: int) -> Any:
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def test_holder_of_a_port_is_told_with_process_and_user(held: int) -> None:
    uid, holder = port_holder(held)
    assert uid == os.getuid()
    assert f"pid {os.getpid()} (" in holder
    assert f"user {getpass.getuser()}" in holder


def test_second_user_is_told_whose_process_serves_the_robot(held: int, monkeypatch: pytest.MonkeyPatch) -> None:
    link, user = loopback_config(held), getpass.getuser()
    assert other_user(link) == ""
    monkeypatch.setattr(os, "getuid", lambda: 4321)
    assert other_user(link).startswith(f"Robots at the meeting port {held} are served by pid {os.getpid()} (")
    assert f"of user {user} (uid " in other_user(link)


def test_served_robot_names_the_program_that_has_its_meeting_port(held: int, tmp_path: Path) -> None:
    machine = Machine(tmp_path, STRANDS_DC_PORT=str(held))
    with machine.serving("arm-1") as (_, ready):
        (why,) = ready["not_ready"]
    assert f"port {held} is held by pid {os.getpid()} " in why
    assert "no robot process" in why


def test_robot_on_the_mesh_names_the_program_that_has_its_port(held: int, tmp_path: Path) -> None:
    machine = Machine(tmp_path, STRANDS_MESH_PORT=str(held))
    done = machine.run("serve", "so100", "--mesh", "--peer-id", "arm-1")
    assert done.returncode == 1
    said = " ".join((done.stdout + done.stderr).split())
    assert f"The mesh's port {held} is held by pid {os.getpid()} " in said
    assert "no mesh answers there" in said


def test_port_of_the_mesh_that_another_user_or_program_has_is_named(held: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_PORT", str(held))
    assert mesh_port_problem() == ""
    monkeypatch.setattr(readiness, "port_holder", lambda port: (os.getuid() + 1, "pid 7 (python) of user other"))
    assert f"port {held} is held by pid 7 (python) of user other: its robots and this one share" in mesh_port_problem()
    monkeypatch.setattr(readiness, "port_holder", lambda port: (os.getuid(), "pid 7 (rmw_zenohd) of user me"))
    assert "pid 7 (rmw_zenohd) of user me, which is no robot process" in mesh_port_problem()


def test_router_on_the_meeting_port_is_named_and_a_robot_process_is_none() -> None:
    port = free_port()
    link = loopback_config(port)
    first = acquire(link)
    try:
        assert meeting_problem(link) == ""
    finally:
        release(first)
    with router(port):
        second = acquire(link)
        try:
            assert "a Zenoh router" in meeting_problem(link)
        finally:
            release(second)


def test_state_directory_that_cannot_be_written_is_told_once_before_the_first_stop(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    machine = Machine(blocked / "state")
    served = machine.start("serve", "so100", "--peer-id", "arm-1", "--json")
    try:
        assert served.stdout is not None
        (why,) = json.loads(served.stdout.readline())["not_ready"]
        machine.run("estop", "arm-1")
        locked = machine.json("call", "arm-1", "getStatus")[1]["locked"]
    finally:
        served.terminate()
        log = served.communicate(timeout=WITHIN_S)[1]
    assert str(blocked / "state") in why
    assert locked is True
    assert "lockout file was not written" in log
    assert "Traceback" not in log


def test_writable_state_directory_is_no_problem() -> None:
    assert state_problem() == ""


def test_unreachable_reachy_is_logged_once_and_told(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tried: list[str] = []

    def refused(_: RestClient, path: str) -> None:
        tried.append(path)
        raise DaemonUnreachableError("Connection refused.")

    monkeypatch.setattr(RestClient, "get", refused)
    driver = ReachyMiniDriver("127.0.0.1", api_port=free_port())
    driver.reachy.connection.start()
    try:
        eventually(lambda: len(tried) >= 3, what="three attempts")
        said = driver_problem(driver)
    finally:
        driver.reachy.connection.close()
    assert said == "The robot is unavailable: Connection refused. It is tried again."
    assert len([each for each in caplog.records if "is unavailable" in each.message]) == 1
