"""Commands on Device Connect and on the mesh at once: real networks at one port, as by default."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from fixtures.command_line import Machine
from fixtures.mesh_peer import MeshPeer
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect import (
    DuplicateDeviceError,
    init_device_connect_sync,
    loopback_config,
    stop_device_connect,
)
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.mesh import init_mesh
from strands_robots.safety.ed25519 import keygen

pytestmark = [pytest.mark.timeout(600), pytest.mark.usefixtures("patient_halts")]

TASK = ("instruction=wave", "duration=300", "policy_provider=mock")
PASSPHRASE = "Plenty of 4 different words"


class Site:
    """Robots of both networks at one port, and commands as processes beside them."""

    def __init__(self, state: Path, folder: Path) -> None:
        self.port, self.state, self._folder = free_port(), state, folder
        ports = {name: str(self.port) for name in ("STRANDS_DC_PORT", "STRANDS_MESH_PORT")}
        self.machine = Machine(state, **ports)
        self.stack = ExitStack()

    def device(self, name: str) -> ToyRobot:
        """Serve a robot on Device Connect, from this process."""
        toy = ToyRobot(name)
        runtime = init_device_connect_sync(toy, peer_id=name, link=loopback_config(self.port))
        self.stack.callback(toy.close)
        self.stack.callback(stop_device_connect, runtime)
        return toy

    def peer(self, name: str) -> MeshPeer:
        """Serve a simulated world on the mesh, from a process with a state directory of its own."""
        state = self._folder / name
        state.mkdir(mode=0o700, exist_ok=True)
        settings = {"STRANDS_MESH_PORT": str(self.port), "STRANDS_STATE_DIR": str(state)}
        peer = self.stack.enter_context(MeshPeer(name, "world", settings))
        eventually(lambda: name in self.rows(), within=60, what=f"{name} on the mesh")
        return peer

    def rows(self) -> dict[str, dict[str, Any]]:
        """The robots that ``peers`` lists, by id."""
        said = self.machine.json("peers")[1]
        return {each["id"]: each for each in said["peers"]}

    def refused(self, *line: str) -> tuple[int, str]:
        """Run a command that fails; return its exit code and its reason."""
        code, said = self.machine.json(*line)
        return code, said["reason"]


@pytest.fixture
def site(state_directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    for name, value in (
        ("DEVICE_CONNECT_RPC_ALLOW", "*"),
        ("DEVICE_CONNECT_ESTOP_ALLOW", "*"),
        ("BYPASS_TOOL_CONSENT", "true"),
    ):
        monkeypatch.setenv(name, value)
    site = Site(state_directory, tmp_path)
    with site.stack:
        yield site


def running(toy: ToyRobot) -> bool:
    return bool(toy.get_task_status()["task_status"] == "running")


def test_robots_of_both_networks_are_listed_called_watched_and_stopped(site: Site) -> None:
    toy, _ = site.device("arm-1"), site.peer("arm-2")
    # The second time is like the first.
    for _ in range(2):
        rows = site.rows()
        assert {name: (row["network"], row["also_on"]) for name, row in rows.items()} == {
            "arm-1": (DEVICE_CONNECT, []),
            "arm-2": (MESH, []),
        }
        shown = site.machine.run("peers").stdout
        assert "device_connect" in shown and "mesh" in shown
        for name in ("arm-1", "arm-2"):
            for verb in ("getStatus", "status"):
                code, said = site.machine.json("call", name, verb)
                assert (code, said["status"]) == (0, "success"), said
            assert site.machine.json("call", name, "start", *TASK)[0] == 0
            assert site.machine.run("watch", name, "--for", "1").returncode == 0
        assert running(toy)
        watched = site.machine.run("watch", "arm-2", "--for", "2", "--json").stdout
        assert "state" in {json.loads(line)["event"] for line in watched.splitlines()}
        for name in ("arm-1", "arm-2"):
            assert site.machine.json("call", name, "stop")[0] == 0
        assert not running(toy)
    code, said = site.refused("call", "arm-9", "getStatus")
    assert (code, "arm-9" in said) == (3, True)


def test_id_of_two_robots_is_read_on_one_and_moved_on_none(site: Site) -> None:
    toy, _ = site.device("twin"), site.peer("twin")
    assert (site.rows()["twin"]["network"], site.rows()["twin"]["also_on"]) == (DEVICE_CONNECT, [MESH])
    assert site.machine.json("call", "twin", "getStatus")[0] == 0
    for _ in range(2):
        code, said = site.refused("call", "twin", "start", *TASK)
        assert (code, "device_connect and mesh both have a robot of this id" in said) == (1, True), said
    assert not running(toy)
    code, said = site.refused("enroll", "twin")
    assert (code, said.startswith("ALARM: twin shows another key on each network")) == (1, True), said
    # The one that is enrolled is moved.
    assert site.machine.json("enroll", "twin", "--mesh")[0] == 0
    assert site.machine.json("call", "twin", "start", *TASK)[0] == 0
    assert not running(toy)
    toy.start_task("wave", duration=300)
    code, said = site.machine.json("call", "twin", "stop")
    assert (code, said["stopped"]) == (0, True), said
    assert not running(toy)
    assert site.machine.json("call", "twin", "status", "--mesh")[1]["task_status"] != "running"


def test_id_of_one_robot_on_both_networks_is_moved_enrolled_and_resumed_once(
    site: Site, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file, secret = tmp_path / "operator.pem", tmp_path / "passphrase"
    secret.write_text(PASSPHRASE)
    secret.chmod(0o600)
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", keygen(file, PASSPHRASE))
    monkeypatch.setenv("STRANDS_MESH_PORT", str(site.port))
    toy = site.device("twin")
    mesh = init_mesh(toy, "twin")
    assert mesh is not None
    site.stack.callback(mesh.close)
    eventually(lambda: site.rows()["twin"]["also_on"] == [MESH], within=60, what="twin on both")
    assert site.machine.json("call", "twin", "start", *TASK)[0] == 0
    assert running(toy)
    assert site.machine.json("enroll")[1]["devices"]["twin"]["outcome"] == "enrolled"
    assert site.machine.json("estop", "--mesh")[0] == 0
    code, said = site.machine.json("lockout")
    assert (code, said["live"]["twin"]["locked"]) == (0, True)
    resume = ("resume", "--key", str(file), "--passphrase-file", str(secret))
    for _ in range(2):
        code, said = site.machine.json(*resume)
        assert (code, said["devices"]["twin"]["free"]) == (0, True), said
    assert site.machine.json("lockout")[1]["live"]["twin"]["locked"] is False


def test_second_process_of_a_robot_is_refused_on_the_other_network(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_PORT", str(site.port))
    site.device("arm-1")
    code, said = site.refused("serve", "so100", "--mesh", "--peer-id", "arm-1")
    assert (code, f"arm-1 is served already by process {os.getpid()}" in said) == (1, True), said
    assert "on Device Connect" in said and "STRANDS_STATE_DIR" in said
    assert site.rows()["arm-1"]["also_on"] == []
    settings = {"STRANDS_MESH_PORT": str(site.port), "STRANDS_STATE_DIR": str(site.state)}
    with MeshPeer("arm-2", "world", settings) as peer:
        peer.ask("epoch")
        for _ in range(2):
            with pytest.raises(DuplicateDeviceError, match="on the native mesh"):
                site.device("arm-2")
        mesh_taken = site.refused("serve", "so100", "--mesh", "--peer-id", "arm-2")
        assert (mesh_taken[0], "on the native mesh" in mesh_taken[1]) == (1, True), mesh_taken
        # A frozen one would wake and move.
        peer.signal(signal.SIGSTOP)
        with pytest.raises(DuplicateDeviceError):
            site.device("arm-2")
        peer.kill()
        site.device("arm-2")
    assert site.rows()["arm-2"]["also_on"] == []


def test_resume_at_the_machine_of_a_robot_that_is_not_locked_says_so(site: Site) -> None:
    site.device("arm-1")
    code, said = site.machine.json("resume", "--local", "arm-1")
    assert (code, said["reason"]) == (1, "Nothing is locked here: arm-1.")
    assert said["devices"]["arm-1"] == {"free": None, "said": "not locked here"}
    assert "LOCKED" not in site.machine.run("resume", "--local", "arm-1").stdout


def test_device_connect_alone_at_the_port_is_as_quick_as_ever_and_loads_no_mesh(site: Site) -> None:
    site.device("arm-1")
    code, said = site.machine.json("peers")
    assert (code, said["absent"], [each["id"] for each in said["peers"]]) == (0, {}, ["arm-1"])
    assert "mesh" not in site.machine.run("peers").stdout
    for line in (("peers",), ("call", "arm-1", "getStatus"), ("call", "arm-1", "start", *TASK)):
        program = (
            "import sys; from strands_robots.cli.app import build\n"
            f"try: build({line[0]!r})()\nexcept SystemExit as ended: print(ended.code, "
            "[name for name in sys.modules if name.startswith('strands_robots.mesh')])"
        )
        result = subprocess.run(
            [sys.executable, "-c", program, *line],
            env=site.machine.environment,
            capture_output=True,
            text=True,
            timeout=100,
            check=True,
        )
        assert result.stdout.splitlines()[-1] == "0 []", result


def test_robot_of_the_mesh_is_reached_while_the_broker_of_device_connect_is_down(site: Site) -> None:
    site.peer("arm-2")
    broker = ("--nats", f"nats://127.0.0.1:{free_port()}")
    code, said = site.machine.json("peers", *broker)
    assert (code, [each["id"] for each in said["peers"]], list(said["absent"])) == (0, ["arm-2"], [DEVICE_CONNECT])
    assert "Not reached: device_connect, " in site.machine.run("peers", *broker).stdout
    assert site.machine.json("call", "arm-2", "getStatus", *broker)[0] == 0
    code, reason = site.refused("call", "arm-9", "getStatus", *broker)
    assert (code, "Not reached: device_connect, " in reason) == (3, True)
    code, said = site.machine.json("lockout", *broker)
    assert (code, said["live"]["arm-2"]["locked"], list(said["absent"])) == (0, False, [DEVICE_CONNECT])


def test_no_network_in_reach_is_exit_3_in_the_words_of_device_connect(site: Site) -> None:
    code, reason = site.refused("peers", "--nats", f"nats://127.0.0.1:{free_port()}")
    assert (code, reason.startswith("The network does not carry this: ")) == (3, True)
    assert "mesh" not in reason
    code, reason = site.refused("peers")
    assert (code, "nothing leaves 127.0.0.1" in reason, "mesh" in reason) == (3, True, False)
    code, reason = site.refused("peers", "--mesh")
    assert (code, "no mesh answers" in reason) == (3, True)


@contextmanager
def hostile_peer(port: int) -> Iterator[None]:
    """A session that announces a peer whose every text is an order to the terminal."""
    over, evil = threading.Event(), "\x1b]0;owned\x07\u202e[red]"
    config = {"mode": "client", "namespace": "strands", "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"]}}
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    presence = {"robot_id": "evil-1", "robot_type": evil, "hostname": evil, "tool_name": evil, "robot_kind": evil}
    presence |= {"network": DEVICE_CONNECT, "id": "arm-1", "tags": [evil] * 500, "task_status": evil * 500}

    def announce() -> None:
        number = 0
        while not over.wait(0.3):
            number += 1
            body = {**presence, "timestamp": time.time()}
            session.put("strands/evil-1/presence", json.dumps(body), source_info=zenoh.SourceInfo(session.id, number))

    thread = threading.Thread(target=announce, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        session.close()


def test_description_of_a_hostile_peer_controls_neither_terminal_nor_programs(site: Site) -> None:
    site.device("arm-1")
    site.peer("arm-2")
    with hostile_peer(site.port):
        row = eventually(lambda: site.rows().get("evil-1"), within=60, what="the hostile peer")
        assert (row["id"], row["network"], row["also_on"]) == ("evil-1", MESH, [])
        assert site.rows()["arm-1"]["network"] == DEVICE_CONNECT
        for line in (("peers",), ("peers", "evil-1"), ("call", "evil-1"), ("call", "evil-1", "spin")):
            done = site.machine.run(*line)
            shown = done.stdout + done.stderr
            assert "Traceback" not in shown
            assert not {"\x1b", "\x07", "\u202e"} & {*shown}, line


def test_commands_of_the_page_of_the_mesh_print_what_stands_there(tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs" / "mesh.md").read_text("utf-8")
    served, block = re.findall(r"```console\n(.*?)```", page, re.DOTALL)[:2]
    ports = dict.fromkeys(("STRANDS_DC_PORT", "STRANDS_MESH_PORT"), str(free_port()))
    machine = Machine(tmp_path / "state", **ports)
    assert served.splitlines()[0] == "$ strands-robots serve so100 --mesh --peer-id arm-1"
    with machine.serving("arm-1", "--mesh"):
        eventually(lambda: machine.run("peers").returncode == 0, within=60, what="the arm on the mesh")
        for part in block.split("$ strands-robots ")[1:]:
            line, _, printed = part.partition("\n")
            done = machine.run(*shlex.split(line, comments=True))
            assert done.returncode == 0, (line, done.stderr)
            # The first line of what stands there: the heads of a table.
            heads = printed.partition("\n")[0].split()
            assert heads == [] or heads in [each.split() for each in done.stdout.splitlines()], (line, done.stdout)


def test_robots_of_both_networks_are_recorded_in_one_file(site: Site, tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    from strands_robots.recording.file import read_items  # noqa: PLC0415 - needs the extra

    site.device("arm-1")
    site.peer("arm-2")
    run = tmp_path / "run.mcap"
    recording = site.machine.start("record", "*", "--out", str(run), "--json")

    def recorded() -> set[str]:
        return {item.device for item in read_items(run)} if run.exists() else set()

    try:
        eventually(lambda: "arm-2" in recorded(), within=60, what="states of the mesh")
        assert site.machine.json("call", "arm-1", "start", *TASK)[0] == 0
        eventually(lambda: "arm-1" in recorded(), within=60, what="steps of Device Connect")
    finally:
        recording.send_signal(2)
        out, complaints = recording.communicate(timeout=60)
    assert recording.returncode == 0, complaints
    assert json.loads(out.splitlines()[-1])["lost"] == 0
