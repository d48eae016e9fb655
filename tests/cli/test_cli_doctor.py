from __future__ import annotations

import json
import os
import re
import socket
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from click.testing import Result
from fixtures.certificates import Authority, Identity
from fixtures.waiting import free_port
from tests.cli.conftest import Run

from strands_robots import __version__
from strands_robots.cli import doctor, readiness
from strands_robots.cli.app import other_owners
from strands_robots.cli.doctor import Finding
from strands_robots.cli.readiness import certificate_problem
from strands_robots.device_connect.backends import LinkConfig


@pytest.fixture(autouse=True)
def no_rendering(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rendering is tried in a process of its own; the integration test does that."""
    monkeypatch.setattr(doctor, "_RENDER", "print('rendered with nothing')")


def checked(result: Result) -> dict[str, dict[str, str]]:
    return {found["name"]: found for found in json.loads(result.stdout)["checks"]}


def test_working_installation_is_ok(run: Run) -> None:
    result = run("doctor", "--json")
    found = checked(result)
    assert result.exit_code == 0
    assert found["extra device-connect"]["mark"] == "ok"
    assert "127.0.0.1" in found["network"]["said"]


def test_every_finding_that_is_not_ok_has_a_remedy(run: Run) -> None:
    for found in checked(run("doctor", "--json")).values():
        assert found["mark"] == "ok" or found["remedy"], found


@pytest.mark.parametrize(
    ("settings", "mark", "said"),
    [
        ({}, "ok", "no mesh answers"),
        ({"STRANDS_MESH": "false"}, "ok", "it is switched off"),
        ({"STRANDS_MESH": "true"}, "warn", "no mesh answers"),
        ({"STRANDS_MESH_BACKEND": "memory"}, "ok", "its peers are reached by every command"),
    ],
)
def test_mesh_that_commands_reach_is_joined(
    run: Run, monkeypatch: pytest.MonkeyPatch, settings: dict[str, str], mark: str, said: str
) -> None:
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    found = checked(run("doctor", "--json"))["mesh"]
    assert (found["mark"], said in found["said"]) == (mark, True), found


def test_missing_required_package_is_broken_and_exits_with_1(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_version", lambda name: None)
    result = run("doctor", "--json")
    assert result.exit_code == 1
    assert checked(result)["extra device-connect"]["mark"] == "broken"
    assert "'.[device-connect]'" in checked(result)["extra device-connect"]["remedy"]
    assert checked(result)["extra lerobot"]["mark"] == "note"


def test_other_release_of_the_framework_is_broken(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_version", lambda name: "0.3.0")
    result = run("doctor", "--json")
    assert result.exit_code == 1
    assert "0.2.5" in checked(result)["extra device-connect"]["remedy"]


def test_unusable_network_is_broken_with_a_remedy(run: Run) -> None:
    result = run("doctor", "--json", "--nats", "nats://192.0.2.1:4222")
    assert result.exit_code == 1
    assert "--insecure" in checked(result)["network"]["remedy"]


def test_port_that_another_program_holds_is_broken_by_its_name(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readiness, "DIAL_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        result = run("doctor", "--json", "--port", str(port))
    found = checked(result)["port"]
    assert (result.exit_code, found["mark"]) == (1, "broken")
    assert f"127.0.0.1:{port}: another program holds the port (pid {os.getpid()} " in found["said"]


def test_credentials_that_others_can_read_are_a_warning(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "arm.json"
    file.write_text("{}")
    file.chmod(0o644)
    monkeypatch.setenv("MESSAGING_CREDENTIALS_FILE", str(file))
    found = checked(run("doctor", "--json"))["credentials"]
    assert found["mark"] == "warn"
    assert "chmod 600" in found["remedy"]


def linked(identity: Identity, **other: Path) -> LinkConfig:
    """A link with the identity's files, and others in the place of some."""
    files = {"ca": identity.ca, "cert": identity.cert, "key": identity.key} | other
    return LinkConfig(connect=("tls/localhost:7447",), **{part: str(file) for part, file in files.items()})


def test_certificate_is_checked_against_its_key_its_authority_and_its_dates(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    arm, other, foreign = authority.issue("arm"), authority.issue("other"), Authority(tmp_path / "b", "elsewhere")
    assert certificate_problem(linked(arm)) == ""
    assert certificate_problem(linked(arm, key=other.key)) == f"{other.key} is not the key of {arm.cert}"
    assert f"{arm.cert} was not issued by {foreign.ca}" in certificate_problem(linked(arm, ca=foreign.ca))
    later = datetime.now(UTC) + timedelta(days=9)
    assert "has expired: it was valid until" in certificate_problem(linked(arm), later)
    assert "is not valid yet" in certificate_problem(linked(arm), later - timedelta(days=20))
    assert f"{tmp_path / 'absent'} cannot be read" in certificate_problem(linked(arm, cert=tmp_path / "absent"))
    assert certificate_problem(linked(arm, ca=arm.key)) == f"{arm.key} holds no PEM certificate"
    assert f"{arm.cert} holds no PEM private key" in certificate_problem(linked(arm, key=arm.cert))
    assert f"{tmp_path} cannot be read" in certificate_problem(linked(arm, cert=tmp_path))


@pytest.mark.parametrize("given", ["flags", "environment"])
def test_expired_certificate_is_named_however_it_is_given(
    given: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(readiness, "DIAL_S", 0.5)
    old = Authority(tmp_path).issue("old", lasts=timedelta(minutes=-1))
    files = {"ca": old.ca, "cert": old.cert, "key": old.key}
    flags = [word for part, file in files.items() for word in (f"--tls-{part}", str(file))]
    if given == "environment":
        flags = []
        for part, file in files.items():
            monkeypatch.setenv(f"MESSAGING_TLS_{part.upper()}_FILE", str(file))
        monkeypatch.setenv("MESSAGING_URLS", f"tls/127.0.0.1:{free_port()}")
        monkeypatch.setenv("MESSAGING_BACKEND", "zenoh")
    else:
        flags += ["--connect", f"tls/127.0.0.1:{free_port()}"]
    result = run("doctor", "--json", *flags)
    found = checked(result)
    assert result.exit_code == 1
    assert f"{old.cert} has expired" in found["certificates"]["said"]
    assert found["dial"]["mark"] == "broken" and "nothing listens there" in found["dial"]["said"]


def test_table_ends_with_a_verdict(run: Run) -> None:
    result = run("doctor")
    assert result.exit_code == 0
    assert "Everything that is required works." in result.stdout


def installed(folder: Path, name: str, *files: str) -> Path:
    """Make the metadata of a distribution in ``folder``, as pip leaves it in a site-packages folder."""
    metadata = folder / f"{name.replace('-', '_')}-0.4.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.4.0\n")
    (metadata / "RECORD").write_text("".join(f"{file},sha256=x,1\n" for file in files))
    return folder


def test_only_another_distribution_with_our_import_package_is_an_owner(tmp_path: Path) -> None:
    installed(tmp_path, "strands-robots", "strands_robots/__init__.py", "strands_robots/robot.py")
    installed(tmp_path, "strands-robots-edge", "strands_robots/__init__.py")
    installed(tmp_path, "strands-robots-sim", "strands_robots_sim/__init__.py", "docs/strands_robots/__init__.py")
    assert other_owners([str(tmp_path)]) == ["strands-robots 0.4.0"]


def test_a_broken_list_of_another_distributions_files_is_passed_over(tmp_path: Path) -> None:
    installed(tmp_path, "strands-robots", "strands_robots/__init__.py")
    installed(tmp_path, "broken")
    (tmp_path / "broken-0.4.0.dist-info" / "RECORD").write_bytes(b"\xff\xfe")
    assert other_owners([str(tmp_path)]) == ["strands-robots 0.4.0"]


def test_doctor_warns_of_another_owner_of_the_import_package(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(tmp_path, "strands-robots", "strands_robots/__init__.py")
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    found = checked(run("doctor", "--json"))["distribution"]
    assert found["mark"] == "warn"
    assert "strands-robots 0.4.0" in found["said"]
    assert "pip uninstall strands-robots" in found["remedy"]


def test_a_command_starts_with_one_warning_line_about_another_owner(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "Warning" not in run("audit", "tail").stderr
    installed(tmp_path, "strands-robots", "strands_robots/__init__.py")
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    warnings = [line for line in run("audit", "tail").stderr.splitlines() if line.startswith("Warning")]
    assert len(warnings) == 1
    assert "strands-robots 0.4.0" in warnings[0]


def test_version_is_printed_with_the_name_of_the_distribution(run: Run) -> None:
    result = run("--version")
    assert result.exit_code == 0
    assert result.stdout == f"strands-robots-edge {__version__}\n"
    assert re.fullmatch(r"\d+\.\d+\.\d+", __version__)


def test_doctor_names_the_distribution_also_where_it_is_not_installed(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "_version", lambda name: None if name == "strands-robots-edge" else "0.2.5")
    found = checked(run("doctor", "--json"))["distribution"]
    assert found["mark"] == "ok"
    assert found["said"] == f"strands-robots-edge {__version__}, run from its source tree"


def _stops(monkeypatch: pytest.MonkeyPatch, **stated: str) -> Finding:
    for name, value in stated.items():
        monkeypatch.setenv(name, value)
    [finding] = doctor._stop_senders()
    return finding


def test_who_may_stop_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    anyone = _stops(monkeypatch)
    assert (anyone.mark, "any name may lock the robots" in anyone.said) == ("note", True)
    assert "STRANDS_ESTOP_REQUIRE_SIGNED=true" in anyone.remedy
    listed = _stops(monkeypatch, DEVICE_CONNECT_ESTOP_ALLOW="safety-*")
    assert listed.said == "names count as stated"


def test_signed_stops_alone_without_a_key_are_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _stops(monkeypatch, STRANDS_ESTOP_REQUIRE_SIGNED="true").mark == "broken"
    key = "A" * 43 + "="
    signed = _stops(monkeypatch, STRANDS_ESTOP_REQUIRE_SIGNED="true", DEVICE_CONNECT_ESTOP_PUBLIC_KEYS=key)
    assert signed.mark == "ok"
