"""A stop, its lockout and its resume as an operator does them: real processes on one free loopback port."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from fixtures.nats_server import NatsServer
from fixtures.terminal import on_a_terminal
from fixtures.waiting import eventually, free_port

from strands_robots import settings
from strands_robots.safety.ed25519 import keygen

WITHIN_S = 100.0
pytestmark = pytest.mark.timeout(600)
PASSPHRASE = "Plenty of 4 different words"
WAVE = ("instruction=wave", "duration=600")
PATIENT = ("--deadline", "30")


class Site:
    """One machine with a state folder of its own, and an operator's key whose public half its robots know."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.key, self.passphrase = folder, folder / "operator.pem", folder / "passphrase"
        self.passphrase.write_text(PASSPHRASE + "\n", encoding="utf-8")
        ours = {setting.name for setting in settings.declared()}
        self.environment = {name: value for name, value in os.environ.items() if name not in ours}
        self.environment |= {
            "STRANDS_DC_PORT": str(free_port()),
            "STRANDS_STATE_DIR": str(folder / "state"),
            "STRANDS_HALT_DEADLINE_S": "20",
            "STRANDS_MESH_RESUME_PUBLIC_KEY": keygen(self.key, PASSPHRASE),
        }

    def words(self, *words: str) -> list[str]:
        return [sys.executable, "-m", "strands_robots.cli", *words]

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            self.words(*words), env=self.environment, capture_output=True, text=True, timeout=WITHIN_S, check=False
        )

    def json(self, *words: str) -> tuple[int, dict[str, Any]]:
        result = self.run(*words, "--json")
        assert result.stdout, result.stderr
        return result.returncode, json.loads(result.stdout)

    @contextmanager
    def serving(self, peer_id: str, *words: str, **settings: str) -> Iterator[subprocess.Popen[str]]:
        served = subprocess.Popen(
            self.words("serve", "so100", "--peer-id", peer_id, "--json", *words),
            env=self.environment | settings,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        try:
            assert served.stdout is not None
            assert json.loads(served.stdout.readline())["event"] == "serving"
            yield served
        finally:
            served.terminate()
            served.communicate(timeout=WITHIN_S)

    def wave(self, peer_id: str) -> tuple[int, dict[str, Any]]:
        return self.json("call", peer_id, "execute", *WAVE)

    def moving(self, peer_id: str) -> bool:
        return bool(self.json("call", peer_id, "getStatus")[1]["running_policies"])

    def signed(self, *words: str) -> tuple[int, dict[str, Any]]:
        return self.json("resume", "--key", str(self.key), "--passphrase-file", str(self.passphrase), *words)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return Site(tmp_path_factory.mktemp("site"))


@pytest.fixture(scope="module")
def arms(site: Site) -> Iterator[tuple[str, str]]:
    with site.serving("arm-1"), site.serving("arm-2"):
        yield "arm-1", "arm-2"


def test_an_emergency_stop_latches_until_the_operators_key_frees_it(site: Site, arms: tuple[str, str]) -> None:
    for arm in arms:
        assert site.wave(arm)[0] == 0
        eventually(partial(site.moving, arm))
    code, told = site.json("estop", "--reason", "a hand in the cell", "--as", "desk-1", *PATIENT)
    assert (code, set(told["stopped"]), told["silent"]) == (0, set(arms), [])
    assert not any(site.moving(arm) for arm in arms)
    code, said = site.wave("arm-1")
    assert code == 1
    assert told["estop_id"] in said["reason"] and "resume" in said["reason"]
    code, known = site.json("lockout")
    hold = known["live"]["arm-1"]["holds"][0]
    assert (hold["epoch"], hold["source"], hold["reason"]) == (told["estop_id"], "desk-1", "a hand in the cell")
    assert set(known["kept"]) == set(arms)
    code, freed = site.signed("--targets", "arm-1")
    assert (code, freed["devices"]["arm-1"]["free"]) == (0, True)
    assert not site.moving("arm-1"), "a resume starts nothing"
    assert site.wave("arm-1")[0] == 0
    assert site.wave("arm-2")[0] == 1
    assert site.signed()[0] == 0
    assert site.json("stop", "--all")[0] == 0
    assert not any(robot["locked"] for robot in site.json("lockout")[1]["live"].values())


def test_a_key_that_the_robots_do_not_know_frees_nothing(site: Site, arms: tuple[str, str]) -> None:
    assert site.json("estop", *arms, *PATIENT)[0] == 0
    stranger = site.folder / "stranger.pem"
    keygen(stranger, PASSPHRASE)
    code, said = site.json(
        "resume", "--key", str(stranger), "--passphrase-file", str(site.passphrase), "--targets", "arm-1"
    )
    assert (code, said["devices"]["arm-1"]["free"]) == (1, False)
    assert site.signed()[0] == 0


def test_a_stop_on_a_terminal_is_a_table_that_ends_with_counts(site: Site, arms: tuple[str, str]) -> None:
    with on_a_terminal(site.words("estop", *arms, "arm-9", "--deadline", "5"), site.environment) as terminal:
        assert terminal.process.wait(WITHIN_S) == 3
        eventually(lambda: "2 stopped, 1 silent, in" in terminal.drawn)
        assert "unconfirmed" in terminal.drawn and "NO ANSWER" in terminal.drawn
        assert "CRITICAL" not in terminal.drawn, "the log does not tear the table"
    assert site.signed()[0] == 0


def test_over_a_broker_a_robot_that_asks_for_signed_stops_heeds_no_others(site: Site) -> None:
    public = keygen(site.folder / "stop.pem", PASSPHRASE)
    signed = ("--key", str(site.folder / "stop.pem"), "--passphrase-file", str(site.passphrase))
    with NatsServer() as server:
        there = ("--nats", server.url)
        with site.serving("arm-5", *there, DEVICE_CONNECT_ESTOP_PUBLIC_KEYS=public):
            stop = ("estop", "arm-5", "--deadline", "1.5", *there)
            code, said = site.json(*stop)
            assert (code, said["silent"]) == (3, ["arm-5"])
            assert site.json("lockout", *there)[1]["live"]["arm-5"]["locked"] is False
            assert site.json("estop", "arm-5", *PATIENT, *there, *signed)[0] == 0
            assert site.json("lockout", *there)[1]["live"]["arm-5"]["locked"] is True
            assert site.signed(*there)[0] == 0


def test_a_robot_that_is_expected_and_silent_is_exit_3_by_name(site: Site, arms: tuple[str, str]) -> None:
    result = site.run("estop", "arm-1", "arm-9", "--deadline", "0.6")
    assert result.returncode == 3
    assert "arm-9" in result.stdout and "NO ANSWER" in result.stdout
    assert "arm-9 gave no answer" in result.stderr
    assert site.signed()[0] == 0


def test_an_operator_at_the_machine_clears_robots_that_run_and_those_that_do_not(
    site: Site, arms: tuple[str, str]
) -> None:
    with site.serving("arm-3") as served:
        assert site.json("estop", *arms, "arm-3", *PATIENT)[0] == 0
        served.kill()
        served.wait()
    code, said = site.json("resume", "--local")
    assert code == 0, said
    assert said["devices"]["arm-3"]["said"] == "cleared on disk"
    assert said["devices"]["arm-1"]["said"] == "cleared"
    assert site.json("lockout", "--local")[1]["kept"] == {}
    assert site.json("resume", "--local", "arm-1")[0] == 1


def test_nobody_there_is_exit_3(site: Site) -> None:
    code, said = site.json("estop", "--deadline", "0.3", "--tenant", "elsewhere", "--port", str(free_port()))
    assert code == 3
    assert said["stopped"] == {}


def test_the_space_bar_stops_every_robot(site: Site, arms: tuple[str, str]) -> None:
    for arm in arms:
        assert site.wave(arm)[0] == 0
    words = site.words("safety-controller", "--id", "desk-2", "--check-in", "0.5")
    with on_a_terminal(words, site.environment) as terminal:
        before = terminal.modes()
        eventually(lambda: all(arm in terminal.drawn for arm in arms), within=WITHIN_S)
        eventually(lambda: "the stop link is up; checks in every 0.5 s" in terminal.drawn)
        assert "LOCKED" not in terminal.drawn
        terminal.press(" ")
        eventually(lambda: "2 stopped, in" in terminal.drawn and "LOCKED" in terminal.drawn)
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


def test_a_controller_without_a_terminal_is_refused(site: Site) -> None:
    result = site.run("safety-controller")
    assert result.returncode == 2
    assert "needs a terminal" in result.stderr


def test_a_robot_that_needs_a_controller_locks_when_the_last_one_leaves(site: Site) -> None:
    def held() -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = site.json("lockout")[1]["live"]["arm-6"]["holds"]
        return found

    with on_a_terminal(
        site.words("safety-controller", "--id", "desk-3", "--check-in", "0.2"), site.environment
    ) as terminal:
        eventually(lambda: "checks in every 0.2 s" in terminal.drawn, within=WITHIN_S)
        with site.serving("arm-6", STRANDS_CHECKIN_TIMEOUT_S="8"):
            eventually(lambda: "s left" in terminal.drawn, within=WITHIN_S)
            assert held() == []
            terminal.press("q")
            assert terminal.process.wait(WITHIN_S) == 0
            eventually(held, within=60)
            assert "desk-3" in str(held())
            assert site.wave("arm-6")[0] == 1
    assert site.json("resume", "--local", "arm-6")[0] == 0
