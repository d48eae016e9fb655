from __future__ import annotations

import json
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.cli.conftest import Run, connect
from tests.cli.test_cli_safety_controller import drawn

from strands_robots.audit import read_audit_log
from strands_robots.cli.output import Exit
from strands_robots.cli.stop import exit_code, report_rows, style_of, summary
from strands_robots.device_connect.backends import loopback_config
from strands_robots.device_connect.backends.config import network_of
from strands_robots.device_connect.client import Peer
from strands_robots.envelope import Envelope, success
from strands_robots.fleet.adapter import LockoutReport
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.safety_console import SafetyConsole, WatchedRobots
from strands_robots.safety import statements
from strands_robots.safety.answers import Answer, StopReport
from strands_robots.safety.ed25519 import keygen
from strands_robots.safety.identity import (
    ROBOTS,
    EnrolledKeys,
    KeyFile,
    SigningIdentity,
    enrolled_consoles,
    fingerprint,
)
from strands_robots.safety.statements import Proof, Purpose, signed
from strands_robots.utils import operator

STRONG = "Plenty of 4 different words"
EPOCH = "a" * 32


class SigningFleet:
    """One locked robot whose answers are signed by the key that the test gives it."""

    def __init__(self, identity: SigningIdentity | None) -> None:
        self.link, self.source = loopback_config(), "cli"
        self.identity = identity
        self.locked = True
        self.stale = ""
        self.signs: dict[str, Any] = {}
        self.states: dict[str, Any] = {}

    def peers(self, timeout: float = 2.0) -> list[Peer]:
        return [Peer("arm-1", functions=({"name": "resume"},))]

    def announces(self, device: str, function: str, argument: str) -> bool:
        return False

    def call(self, device: str, function: str, params: dict[str, Any], timeout: float) -> Envelope:
        if function == "resume":
            self.locked = False
        rows = [{"epoch": EPOCH, "source": "desk", "reason": "", "since": 0.0}] if self.locked else []
        fields = {"locked": self.locked, "epochs": [each["epoch"] for each in rows], **params}
        purpose = Purpose.LOCKOUT_STATE
        if function == "resume":
            purpose = Purpose.RESUME_ANSWER
            fields = {"locked": self.locked, "status": "success", "nonce": params["assertion"]["nonce"]}
        statement = signed(self.identity, purpose, device, {**fields, **self.signs})
        answer = success("done", locked=self.locked, lockout=rows, **self.states)
        # As a robot does: it signs what it is asked to sign.
        return {**answer, "statement": statement} if function == "resume" or "nonce" in params else answer

    def call_each(
        self, calls: dict[str, dict[str, Any]], function: str, timeout: float
    ) -> dict[str, tuple[Envelope | Exception, float]]:
        return {device: (self.call(device, function, params, timeout), 0.001) for device, params in calls.items()}


@pytest.fixture
def robot(tmp_path: Path) -> SigningIdentity:
    return KeyFile(ROBOTS, "arm-1", tmp_path / "robot").load_or_make()


@pytest.fixture
def stranger(tmp_path: Path) -> SigningIdentity:
    return KeyFile(ROBOTS, "arm-1", tmp_path / "stranger").load_or_make()


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch, robot: SigningIdentity) -> SigningFleet:
    fake = SigningFleet(robot)
    connect(monkeypatch, fake)
    return fake


@pytest.fixture
def resume(tmp_path: Path) -> tuple[str, ...]:
    (tmp_path / "passphrase").write_text(STRONG, encoding="utf-8")
    keygen(tmp_path / "key.pem", STRONG)
    return "resume", "--key", str(tmp_path / "key.pem"), "--passphrase-file", str(tmp_path / "passphrase"), "--json"


def test_a_robot_is_enrolled_with_its_fingerprint(run: Run, fleet: SigningFleet, robot: SigningIdentity) -> None:
    result = run("enroll")
    assert result.exit_code == 0, result.output
    assert robot.fingerprint in result.stdout
    assert "strands-robots doctor" in result.stdout
    assert EnrolledKeys().load() == {"arm-1": robot.public}
    assert json.loads(run("enroll", "arm-1", "--json").stdout)["devices"]["arm-1"]["outcome"] == "known"


def test_only_a_signed_cell_is_enrolled(run: Run, fleet: SigningFleet) -> None:
    fleet.states = {"cell": "elsewhere"}
    run("enroll")
    assert EnrolledKeys().robots()["arm-1"].cell is None
    fleet.signs = {"cell": "cell-1"}
    run("enroll")
    assert EnrolledKeys().robots()["arm-1"].cell == "cell-1"


def test_cell_of_a_recorded_statement_is_not_enrolled(
    run: Run, fleet: SigningFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet.signs = {"cell": "cell-1"}
    monkeypatch.setattr(statements, "STATED_WITHIN_S", -1.0)
    run("enroll")
    assert EnrolledKeys().robots()["arm-1"].cell is None


def test_a_changed_key_is_an_alarm_and_changes_nothing(
    run: Run, fleet: SigningFleet, robot: SigningIdentity, stranger: SigningIdentity
) -> None:
    run("enroll")
    fleet.identity = stranger
    result = run("enroll")
    assert result.exit_code == 1
    assert "CHANGED KEY" in result.stdout and fingerprint(stranger.public) in result.stdout
    assert "ALARM: arm-1" in result.stderr
    assert EnrolledKeys().load() == {"arm-1": robot.public}
    assert run("enroll", "--replace").exit_code == 0
    assert EnrolledKeys().load() == {"arm-1": stranger.public}


def test_a_robot_without_a_key_is_named_and_not_enrolled(run: Run, fleet: SigningFleet) -> None:
    fleet.identity = None
    result = run("enroll")
    assert result.exit_code == 3
    assert "no key" in result.stdout
    assert EnrolledKeys().load() == {}


@pytest.mark.parametrize(
    ("signer", "signs", "said"),
    [
        ("robot", {"locked": False}, "ALARM: its answer says something else than its signed part"),
        ("robot", {"epochs": []}, "ALARM: its answer says something else than its signed part"),
        ("robot", {"nonce": "b" * 32}, "ALARM: its answer says something else than its signed part"),
        ("stranger", {}, "ALARM: its answer has a signature"),
        ("", {}, "only claimed"),
    ],
)
def test_a_lockout_state_that_is_not_the_robots_own_is_not_shown(
    run: Run,
    fleet: SigningFleet,
    robot: SigningIdentity,
    stranger: SigningIdentity,
    signer: str,
    signs: dict[str, Any],
    said: str,
) -> None:
    assert EPOCH in run("lockout").stdout
    run("enroll")
    assert EPOCH in run("lockout").stdout
    fleet.identity, fleet.signs = {"robot": robot, "stranger": stranger}.get(signer), signs
    result = run("lockout")
    assert said in result.stdout
    assert EPOCH not in result.stdout


def test_a_recorded_lockout_state_is_not_shown(run: Run, fleet: SigningFleet, monkeypatch: pytest.MonkeyPatch) -> None:
    run("enroll")
    asked: list[dict[str, Any]] = []
    answer = fleet.call

    def recording(device: str, function: str, params: dict[str, Any], timeout: float) -> Envelope:
        asked.append(params)
        return answer(device, function, params, timeout)

    monkeypatch.setattr(fleet, "call", recording)
    assert EPOCH in run("lockout").stdout
    recorded = answer("arm-1", "getStatus", asked[-1], 1.0)
    monkeypatch.setattr(fleet, "call", lambda *called: recorded)
    told = run("lockout")
    assert EPOCH not in told.stdout
    assert "ALARM: its answer says something else than its signed part" in told.stdout


def test_a_signed_lockout_state_of_another_time_is_not_shown(
    run: Run, fleet: SigningFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("enroll")
    now = time.time() + 2 * statements.STATED_WITHIN_S
    monkeypatch.setattr(statements, "time", SimpleNamespace(time=lambda: now))
    answer = fleet.call

    def of_another_time(*called: Any) -> Envelope:
        with monkeypatch.context() as then:
            then.setattr(statements, "time", time)
            return answer(*called)

    monkeypatch.setattr(fleet, "call", of_another_time)
    told = run("lockout")
    assert EPOCH not in told.stdout
    assert "not of this minute" in told.stdout


def test_only_the_robot_itself_says_that_it_was_resumed(
    run: Run, fleet: SigningFleet, robot: SigningIdentity, stranger: SigningIdentity, resume: tuple[str, ...]
) -> None:
    run("enroll")
    assert json.loads(run(*resume).stdout)["devices"]["arm-1"] == {"free": True, "said": "done"}
    fleet.locked, fleet.signs = True, {"nonce": "0" * 32}
    answer = json.loads(run(*resume).stdout)["devices"]["arm-1"]
    assert answer["free"] is False
    assert "something else than its signed part" in answer["said"]


def test_enrolled_keys_that_cannot_be_used_are_named(run: Run, fleet: SigningFleet) -> None:
    run("enroll")
    EnrolledKeys().path.chmod(0o666)
    for line in (("enroll",), ("lockout",)):
        result = run(*line)
        assert "mode 0666" in result.stdout + result.stderr


def test_doctor_shows_the_fingerprints_of_the_robots_of_this_machine(run: Run) -> None:
    identity = KeyFile(ROBOTS, "arm-7").load_or_make()
    KeyFile(ROBOTS, "arm-8").load_or_make()
    KeyFile(ROBOTS, "arm-8").path.chmod(0o644)
    output = " ".join(run("doctor").stdout.split())
    assert identity.fingerprint in output
    assert "0644" in output


def claim(name: str, *, enrolled: bool = False) -> Answer:
    return Answer(name, True, 3.0, "", {"halted": ["task"]}, Proof.CLAIMED, required=True, enrolled=enrolled)


def test_a_claimed_stop_is_yellow_and_exits_with_3() -> None:
    report = StopReport("e" * 32, {}, {}, {}, (), True, 12.0, claimed={"arm-1": claim("arm-1")})
    assert not report.ok
    assert exit_code(report) is Exit.SILENT
    assert style_of(report) == "yellow"
    assert "1 claimed" in summary(report)
    row = report_rows(report)[0]
    assert (str(row[1]), str(row[1].style)) == ("claimed", "yellow")
    assert row[3] == "not signed by arm-1; halted task"


def test_a_wrong_key_is_red_and_exits_with_1_unless_the_robot_answers_itself() -> None:
    alarms = {"arm-1": "a signature that is not of its enrolled key"}
    report = StopReport("e" * 32, {}, {}, {}, (), True, 12.0, alarms=alarms)
    assert exit_code(report) is Exit.REFUSED
    assert style_of(report) == "bold red"
    row = report_rows(report)[0]
    assert (row[0], str(row[1]), str(row[1].style), row[3]) == ("arm-1", "WRONG KEY", "bold red", alarms["arm-1"])
    own = Answer("arm-1", True, 3.0, "", {}, Proof.SIGNED, required=True, enrolled=True)
    answered = StopReport("e" * 32, {"arm-1": own}, {}, {}, (), True, 12.0, alarms=alarms)
    assert answered.ok
    assert exit_code(answered) is Exit.OK


def test_the_space_bar_goes_on_for_an_enrolled_robot_that_is_only_claimed() -> None:
    claimed = {"arm-1": claim("arm-1", enrolled=True), "arm-2": claim("arm-2")}
    report = StopReport("e" * 32, {}, {}, {}, ("arm-3",), True, 12.0, claimed=claimed, alarms={"arm-4": "why"})
    assert set(report.unanswered) == {"arm-1", "arm-3", "arm-4"}


def test_the_fleet_screen_names_a_robot_with_a_wrong_key() -> None:
    console, fleet = SafetyConsole(Networks([])), WatchedRobots()
    console.watched = {"near": fleet}
    fleet.update([LockoutReport("arm-1"), LockoutReport("arm-2", problem="ALARM: a wrong key")])
    assert "arm-2: ALARM: a wrong key." in drawn(console)


def test_key_of_a_console_elsewhere_is_trusted_for_motions(run: Run, stranger: SigningIdentity) -> None:
    result = run("enroll", "--console", stranger.public_text)
    assert result.exit_code == 0, result.output
    assert stranger.fingerprint in result.stdout
    assert stranger.public in enrolled_consoles().load().values()
    assert EnrolledKeys().load() == {}


def test_text_that_is_no_key_enrolls_no_console(run: Run) -> None:
    result = run("enroll", "--console", "laptop")
    assert result.exit_code == 2
    assert "keys console" in result.stderr and "laptop" in result.stderr
    assert enrolled_consoles().load() == {}


def test_an_enrolled_robot_has_its_network(run: Run, fleet: SigningFleet) -> None:
    run("enroll")
    (network,) = EnrolledKeys().robots()["arm-1"].networks
    assert network == network_of(fleet.link)
    listed = json.loads(run("enroll", "--list", "--json").stdout)["robots"]["arm-1"]
    assert (listed["networks"], listed["exempt"]) == ([network.text], None)
    assert "must answer" in run("enroll", "--list").stdout


@pytest.mark.parametrize("state", ["retired", "off"])
def test_an_exemption_has_a_name_and_a_reason_and_is_audited(run: Run, fleet: SigningFleet, state: str) -> None:
    run("enroll")
    flag = "--retire" if state == "retired" else "--off"
    result = run("enroll", flag, "arm-1", "--reason", "moved house")
    assert result.exit_code == 0, result.output
    assert f"arm-1 is {state}: every stop prints that" in result.stdout
    exempt = json.loads(run("enroll", "--list", "--json").stdout)["robots"]["arm-1"]["exempt"]
    assert (exempt["state"], exempt["by"], exempt["reason"]) == (state, operator(), "moved house")
    record = read_audit_log()[-1]
    assert (record["event"], record["peer_id"]) == (f"enrolment_{state}", "arm-1")
    assert record["payload"]["who"] == operator() and record["payload"]["reason"] == "moved house"
    # It was asked and answered signed: it must answer again.
    assert run("enroll").exit_code == 0
    assert EnrolledKeys().robots()["arm-1"].exemption is None
    assert read_audit_log()[-1]["event"] == "exemption_undone"


def test_an_enrolment_is_undone(run: Run, fleet: SigningFleet) -> None:
    run("enroll")
    assert run("enroll", "--forget", "arm-1").exit_code == 0
    assert EnrolledKeys().load() == {}
    assert read_audit_log()[-1]["event"] == "enrolment_forgotten"
    assert "No robot is enrolled" in run("enroll", "--list").stdout


@pytest.mark.parametrize("flag", ["--retire", "--off", "--forget"])
def test_a_robot_that_is_not_enrolled_is_named(run: Run, fleet: SigningFleet, flag: str) -> None:
    run("enroll")
    result = run("enroll", flag, "arm-7")
    assert result.exit_code == 1
    assert "'arm-7' is not enrolled. Enrolled: arm-1." in result.stderr


def test_a_robot_of_another_tenant_is_exempted_by_its_tenant(run: Run) -> None:
    EnrolledKeys().enroll({"fleet.arm-1": b"1" * 32, "arm-1": b"2" * 32})
    assert run("enroll", "--off", "arm-1", "--tenant", "fleet").exit_code == 0
    robots = EnrolledKeys().robots()
    assert robots["fleet.arm-1"].exemption is not None
    assert robots["arm-1"].exemption is None


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--retire", "arm-1", "--off", "arm-1"), "one at a time"),
        (("--retire", "arm-1", "--list"), "go with no other"),
        (("--forget", "arm-1", "arm-2"), "go with no other"),
        (("--forget", "arm-1", "--reason", "x"), "--reason goes with"),
        (("--reason", "x"), "--reason goes with"),
        (("--off", "arm-1", "--reason", "x" * 201), "--reason"),
        (("--off", "arm-1", "--reason", "a\nb"), "--reason"),
    ],
)
def test_a_change_that_says_two_things_is_refused(run: Run, arguments: tuple[str, ...], said: str) -> None:
    EnrolledKeys().enroll({"arm-1": b"1" * 32})
    result = run("enroll", *arguments)
    assert result.exit_code == 2, result.output
    assert said in result.stderr
    assert EnrolledKeys().robots()["arm-1"].exemption is None


def test_a_file_that_cannot_be_used_changes_nothing(run: Run) -> None:
    EnrolledKeys().enroll({"arm-1": b"1" * 32})
    EnrolledKeys().path.chmod(0o666)
    for arguments in (("--list",), ("--retire", "arm-1")):
        result = run("enroll", *arguments)
        assert result.exit_code == 1
        assert "enrolled.json" in result.stderr
