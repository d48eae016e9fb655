"""Commands on two networks at once: one table, one robot for each id, and words where one network is gone."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from fixtures.waiting import free_port
from tests.cli.conftest import Run
from tests.fleet.scripted import OURS, ScriptedNetwork, function

from strands_robots.cli.network import Network
from strands_robots.cli.output import Exit
from strands_robots.envelope import error, success
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH, FoundRobot
from strands_robots.fleet.networks import Networks
from strands_robots.safety.ed25519 import keygen
from strands_robots.safety.identity import ROBOTS, KeyFile

OWN = (*OURS, function("brewCoffee"), function("beansLeft", "read"))
EPOCH = "e" * 32


@pytest.fixture
def near() -> ScriptedNetwork:
    return ScriptedNetwork(DEVICE_CONNECT, {"arm-1": OWN, "both": OWN})


@pytest.fixture
def far() -> ScriptedNetwork:
    return ScriptedNetwork(MESH, {"arm-2": OWN, "both": OWN})


@pytest.fixture(autouse=True)
def networks(monkeypatch: pytest.MonkeyPatch, near: ScriptedNetwork, far: ScriptedNetwork) -> list[str]:
    """Both networks in the place of those of the flags; the list has the networks that no one asked for."""
    unasked: list[str] = []
    monkeypatch.setattr(Network, "networks", lambda *_, **__: Networks([near, far], unasked=unasked))
    return unasked


@pytest.fixture
def key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[str, ...]:
    """The flags that name the operator's key."""
    file, secret = tmp_path / "operator.pem", tmp_path / "passphrase"
    secret.write_text("Plenty of 4 different words")
    secret.chmod(0o600)
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", keygen(file, secret.read_text()))
    return ("--key", str(file), "--passphrase-file", str(secret))


def asked(network: ScriptedNetwork) -> list[tuple[str, str]]:
    return [(robot, verb) for robot, verb, _, _ in network.calls]


class TestPeers:
    def test_robots_of_both_are_in_one_table_an_id_on_both_once(self, run: Run) -> None:
        rows = [line.split() for line in run("peers").stdout.splitlines() if "strands_robot" in line]
        assert [(row[0], *row[-1:]) for row in rows] == [
            ("arm-1", "device_connect"),
            ("arm-2", "mesh"),
            ("both", "mesh"),
        ]
        assert "device_connect, mesh" in run("peers").stdout

    def test_programs_always_read_the_network(self, run: Run, far: ScriptedNetwork) -> None:
        rows = json.loads(run("peers", "--json").stdout)["peers"]
        assert [(row["id"], row["network"], row["also_on"]) for row in rows] == [
            ("arm-1", DEVICE_CONNECT, []),
            ("arm-2", MESH, []),
            ("both", DEVICE_CONNECT, [MESH]),
        ]
        far.robots.clear()
        said = json.loads(run("peers", "--json").stdout)
        assert [row["network"] for row in said["peers"]] == [DEVICE_CONNECT, DEVICE_CONNECT]

    def test_network_is_shown_only_where_two_have_robots(self, run: Run, far: ScriptedNetwork) -> None:
        assert "network" in run("peers").stdout
        far.robots.clear()
        assert "network" not in run("peers").stdout
        assert DEVICE_CONNECT not in run("peers").stdout

    def test_robot_that_is_locked_on_one_of_two_is_shown_as_locked(
        self, run: Run, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def known(name: str) -> FoundRobot:
            assert far.joined
            return FoundRobot(name, facts={"locked": True})

        monkeypatch.setattr(far, "known", known)
        locked = [line.split()[0] for line in run("peers").stdout.splitlines() if "LOCKED" in line]
        assert locked == ["both"]

    def test_what_a_robot_of_either_network_can_do_is_listed(self, run: Run) -> None:
        for name in ("arm-1", "arm-2", "both"):
            assert "brewCoffee" in run("peers", name).stdout
            assert "brewCoffee" in run("call", name).stdout

    def test_facts_of_a_robot_cannot_pass_for_its_network(
        self, run: Run, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        said = {"network": DEVICE_CONNECT, "id": "arm-1", "also_on": "all", "hostname": "\x1b[2Jdesk"}
        monkeypatch.setattr(far, "find", lambda *_, **__: [FoundRobot("arm-2", facts=said)])
        row = json.loads(run("peers", "arm-2", "--json").stdout)["peers"][0]
        assert (row["id"], row["network"], row["also_on"]) == ("arm-2", MESH, [])
        assert "\x1b" not in run("peers").stdout


class TestCall:
    def test_robot_is_called_where_it_is(self, run: Run, near: ScriptedNetwork, far: ScriptedNetwork) -> None:
        assert run("call", "arm-2", "moveTo", "x=1").exit_code == 0
        assert run("call", "arm-2", "getStatus").exit_code == 0
        assert run("call", "arm-2", "brewCoffee").exit_code == 0
        assert asked(far) == [("arm-2", "moveTo"), ("arm-2", "getStatus"), ("arm-2", "brewCoffee")]
        assert asked(near) == [("arm-2", "getStatus")]

    @pytest.mark.parametrize("verb", ["moveTo", "brewCoffee"])
    def test_motion_of_an_id_of_two_robots_is_refused_naming_both(
        self, run: Run, near: ScriptedNetwork, far: ScriptedNetwork, verb: str
    ) -> None:
        result = run("call", "both", verb)
        assert result.exit_code == Exit.REFUSED
        assert f"{verb} is sent to neither: device_connect and mesh both have a robot" in result.stderr
        assert "--mesh means the one on the mesh" in result.stderr
        assert json.loads(run("call", "both", verb, "--json").stdout)["exit"] == 1
        assert verb not in {each for _, each in (*asked(near), *asked(far))}

    def test_motion_of_one_robot_on_both_goes_to_the_first(
        self, run: Run, near: ScriptedNetwork, far: ScriptedNetwork, tmp_path: Path
    ) -> None:
        own = KeyFile(ROBOTS, "both", tmp_path).load_or_make()
        for each in (near, far):
            each.sign_with(own)
        assert run("call", "both", "moveTo", "x=1").exit_code == 0
        assert asked(near)[-1] == ("both", "moveTo")

    @pytest.mark.parametrize("verb", ["getStatus", "beansLeft"])
    def test_read_of_an_id_on_both_goes_to_the_first(
        self, run: Run, near: ScriptedNetwork, far: ScriptedNetwork, verb: str
    ) -> None:
        assert run("call", "both", verb).exit_code == 0
        assert (asked(near), asked(far)) == ([("both", verb)], [])

    def test_read_of_a_robot_of_the_first_joins_no_other_network(self, run: Run, far: ScriptedNetwork) -> None:
        far.open = lambda: pytest.fail("joined")  # type: ignore[method-assign]
        assert run("call", "arm-1", "getStatus").exit_code == 0

    def test_stop_goes_to_every_robot_of_the_id(self, run: Run, near: ScriptedNetwork, far: ScriptedNetwork) -> None:
        assert run("call", "both", "stop", "why=now").exit_code == 0
        assert (near.stopped, far.stopped) == (["both"], ["both"])
        far.stops = error("no brakes", stopped=False)
        result = run("call", "both", "stop")
        assert result.exit_code == Exit.REFUSED
        assert "both on mesh" in result.stderr

    def test_stop_without_an_answer_is_exit_3(self, run: Run) -> None:
        assert run("call", "arm-9", "stop").exit_code == Exit.SILENT

    def test_robot_on_no_network_is_exit_3_with_similar_names_and_the_missing_network(
        self, run: Run, far: ScriptedNetwork, networks: list[str]
    ) -> None:
        far.unreachable = "no route"
        result = run("call", "arm-9", "getStatus")
        assert result.exit_code == Exit.SILENT
        assert "Not reached: mesh, no route." in result.stderr
        networks.append(MESH)
        assert "mesh" not in run("call", "arm-9", "getStatus").stderr


class TestTake:
    def test_robot_is_taken_where_it_is(self, run: Run, far: ScriptedNetwork) -> None:
        far.answers["getControl"] = lambda _: success("free", epoch=3)
        far.answers["takeControl"] = lambda _: success("taken", lease_id="l-1")
        result = run("take", "arm-2")
        assert result.exit_code == 0, result.output
        assert asked(far) == [("arm-2", "getControl"), ("arm-2", "takeControl")]

    def test_one_of_two_robots_of_an_id_is_not_taken(self, run: Run, near: ScriptedNetwork) -> None:
        result = run("take", "both")
        assert (result.exit_code, "device_connect and mesh" in result.stderr) == (1, True)
        assert "takeControl" not in {verb for _, verb in asked(near)}


class TestLockouts:
    def test_robot_that_is_locked_on_one_of_two_is_locked(self, run: Run, far: ScriptedNetwork) -> None:
        far.locked["both"] = EPOCH
        said = json.loads(run("lockout", "--json").stdout)
        assert {name: each["locked"] for name, each in said["live"].items()} == {
            "arm-1": False,
            "arm-2": False,
            "both": True,
        }
        assert "both" in run("lockout").stdout and EPOCH in run("lockout").stdout

    def test_resume_frees_the_robots_of_both(
        self, run: Run, near: ScriptedNetwork, far: ScriptedNetwork, key: tuple[str, ...]
    ) -> None:
        near.locked, far.locked = {"arm-1": EPOCH, "both": EPOCH}, {"arm-2": EPOCH, "both": EPOCH}
        result = run("resume", *key, "--json")
        assert result.exit_code == 0, result.output
        assert sorted(json.loads(result.stdout)["devices"]) == ["arm-1", "arm-2", "both"]
        assert (near.locked, far.locked) == ({}, {})

    def test_resume_of_targets_frees_no_other(
        self, run: Run, near: ScriptedNetwork, far: ScriptedNetwork, key: tuple[str, ...]
    ) -> None:
        near.locked, far.locked = {"arm-1": EPOCH}, {"arm-2": EPOCH}
        assert run("resume", *key, "--targets", "arm-2").exit_code == 0
        assert (near.locked, far.locked) == ({"arm-1": EPOCH}, {})

    @pytest.mark.parametrize("others", [(), ("arm-2",)])
    def test_target_that_is_not_in_reach_is_named_and_frees_no_other(
        self, run: Run, near: ScriptedNetwork, far: ScriptedNetwork, key: tuple[str, ...], others: tuple[str, ...]
    ) -> None:
        near.locked, far.locked = {"arm-1": EPOCH}, {"arm-2": EPOCH}
        result = run("resume", *key, "--targets", ",".join(["arm-9", *others]), "--json")
        said = json.loads(result.stdout)
        assert (result.exit_code, said["devices"]["arm-9"]["free"]) == (1, False)
        assert near.locked == {"arm-1": EPOCH}
        assert sorted(said["devices"]) == sorted(["arm-9", *others])

    def test_robot_that_stays_locked_on_one_network_is_not_free(
        self, run: Run, far: ScriptedNetwork, key: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        far.locked["both"] = EPOCH
        monkeypatch.setattr(far, "resume", lambda reports, *_: {each.name: (False, "no") for each in reports})
        result = run("resume", *key)
        assert result.exit_code == 1
        assert "both" in result.stderr and "arm-1" not in result.stderr


class TestEnroll:
    @pytest.fixture
    def signing(self, near: ScriptedNetwork, far: ScriptedNetwork, tmp_path: Path) -> Callable[..., None]:
        """Give the robot on both networks its key on each."""

        def sign(first: str, second: str) -> None:
            for network, name in ((near, first), (far, second)):
                network.keys["both"] = KeyFile(ROBOTS, name, tmp_path).load_or_make()

        return sign

    def test_robot_of_one_key_is_enrolled_once(self, run: Run, signing: Callable[..., None]) -> None:
        signing("own", "own")
        said = json.loads(run("enroll", "--json").stdout)["devices"]
        assert {name: each["outcome"] for name, each in said.items()} == {
            "arm-1": "no key",
            "arm-2": "no key",
            "both": "enrolled",
        }
        assert json.loads(run("enroll", "both", "--json").stdout)["devices"]["both"]["outcome"] == "known"

    def test_two_robots_of_one_id_are_an_alarm_and_neither_is_enrolled(
        self, run: Run, signing: Callable[..., None]
    ) -> None:
        signing("one", "two")
        result = run("enroll")
        assert result.exit_code == 1
        assert "ALARM: both shows another key on each network" in result.stderr
        assert "No robot is enrolled" in run("enroll", "--list").stdout

    def test_robot_that_is_not_in_reach_is_named(self, run: Run, signing: Callable[..., None]) -> None:
        signing("own", "own")
        said = json.loads(run("enroll", "both", "arm-9", "--json").stdout)["devices"]
        assert {name: each["outcome"] for name, each in said.items()} == {"both": "enrolled", "arm-9": "no key"}


class TestNetworkThatIsGone:
    @pytest.mark.parametrize("line", [("peers",), ("lockout",), ("enroll",)])
    def test_one_that_someone_asked_for_is_named_beside_the_robots_of_the_other(
        self, run: Run, near: ScriptedNetwork, far: ScriptedNetwork, line: tuple[str, ...], tmp_path: Path
    ) -> None:
        far.keys["both"] = KeyFile(ROBOTS, "both", tmp_path).load_or_make()
        near.unreachable = "no broker answers"
        result = run(*line)
        assert result.exit_code == 0, result.output
        assert "Not reached: device_connect, no broker answers" in result.stdout
        assert json.loads(run(*line, "--json").stdout)["absent"] == {DEVICE_CONNECT: "no broker answers"}

    @pytest.mark.parametrize("line", [("peers",), ("lockout",), ("call", "arm-1", "moveTo", "x=1")])
    def test_one_that_is_merely_not_there_is_not_mentioned(
        self, run: Run, far: ScriptedNetwork, networks: list[str], line: tuple[str, ...]
    ) -> None:
        networks.append(MESH)
        far.unreachable = "no hub"
        result = run(*line)
        assert result.exit_code == 0
        assert "mesh" not in result.output and "no hub" not in result.output

    @pytest.mark.parametrize("line", [("peers",), ("call", "arm-1", "getStatus"), ("enroll",), ("watch", "arm-1")])
    def test_none_in_reach_is_exit_3_with_the_reason_of_the_one_that_was_asked_for(
        self, run: Run, near: ScriptedNetwork, far: ScriptedNetwork, networks: list[str], line: tuple[str, ...]
    ) -> None:
        networks.append(MESH)
        near.unreachable, far.unreachable = "no broker answers", "no hub"
        result = run(*line)
        assert result.exit_code == Exit.SILENT
        assert result.stderr == "The network does not carry this: no broker answers\n"


def test_watched_robot_of_the_second_network_is_read_there(
    run: Run, near: ScriptedNetwork, far: ScriptedNetwork
) -> None:
    far.answers["getStatus"] = lambda _: success("", task_status="running", instruction="wave")
    result = run("watch", "arm-2", "--for", "0.01")
    assert result.stdout.startswith("arm-2: running: 'wave'")
    assert asked(near) == []


@pytest.mark.parametrize("line", [("peers",), ("call", "arm-1", "getStatus"), ("call", "arm-1", "moveTo")])
def test_command_loads_no_code_of_a_mesh_that_is_not_there(
    line: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_DC_PORT", str(free_port()))
    code = (
        "import sys; from strands_robots.cli.app import build\n"
        f"try: build({line[0]!r})()\nexcept SystemExit: "
        "print([name for name in sys.modules if name.startswith('strands_robots.mesh')])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, *line], capture_output=True, text=True, timeout=100, check=True
    )
    assert result.stdout.splitlines()[-1] == "[]", result
