from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest
from tests.cli.conftest import Run, connect

from strands_robots.audit import flush_audit, read_audit_log
from strands_robots.cli import resume
from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Exit
from strands_robots.device_connect.backends import loopback_config
from strands_robots.device_connect.backends.config import network_of
from strands_robots.device_connect.client import DeviceTimeoutError
from strands_robots.device_connect.discovery import Peer
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.authorization import Grants
from strands_robots.safety.ed25519 import keygen
from strands_robots.safety.lockout import OVERFLOW, Lockout, LockoutState
from strands_robots.safety.persistence import LockoutStore, StoredLockout
from strands_robots.safety.sightings import sightings

STRONG = "Plenty of 4 different words"
A, B = "a" * 32, "b" * 32


class FakeFleet:
    """Robots with the lockouts that the test sets; a signed resume clears the one it names."""

    def __init__(self) -> None:
        self.link, self.source = loopback_config(), "cli"
        self.stale = ""
        self.lockouts: dict[str, list[str]] = {}
        self.silent: set[str] = set()
        self.refuses: set[str] = set()
        self.presented: list[tuple[str, str, tuple[str, ...]]] = []

    def peers(self, timeout: float = 2.0) -> list[Peer]:
        return [Peer(name, functions=({"name": "resume"},)) for name in self.lockouts] + [Peer("camera")]

    def announces(self, device: str, function: str, argument: str) -> bool:
        return False

    def call(self, device: str, function: str, params: dict[str, Any], timeout: float) -> Envelope:
        if device in self.silent:
            raise DeviceTimeoutError(f"{device} is announced and did not answer.")
        epochs = self.lockouts[device]
        if function == "getStatus":
            rows = [{"epoch": each, "source": "desk", "reason": "a hand", "since": 0.0} for each in epochs]
            return success("", locked=bool(epochs), lockout=rows)
        assertion = params["assertion"]
        self.presented.append((device, assertion["epoch"], tuple(assertion["targets"])))
        if device in self.refuses:
            return error("resume rejected")
        epochs.remove(assertion["epoch"])
        return success("free of it", locked=bool(epochs))

    def call_each(
        self, calls: dict[str, dict[str, Any]], function: str, timeout: float
    ) -> dict[str, tuple[Envelope | Exception, float]]:
        answers: dict[str, tuple[Envelope | Exception, float]] = {}
        for device, params in calls.items():
            try:
                answers[device] = self.call(device, function, params, timeout), 0.001
            except DeviceTimeoutError as exc:
                answers[device] = exc, timeout
        return answers


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> FakeFleet:
    fake = FakeFleet()

    connect(monkeypatch, fake)
    return fake


@pytest.fixture
def signed(tmp_path: Path) -> tuple[str, ...]:
    passphrase = tmp_path / "passphrase"
    passphrase.write_text(STRONG, encoding="utf-8")
    keygen(tmp_path / "key.pem", STRONG)
    return "resume", "--key", str(tmp_path / "key.pem"), "--passphrase-file", str(passphrase)


def test_every_lockout_of_every_robot_is_signed_for(run: Run, fleet: FakeFleet, signed: tuple[str, ...]) -> None:
    fleet.lockouts = {"arm-1": [A, B], "arm-2": [B], "arm-3": []}
    result = run(*signed, "--json")
    assert result.exit_code == 0, result.output
    assert sorted(fleet.presented) == [
        ("arm-1", A, ("arm-1",)),
        ("arm-1", B, ("arm-1", "arm-2")),
        ("arm-2", B, ("arm-1", "arm-2")),
    ]
    assert json.loads(result.stdout)["devices"]["arm-3"] == {"free": True, "said": "was not locked"}


def test_only_the_targets_are_freed(run: Run, fleet: FakeFleet, signed: tuple[str, ...]) -> None:
    fleet.lockouts = {"arm-1": [A], "arm-2": [A], "arm-3": [A]}
    assert run(*signed, "--targets", "arm-1,arm-3").exit_code == 0
    assert fleet.lockouts == {"arm-1": [], "arm-2": [A], "arm-3": []}


def test_silent_robot_is_named_before_the_targets_are_freed(
    run: Run, fleet: FakeFleet, signed: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    network = network_of(fleet.link)
    for name in ("arm-1", "arm-2", "arm-3"):
        sightings().note(network, name, stoppable=True)
    assert sightings().flush(20.0)
    fleet.lockouts, fleet.silent = {"arm-1": [A], "arm-2": [A], "arm-3": [A]}, {"arm-3"}
    result = run(*signed, "--targets", "arm-1")
    assert result.stdout.index("NOT HEARD: arm-3.") < result.stdout.index("free")
    assert fleet.lockouts == {"arm-1": [], "arm-2": [A], "arm-3": [A]}
    assert json.loads(run(*signed, "--json").stdout)["unheard"] == ["arm-3"]


def test_local_resume_names_who_was_not_heard_since_the_stop(run: Run, fleet: FakeFleet) -> None:
    sightings().note(network_of(fleet.link), "arm-1", stoppable=True)
    sightings().note(network_of(fleet.link), "arm-2", stoppable=True)
    assert sightings().flush(20.0)
    hold = Lockout(A, "desk", "a hand", time.time() + 1.0)
    LockoutStore().save({"k": StoredLockout(LockoutState((hold,)), name="arm-1")})
    result = run("resume", "--local")
    assert result.exit_code == 0
    assert result.stdout.index("NOT HEARD: arm-2.") < result.stdout.index("cleared")


def test_unreadable_lockout_file_hinders_no_running_robots_clearing(
    run: Run, fleet: FakeFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    hold = Lockout(A, "desk", "a hand", time.time())
    LockoutStore().save({"k": StoredLockout(LockoutState((hold,)), name="arm-1")})
    (LockoutStore().directory / "other.json").write_text("no json", encoding="utf-8")
    (LockoutStore().directory / "other.json").chmod(0o600)
    monkeypatch.setattr(resume, "clear_here", lambda who, names: dict.fromkeys(names, "cleared"))
    result = run("resume", "--local", "arm-1")
    assert result.exit_code == 0, result.output
    assert "NOT KNOWN who was not heard: The lockout file of this machine cannot be read" in result.stdout


def test_robots_still_locked_are_named_with_exit_1(run: Run, fleet: FakeFleet, signed: tuple[str, ...]) -> None:
    fleet.lockouts = {"stubborn": [A], "mute": [A], "full": [OVERFLOW], "good": [A]}
    fleet.silent, fleet.refuses = {"mute"}, {"stubborn"}
    result = run(*signed, "--json")
    assert result.exit_code == 1
    devices = json.loads(result.stdout)["devices"]
    assert {name: each["free"] for name, each in devices.items()} == {
        "stubborn": False,
        "mute": False,
        "full": False,
        "good": True,
    }
    assert "its own audit says why" in devices["stubborn"]["said"]
    assert "resume --local" in devices["full"]["said"]


@pytest.mark.parametrize("arguments", [(), ("--local", "--key", "x"), ("--key", "nowhere"), ("--local", "a b")])
def test_resume_with_wrong_arguments_is_exit_2(run: Run, fleet: FakeFleet, arguments: tuple[str, ...]) -> None:
    assert run("resume", *arguments).exit_code == 2


def test_wrong_passphrase_frees_no_robot(run: Run, fleet: FakeFleet, signed: tuple[str, ...], tmp_path: Path) -> None:
    fleet.lockouts = {"arm-1": [A]}
    (tmp_path / "passphrase").write_text("another", encoding="utf-8")
    assert run(*signed).exit_code == 1
    assert fleet.presented == []


def test_local_resume_says_that_the_state_directory_cannot_be_written(
    run: Run, fleet: FakeFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resume, "state_problem", lambda: "The state directory /x cannot be written.")
    output = run("resume", "--local")
    assert (output.exit_code, "/x cannot be written" in output.output) == (1, True)


def test_robot_that_is_off_is_cleared_locally_and_audited(run: Run, fleet: FakeFleet) -> None:
    hold = Lockout(A, "desk", "a hand", 0.0)
    LockoutStore().save({"hardware:so101:left": StoredLockout(LockoutState((hold,)), name="arm-1")})
    output = run("lockout", "--local")
    assert (
        "arm-1 (in this machine's file)" in output.stdout and "by desk: a hand" in output.stdout and A in output.stdout
    )
    assert run("resume", "--local").exit_code == 0
    assert flush_audit(20)
    (record,) = [each for each in read_audit_log() if each["event"] == "resume_local"]
    assert (record["peer_id"], record["payload"]["who"]) == ("arm-1", resume.operator())
    assert "No lockout is known" in run("lockout", "--local").stdout
    assert run("resume", "--local").exit_code == 1


def test_live_robot_outranks_the_lockout_file(run: Run, fleet: FakeFleet) -> None:
    LockoutStore().save({"k": StoredLockout(LockoutState((Lockout(A, "desk", "", 0.0),)), name="arm-1")})
    fleet.lockouts = {"arm-1": [], "arm-2": [B]}
    answer = json.loads(run("lockout", "--json").stdout)
    assert {name: each["locked"] for name, each in answer["live"].items()} == {"arm-1": False, "arm-2": True}
    output = run("lockout").stdout
    assert "this machine's file" not in output and "Free: arm-1." in output and B in output
    fleet.silent = {"arm-1"}
    assert "arm-1 (in this machine's file)" in run("lockout").stdout


def test_lockout_file_is_printed_without_a_network(
    run: Run, monkeypatch: pytest.MonkeyPatch, state_directory: Path
) -> None:
    def unreachable(network: Network, **_: object) -> Any:
        raise CliError("The network is not there.", Exit.SILENT)

    monkeypatch.setattr(Network, "networks", unreachable)
    LockoutStore().save({"k": StoredLockout(LockoutState((Lockout(A, "desk", "", 0.0),)), name="arm-1")})
    result = run("lockout")
    assert result.exit_code == 0
    assert "The network is not there." in result.stdout and "arm-1" in result.stdout
    (state_directory / "lockouts.json").write_text("{", encoding="utf-8")
    assert run("lockout").exit_code == 1


def test_grant_can_be_claimed_once(run: Run, state_directory: Path) -> None:
    result = run("grant", "execute@arm-1", "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["peer"] == "arm-1"
    grants = Grants(state_directory / "grants")
    assert grants.claim("execute", "arm-1") is not None
    assert grants.claim("execute", "arm-1") is None


def test_grant_for_a_caller_is_for_no_other(run: Run, state_directory: Path) -> None:
    assert "by desk" in run("grant", "execute@arm-1", "--caller", "desk").stdout
    grants = Grants(state_directory / "grants")
    assert grants.claim("execute", "arm-1", ("second",)) is None
    assert grants.claim("execute", "arm-1", ("desk",)) is not None
    assert run("grant", "execute@arm-1", "--caller", "de\nsk").exit_code == 2


@pytest.mark.parametrize("what", ["execute", "@arm-1", "execute@", "exe cute@arm-1", "execute@arm/1"])
def test_grant_of_anything_but_verb_at_peer_is_wrong_usage(run: Run, what: str) -> None:
    result = run("grant", what)
    assert result.exit_code == 2
    assert "Traceback" not in result.output


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "1e9"])
def test_grant_outside_the_time_limits_is_refused(run: Run, seconds: str) -> None:
    assert run("grant", "execute@arm-1", "--for", seconds).exit_code == 2
