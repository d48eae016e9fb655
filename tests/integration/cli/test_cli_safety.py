"""Emergency stop, lockout and resume as an operator does them: real processes on one free loopback port."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import COMMAND, WITHIN_S, Machine, on_a_terminal
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually, free_port

from strands_robots.safety.ed25519 import keygen

pytestmark = pytest.mark.timeout(600)
PASSPHRASE = "Plenty of 4 different words"
WAVE = ("instruction=wave", "duration=600")
PATIENT = ("--deadline", "30")


class Site(Machine):
    """A machine with an operator's key; its robots have the public half."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.key, self.passphrase = folder, folder / "operator.pem", folder / "passphrase"
        self.passphrase.write_text(PASSPHRASE + "\n", encoding="utf-8")
        super().__init__(folder / "state", STRANDS_MESH_RESUME_PUBLIC_KEY=keygen(self.key, PASSPHRASE))

    def wave(self, peer_id: str) -> tuple[int, dict[str, Any]]:
        return self.json("call", peer_id, "execute", *WAVE)

    def moving(self, peer_id: str) -> bool:
        return bool(self.json("call", peer_id, "getStatus")[1]["running_policies"])

    def signed(self, *arguments: str) -> tuple[int, dict[str, Any]]:
        return self.json("resume", "--key", str(self.key), "--passphrase-file", str(self.passphrase), *arguments)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return Site(tmp_path_factory.mktemp("site"))


@pytest.fixture(scope="module")
def arms(site: Site) -> Iterator[tuple[str, str]]:
    with site.serving("arm-1"), site.serving("arm-2"):
        yield "arm-1", "arm-2"


def test_emergency_stop_locks_until_the_operators_key_resumes(site: Site, arms: tuple[str, str]) -> None:
    for arm in arms:
        assert site.wave(arm)[0] == 0
        eventually(partial(site.moving, arm))
    code, result = site.json("estop", "--reason", "a hand in the cell", "--as", "desk-1", *PATIENT)
    assert (code, set(result["stopped"]), result["silent"]) == (0, set(arms), [])
    assert not any(site.moving(arm) for arm in arms)
    code, said = site.wave("arm-1")
    assert code == 1
    assert result["estop_id"] in said["reason"] and "resume" in said["reason"]
    code, known = site.json("lockout")
    hold = known["live"]["arm-1"]["holds"][0]
    assert (hold["epoch"], hold["source"], hold["reason"]) == (result["estop_id"], "desk-1", "a hand in the cell")
    assert set(known["kept"]) == set(arms)
    code, freed = site.signed("--targets", "arm-1")
    assert (code, freed["devices"]["arm-1"]["free"]) == (0, True)
    assert not site.moving("arm-1"), "a resume starts nothing"
    assert site.wave("arm-1")[0] == 0
    assert site.wave("arm-2")[0] == 1
    assert site.signed()[0] == 0
    assert site.json("stop", "--all")[0] == 0
    assert not any(robot["locked"] for robot in site.json("lockout")[1]["live"].values())


def test_unknown_key_frees_no_robot(site: Site, arms: tuple[str, str]) -> None:
    assert site.json("estop", *arms, *PATIENT)[0] == 0
    stranger = site.folder / "stranger.pem"
    keygen(stranger, PASSPHRASE)
    code, said = site.json(
        "resume", "--key", str(stranger), "--passphrase-file", str(site.passphrase), "--targets", "arm-1"
    )
    assert (code, said["devices"]["arm-1"]["free"]) == (1, False)
    assert site.signed()[0] == 0


def test_command_that_estop_prints_frees_the_robots_as_printed(site: Site, arms: tuple[str, str]) -> None:
    said = site.run("estop", *arms, *PATIENT)
    printed = said.stdout.strip().splitlines()[-1].split()
    assert printed == ["strands-robots", "resume", "--local"]
    freed = site.run(*printed[1:])
    assert (freed.returncode, "arm-1" in freed.stdout) == (0, True)
    assert site.wave("arm-1")[0] == 0
    assert site.json("stop", "arm-1")[0] == 0


def test_estop_on_a_terminal_is_a_table_that_ends_with_counts(site: Site, arms: tuple[str, str]) -> None:
    with on_a_terminal([*COMMAND, "estop", *arms, "arm-9", "--deadline", "5"], site.environment) as terminal:
        assert terminal.process.wait(WITHIN_S) == 3
        eventually(lambda: "2 stopped, 1 silent, in" in terminal.drawn)
        assert "unconfirmed" in terminal.drawn and "NO ANSWER" in terminal.drawn
        assert "CRITICAL" not in terminal.drawn, "the log does not tear the table"
    assert site.signed()[0] == 0


def test_robot_that_requires_signed_stops_ignores_others_over_a_broker(site: Site) -> None:
    public = keygen(site.folder / "stop.pem", PASSPHRASE)
    signed = ("--key", str(site.folder / "stop.pem"), "--passphrase-file", str(site.passphrase))
    with NatsServer() as server:
        network = ("--nats", server.url)
        with site.serving("arm-5", *network, DEVICE_CONNECT_ESTOP_PUBLIC_KEYS=public):
            stop = ("estop", "arm-5", "--deadline", "1.5", *network)
            code, said = site.json(*stop)
            assert (code, said["silent"]) == (3, ["arm-5"])
            assert site.json("lockout", *network)[1]["live"]["arm-5"]["locked"] is False
            code, said = site.json(*stop, *signed)
            assert (code, said["claimed"]) == (3, ["arm-5"])
            code, said = site.json("enroll", "arm-5", *network)
            assert (code, said["devices"]["arm-5"]["outcome"]) == (0, "enrolled")
            assert said["devices"]["arm-5"]["fingerprint"] in site.run("doctor").stdout
            assert site.json("estop", "arm-5", *PATIENT, *network, *signed)[0] == 0
            assert site.json("lockout", *network)[1]["live"]["arm-5"]["locked"] is True
            assert site.signed(*network)[0] == 0


def test_expected_but_silent_robot_is_named_with_exit_3(site: Site, arms: tuple[str, str]) -> None:
    result = site.run("estop", "arm-1", "arm-9", "--deadline", "0.6")
    assert result.returncode == 3
    assert "arm-9" in result.stdout and "NO ANSWER" in result.stdout
    assert "NO ANSWER: arm-9." in result.stderr
    assert site.signed()[0] == 0


def test_robot_that_a_command_listed_is_missed_at_the_next_stop(
    site: Site, arms: tuple[str, str], tmp_path: Path
) -> None:
    console = Machine(tmp_path / "console", STRANDS_DC_PORT=site.environment["STRANDS_DC_PORT"])
    with site.serving("arm-8") as (served, _):
        assert {each["id"] for each in console.json("peers")[1]["peers"]} >= {*arms, "arm-8"}
        served.kill()
        served.wait()
        code, said = console.json("estop", "--deadline", "2")
        assert (code, said["silent"]) == (3, ["arm-8"])
        assert site.json("resume", "--local")[0] == 0


def test_local_resume_clears_running_and_stopped_processes(site: Site, arms: tuple[str, str]) -> None:
    with site.serving("arm-3") as (served, _):
        # A robot that another test killed in the last ten minutes is in the roster as well.
        stopped = site.json("estop", *arms, "arm-3", "--deadline", "10")[1]["stopped"]
        assert {*stopped} == {*arms, "arm-3"}
        served.kill()
        served.wait()
    code, said = site.json("resume", "--local")
    assert code == 0, said
    assert said["devices"]["arm-3"]["said"] == "cleared on disk"
    assert said["devices"]["arm-1"]["said"] == "cleared"
    assert site.json("lockout", "--local")[1]["kept"] == {}
    assert site.json("resume", "--local", "arm-1")[0] == 1


def test_estop_without_any_robot_is_exit_3(site: Site) -> None:
    code, said = site.json("estop", "--deadline", "0.3", "--tenant", "elsewhere", "--port", str(free_port()))
    assert code == 3
    assert said["stopped"] == {}


def test_space_bar_stops_every_robot(site: Site, arms: tuple[str, str]) -> None:
    for arm in arms:
        assert site.wave(arm)[0] == 0
    line = [*COMMAND, "safety-controller", "--id", "desk-2", "--check-in", "0.5"]
    with on_a_terminal(line, site.environment) as terminal:
        before = terminal.modes()
        eventually(lambda: all(arm in terminal.drawn for arm in arms), within=WITHIN_S)
        eventually(lambda: "the stop link is up; checks in every 0.5 s" in terminal.drawn)
        assert "LOCKED" not in terminal.drawn
        terminal.press(" ")
        eventually(lambda: "2 stopped, " in terminal.drawn and "LOCKED" in terminal.drawn)
        known = site.json("lockout")[1]["live"]
        assert {name: [hold["source"] for hold in each["holds"]] for name, each in known.items()} == {
            "arm-1": ["desk-2"],
            "arm-2": ["desk-2"],
        }
        assert not any(site.moving(arm) for arm in arms)
        terminal.press("   ")
        eventually(lambda: terminal.drawn.count("stopped in") > 4)
        terminal.press("q")
        assert terminal.process.wait(WITHIN_S) == 0
        assert terminal.modes() == before
    assert "Traceback" not in terminal.drawn
    assert site.signed()[0] == 0


def test_safety_controller_without_a_terminal_is_refused(site: Site) -> None:
    result = site.run("safety-controller")
    assert result.returncode == 2
    assert "needs a terminal" in result.stderr


def test_robot_that_requires_check_ins_locks_when_the_controller_leaves(site: Site) -> None:
    def lockouts() -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = site.json("lockout")[1]["live"]["arm-6"]["holds"]
        return found

    line = [*COMMAND, "safety-controller", "--id", "desk-3", "--check-in", "0.2"]
    with on_a_terminal(line, site.environment) as terminal:
        eventually(lambda: "checks in every 0.2 s" in terminal.drawn, within=WITHIN_S)
        with site.serving("arm-6", STRANDS_CHECKIN_TIMEOUT_S="8"):
            eventually(lambda: "s left" in terminal.drawn, within=WITHIN_S)
            assert lockouts() == []
            terminal.press("q")
            assert terminal.process.wait(WITHIN_S) == 0
            eventually(lockouts, within=60, every=0.5)
            assert "desk-3" in str(lockouts())
            assert site.wave("arm-6")[0] == 1
    assert site.json("resume", "--local", "arm-6")[0] == 0
