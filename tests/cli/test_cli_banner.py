from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from fixtures.certificates import Authority
from rich.console import Console

from strands_robots.cli.output import Screen
from strands_robots.cli.serve import ServedRobot, commands, flags_elsewhere, show_banner
from strands_robots.device_connect.backends import LinkConfig, loopback_config

HERE = loopback_config(7447)
ARM = ServedRobot("arm-1", HERE, ("execute", "getStatus", "setGripper", "stop"), hardware=False, key="3f2a-91bc")


def drawn(served: ServedRobot, *lacking: str) -> list[str]:
    """The banner on a terminal of 80 columns."""
    sink = io.StringIO()
    show_banner(Screen(console=Console(file=sink, width=80, force_terminal=True, color_system=None)), served, lacking)
    return sink.getvalue().splitlines()


@pytest.mark.parametrize("hardware", [False, True])
def test_the_banner_is_at_most_ten_lines_of_80_columns(hardware: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "strands-robots")
    monkeypatch.delenv("STRANDS_STATE_DIR")
    lines = drawn(replace(ARM, hardware=hardware))
    assert len(lines) <= 10
    assert all(len(line) <= 80 for line in lines)
    assert lines[0].startswith("arm-1. This machine alone") and lines[-1].startswith("Ctrl-C")


def test_what_the_robot_lacks_comes_first() -> None:
    assert drawn(ARM, "The bus does not answer.")[0] == "NOT READY. The bus does not answer."


@pytest.mark.parametrize(("allowed", "may"), [("", "read it and stop it"), ("strands-robots", "drive and read it")])
def test_banner_says_drive_where_a_caller_may(allowed: str, may: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", allowed)
    lines = drawn(replace(ARM, hardware=True))
    assert lines[1] == f"Every program of this machine can {may}, no other machine can."


def test_a_simulation_needs_no_grant() -> None:
    assert list(commands(ARM)) == [
        "strands-robots peers arm-1",
        "strands-robots call arm-1 execute instruction=wave duration=5",
        "strands-robots stop arm-1",
        "strands-robots estop",
    ]


@pytest.mark.parametrize(
    ("allowed", "mock", "approved", "wanted"),
    [
        ("strands-*", "false", "", ["grant setGripper@arm-1", "call arm-1 setGripper opening=0.5"]),
        ("strands-robots", "true", "", ["grant execute@arm-1", "call arm-1 execute instruction=wave duration=5"]),
        ("strands-robots", "true", "execute@arm-1", ["call arm-1 execute instruction=wave duration=5"]),
        ("other", "true", "execute", ["call arm-1 getStatus"]),
        ("", "true", "execute", ["call arm-1 getStatus"]),
    ],
)
def test_real_hardware_is_granted_a_motion_that_this_command_line_may_have(
    allowed: str, mock: str, approved: str, wanted: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STRANDS_STATE_DIR", raising=False)
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", allowed)
    monkeypatch.setenv("STRANDS_ALLOW_MOCK", mock)
    monkeypatch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", approved)
    arm = replace(ARM, hardware=True)
    assert list(commands(arm))[1:-2] == [f"strands-robots {each}" for each in wanted]
    assert any("--rpc-allow strands-robots" in line for line in drawn(arm)) == ("getStatus" in wanted[0])


def test_a_grant_names_the_state_directory_of_the_robot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path / "a b"))
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "*")
    monkeypatch.setenv("STRANDS_ALLOW_MOCK", "false")
    granted = next(each for each in commands(replace(ARM, hardware=True)) if "grant" in each)
    assert granted == f"STRANDS_STATE_DIR='{tmp_path}/a b' strands-robots grant setGripper@arm-1"


@pytest.mark.parametrize(
    ("link", "flags"),
    [
        (HERE, ""),
        (loopback_config(7450), " --port 7450"),
        (loopback_config(7450, "lab"), " --port 7450 --tenant lab"),
        (LinkConfig(mode="peer", listen=("tcp/0.0.0.0:7448",)), " --connect tcp/127.0.0.1:7448 --insecure"),
        (LinkConfig(connect=("tcp/10.1.2.3:7447",)), " --connect tcp/10.1.2.3:7447 --insecure"),
        (LinkConfig(mode="peer", multicast=True), " --multicast --insecure"),
        (LinkConfig("nats", connect=("nats://u:secret@h:4222",)), " --nats 'nats://***@h:4222' --insecure"),
        (
            LinkConfig(connect=("tls/h:7447",), ca="/pki/ca.pem", cert="/pki/my arm.pem", key="/pki/k"),
            " --connect tls/h:7447 --tls-ca /pki/ca.pem --tls-cert '/pki/my arm.pem' --tls-key /pki/k",
        ),
    ],
    ids=["here", "port", "tenant", "listener", "router", "multicast", "nats", "tls"],
)
def test_flags_reach_the_link_without_our_environment(link: LinkConfig, flags: str) -> None:
    assert flags_elsewhere(link) == flags


@pytest.mark.parametrize(
    ("hosts", "reached"),
    [
        (("robot.lab", "127.0.0.1"), "127.0.0.1"),
        (("robot.lab", "localhost"), "localhost"),
        (("robot.lab", "10.1.2.3"), "robot.lab"),
        (("*.lab", "10.1.2.3"), "10.1.2.3"),
    ],
)
def test_listener_on_every_address_is_reached_by_a_host_of_its_certificate(
    tmp_path: Path, hosts: tuple[str, ...], reached: str
) -> None:
    own = Authority(tmp_path).issue("arm-1", hosts)
    files = {"ca": str(own.ca), "cert": str(own.cert), "key": str(own.key)}
    link = LinkConfig(mode="peer", listen=("tls/0.0.0.0:7448",), **files)
    assert flags_elsewhere(link).startswith(f" --connect tls/{reached}:7448")


def test_certificates_and_credentials_are_named_by_absolute_paths(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MESSAGING_CREDENTIALS_FILE", "arm.creds.json")
    link = LinkConfig("nats", connect=("tls://h:4222",), ca="ca.pem", jwt="j", nkey_seed="s")
    assert f"--tls-ca {tmp_path}/ca.pem --credentials {tmp_path}/arm.creds.json" in flags_elsewhere(link)
