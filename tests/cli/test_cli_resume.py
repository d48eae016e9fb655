from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from strands_robots.audit import flush_audit, read_audit_log
from strands_robots.cli import resume
from strands_robots.cli.output import Exit, Failure
from strands_robots.device_connect.backends import loopback_config
from strands_robots.device_connect.client import DeviceTimeoutError, Peer
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.ed25519 import keygen
from strands_robots.safety.lockout import OVERFLOW, Hold, LockoutState
from strands_robots.safety.persistence import Kept, LockoutStore

Run = Callable[..., Result]
STRONG = "Plenty of 4 different words"
A, B = "a" * 32, "b" * 32


class FakeFleet:
    """Robots that hold what the test says and let go of what is signed for."""

    def __init__(self) -> None:
        self.link = loopback_config()
        self.held: dict[str, list[str]] = {}
        self.mute: set[str] = set()
        self.refuses: set[str] = set()
        self.presented: list[tuple[str, str, tuple[str, ...]]] = []

    def peers(self, timeout: float = 2.0) -> list[Peer]:
        return [Peer(name, functions=({"name": "resume"},)) for name in self.held] + [Peer("camera")]

    def call(self, device: str, function: str, params: dict[str, Any], timeout: float) -> Envelope:
        if device in self.mute:
            raise DeviceTimeoutError(f"{device} is announced and did not answer.")
        held = self.held[device]
        if function == "getStatus":
            holds = [{"epoch": each, "source": "desk", "reason": "a hand", "since": 0.0} for each in held]
            return success("", locked=bool(held), lockout=holds)
        slip = params["assertion"]
        self.presented.append((device, slip["epoch"], tuple(slip["targets"])))
        if device in self.refuses:
            return error("resume rejected")
        held.remove(slip["epoch"])
        return success("free of it", locked=bool(held))


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> FakeFleet:
    there = FakeFleet()

    @contextmanager
    def reached(network: object, source: str = "") -> Iterator[FakeFleet]:
        yield there

    monkeypatch.setattr(resume, "reached", reached)
    return there


@pytest.fixture
def signed(tmp_path: Path) -> tuple[str, ...]:
    words = tmp_path / "words"
    words.write_text(STRONG, encoding="utf-8")
    keygen(tmp_path / "key.pem", STRONG)
    return "resume", "--key", str(tmp_path / "key.pem"), "--passphrase-file", str(words)


def test_every_epoch_of_every_robot_is_signed_for(run: Run, fleet: FakeFleet, signed: tuple[str, ...]) -> None:
    fleet.held = {"arm-1": [A, B], "arm-2": [B], "arm-3": []}
    result = run(*signed, "--json")
    assert result.exit_code == 0, result.output
    assert sorted(fleet.presented) == [
        ("arm-1", A, ("arm-1",)),
        ("arm-1", B, ("arm-1", "arm-2")),
        ("arm-2", B, ("arm-1", "arm-2")),
    ]
    assert json.loads(result.stdout)["devices"]["arm-3"] == {"free": True, "said": "was not locked"}


def test_targets_are_freed_and_nobody_else(run: Run, fleet: FakeFleet, signed: tuple[str, ...]) -> None:
    fleet.held = {"arm-1": [A], "arm-2": [A], "arm-3": [A]}
    assert run(*signed, "--targets", "arm-1,arm-3").exit_code == 0
    assert fleet.held == {"arm-1": [], "arm-2": [A], "arm-3": []}


def test_who_is_still_locked_is_named_with_exit_1(run: Run, fleet: FakeFleet, signed: tuple[str, ...]) -> None:
    fleet.held = {"stubborn": [A], "mute": [A], "full": [OVERFLOW], "good": [A]}
    fleet.mute, fleet.refuses = {"mute"}, {"stubborn"}
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


@pytest.mark.parametrize("words", [(), ("--local", "--key", "x"), ("--key", "nowhere"), ("--local", "a.b")])
def test_wrong_words_are_exit_2(run: Run, fleet: FakeFleet, words: tuple[str, ...]) -> None:
    assert run("resume", *words).exit_code == 2


def test_a_wrong_passphrase_frees_nobody(run: Run, fleet: FakeFleet, signed: tuple[str, ...], tmp_path: Path) -> None:
    fleet.held = {"arm-1": [A]}
    (tmp_path / "words").write_text("another", encoding="utf-8")
    assert run(*signed).exit_code == 1
    assert fleet.presented == []


def test_a_robot_that_does_not_run_is_cleared_here_and_recorded(run: Run, fleet: FakeFleet) -> None:
    hold = Hold(A, "desk", "a hand", 0.0)
    LockoutStore().save({"hardware:so101:left": Kept(LockoutState((hold,)), name="arm-1")})
    shown = run("lockout", "--local")
    assert "arm-1 (kept here)" in shown.stdout and "by desk: a hand" in shown.stdout and A in shown.stdout
    assert run("resume", "--local").exit_code == 0
    assert flush_audit(20)
    (record,) = [each for each in read_audit_log() if each["event"] == "resume_local"]
    assert (record["peer_id"], record["payload"]["who"]) == ("arm-1", resume.operator())
    assert "No lockout is known" in run("lockout", "--local").stdout
    assert run("resume", "--local").exit_code == 1


def test_a_live_robot_answers_for_itself(run: Run, fleet: FakeFleet) -> None:
    LockoutStore().save({"k": Kept(LockoutState((Hold(A, "desk", "", 0.0),)), name="arm-1")})
    fleet.held = {"arm-1": [], "arm-2": [B]}
    told = json.loads(run("lockout", "--json").stdout)
    assert {name: each["locked"] for name, each in told["live"].items()} == {"arm-1": False, "arm-2": True}
    shown = run("lockout").stdout
    assert "kept here" not in shown and "Free: arm-1." in shown and B in shown
    fleet.mute = {"arm-1"}
    assert "arm-1 (kept here)" in run("lockout").stdout


def test_without_a_network_what_is_kept_here_is_still_told(
    run: Run, monkeypatch: pytest.MonkeyPatch, state_directory: Path
) -> None:
    def nobody(network: object, source: str = "") -> Any:
        raise Failure("The network is not there.", Exit.SILENT)

    monkeypatch.setattr(resume, "reached", nobody)
    LockoutStore().save({"k": Kept(LockoutState((Hold(A, "desk", "", 0.0),)), name="arm-1")})
    result = run("lockout")
    assert result.exit_code == 0
    assert "The network is not there." in result.stdout and "arm-1" in result.stdout
    (state_directory / "lockouts.json").write_text("{", encoding="utf-8")
    assert run("lockout").exit_code == 1
