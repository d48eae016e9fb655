"""Connection profiles on real networks: a NATS server with TLS and credentials, and the mesh of another port."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from fixtures.certificates import Authority
from fixtures.command_line import Machine
from fixtures.mesh_peer import MeshPeer
from fixtures.nats_credentials import NatsAccounts, credentials_file
from fixtures.nats_server import NatsServer
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually, free_port

from strands_robots import connect, settings
from strands_robots.device_connect import init_device_connect_sync, stop_device_connect
from strands_robots.device_connect.backends import link_from_environment
from strands_robots.errors import UnreachableError
from strands_robots.fleet.adapter import MESH
from strands_robots.mesh import init_mesh
from strands_robots.mesh.session import clear_peers

pytestmark = pytest.mark.timeout(300)


@pytest.fixture
def fleets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the profiles; a shell of its own on both networks."""
    folder = tmp_path / "fleets"
    folder.mkdir(mode=0o700)
    monkeypatch.setenv("STRANDS_FLEETS_DIR", str(folder))
    for name in ("STRANDS_DC_PORT", "STRANDS_MESH_PORT"):
        monkeypatch.setenv(name, str(free_port()))
    return folder


def write(folder: Path, content: str, name: str = "lab") -> None:
    file = folder / f"{name}.toml"
    file.write_text(content)
    file.chmod(0o600)


@pytest.fixture
def broker(fleets: Path, tmp_path: Path) -> Iterator[NatsServer]:
    """A server with a robot, and the profile with the operator's credentials beside it."""
    authority, accounts, toy = Authority(tmp_path), NatsAccounts(), ToyRobot("toy")
    identity = authority.issue("nats")
    with NatsServer(identity, accounts.server_lines) as server:
        for user, token in (("arm-1", accounts.device("arm-1", "lab")), ("operator", accounts.operator("lab"))):
            credentials_file(fleets, user, token, url=server.url, identity=identity, tenant="lab")
        write(fleets, 'credentials = "operator.creds.json"\nname = "bench"')
        link = link_from_environment(credentials_file=fleets / "arm-1.creds.json")
        runtime = init_device_connect_sync(toy, peer_id="arm-1", link=link)
        try:
            yield server
        finally:
            stop_device_connect(runtime)
            toy.close()


def test_profile_reaches_a_server_with_tls_and_credentials(
    broker: NatsServer, fleets: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with connect(mesh=False) as here:
        assert here.robots() == []
    # What the shell names is another fleet's.
    monkeypatch.setenv("NATS_URL", "nats://127.0.0.1:1")
    monkeypatch.setenv("TENANT", "other")
    with connect("lab") as fleet:
        assert [each.id for each in fleet.robots()] == ["arm-1"]
        assert fleet.absent == {MESH: "the connection profile lab has none"}
        assert fleet["arm-1"].status()["task_status"] == "idle"
        assert fleet["arm-1"].halt().stopped is True
    with connect("lab", tenant="elsewhere") as fleet:
        assert fleet.robots() == []
    write(fleets, f'nats = "{broker.url}"\ninsecure = true', "bare")
    with pytest.raises(UnreachableError), connect("bare") as fleet:
        fleet.robots()


def test_commands_reach_it_by_the_profile_alone(broker: NatsServer, fleets: Path, tmp_path: Path) -> None:
    (tmp_path / "state").mkdir(mode=0o700)
    machine = Machine(tmp_path / "state", STRANDS_FLEETS_DIR=str(fleets))
    assert machine.json("peers")[0] == 3
    code, listed = machine.json("peers", "--fleet", "lab")
    assert (code, [each["id"] for each in listed["peers"]]) == (0, ["arm-1"])
    code, stopped = machine.json("stop", "arm-1", "--fleet", str(fleets / "lab.toml"))
    assert (code, stopped["devices"]["arm-1"]["stopped"]) == (0, True)
    refused = machine.run("call", "arm-1", "execute", "instruction=wave", "duration=1", "--fleet", "lab")
    assert refused.returncode == 1
    assert "bench" in refused.stdout + refused.stderr
    by_setting = Machine(tmp_path / "state", STRANDS_FLEETS_DIR=str(fleets), STRANDS_FLEET="lab")
    assert by_setting.json("call", "arm-1", "getStatus")[0] == 0
    assert by_setting.json("peers", "--port", str(free_port()))[0] == 3
    (fleets / "lab.toml").chmod(0o622)
    for words in (("estop",), ("stop", "--all")):
        ended = machine.run(*words, "--fleet", "lab")
        assert (ended.returncode, "others may write it" in ended.stderr) == (2, True)


def test_fleet_without_a_profile_does_not_reach_that_of_the_profile_just_left(fleets: Path, tmp_path: Path) -> None:
    there = free_port()
    write(fleets, f"port = {free_port()}\n[mesh]\nport = {there}")
    with mesh_robot("lab-1", there, tmp_path / "there"), ExitStack() as stack:
        with connect("lab") as fleet:
            eventually(lambda: "lab-1" in fleet, what="the robot of the profile")
            mine = init_mesh(None, "mine", "tool")
            assert mine is not None
            stack.callback(mine.close)
        with connect() as fleet:
            assert MESH in fleet.absent
            assert fleet.robots() == []
            assert "lab-1" not in fleet.stop()
    clear_peers()


@contextmanager
def mesh_robot(name: str, port: int, folder: Path) -> Iterator[None]:
    """A world on the mesh of a port, in another process."""
    folder.mkdir(mode=0o700)
    peer = MeshPeer(name, "world", {"STRANDS_MESH_PORT": str(port), "STRANDS_STATE_DIR": str(folder)})
    try:
        yield
    finally:
        peer.close()


def test_mesh_of_a_profile_is_that_fleets_alone(fleets: Path, tmp_path: Path) -> None:
    here, there = settings.integer("STRANDS_MESH_PORT"), free_port()
    write(fleets, f"port = {free_port()}\n[mesh]\nport = {there}")
    write(fleets, f"port = {free_port()}", "devices")
    (tmp_path / "state").mkdir(mode=0o700)
    machine = Machine(tmp_path / "state", STRANDS_FLEETS_DIR=str(fleets), STRANDS_MESH_PORT=str(here))
    with mesh_robot("near-1", here, tmp_path / "near"), mesh_robot("lab-1", there, tmp_path / "there"):
        with connect("lab") as fleet:
            eventually(lambda: "lab-1" in fleet, what="the robot of the profile")
            assert "near-1" not in fleet
            with connect() as other:
                assert "connection profile" in other.absent[MESH]
            assert {name: verdict.stopped for name, verdict in fleet.stop().items()} == {"lab-1": True}
        assert settings.integer("STRANDS_MESH_PORT") == here
        with connect() as fleet:
            eventually(lambda: "near-1" in fleet, what="the robot of this machine")
            assert "lab-1" not in fleet
        with connect("lab") as fleet:
            eventually(lambda: "lab-1" in fleet, what="the robot of the profile again")
            assert "near-1" not in fleet
        peers = machine.json("peers", "--mesh", "--fleet", "lab")[1]["peers"]
        assert "lab-1" in {each["peer_id"] for each in peers}
        assert "near-1" not in {each["peer_id"] for each in peers}
        ended = machine.run("estop", "--mesh", "--fleet", "devices")
        assert (ended.returncode, "has no mesh" in ended.stderr) == (2, True)
        stopped = machine.run("estop", "--mesh", "--fleet", "lab")
        assert stopped.returncode == 0, stopped.stdout + stopped.stderr
        locked = {each["peer_id"]: each["locked"] for each in machine.json("peers", "--mesh")[1]["peers"]}
        assert locked["near-1"] is False
    clear_peers()
