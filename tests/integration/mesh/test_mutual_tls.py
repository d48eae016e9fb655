"""The mesh over mutual TLS: who gets in, and who may speak as whom."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import pytest
from fixtures.certificates import Authority
from fixtures.mesh_peer import MeshPeer
from fixtures.waiting import eventually, free_port
from tests.integration.mesh.conftest import Join

from strands_robots.mesh.transport import config

Fleet = dict[str, dict[str, str]]


@pytest.fixture
def fleet(tmp_path: Path) -> Fleet:
    """Certificates and access rules by which only the console commands."""
    folder = tmp_path / "keys"
    config.make_authority(folder)
    names = ("console", "sim-1", "sim-2")
    rules = folder / "acl.json5"
    rules.write_text(config.named_rules(["sim-1", "sim-2"], ["console"]))
    return {
        name: {**config.issue_certificate(folder, name).settings(), "STRANDS_MESH_ACL_FILE": str(rules)}
        for name in names
    }


def test_certified_peers_see_and_command_each_other_with_signed_messages(join: Join, fleet: Fleet) -> None:
    console, sim = join("console", "none", **fleet["console"]), join("sim-1", **fleet["sim-1"])
    console.sees("sim-1")
    sim.sees("console")
    assert console.ask("cert", "sim-1")[1] == "sim-1"
    assert console.ask("ping", "sim-1")["status"] == "ok"
    start = {"action": "start", "instruction": "wave", "policy_provider": "mock"}
    assert console.ask("send", "sim-1", start, 20)["result"]["status"] == "success"
    console.ask("estop")
    eventually(lambda: sim.ask("epoch"))


def test_the_access_rules_keep_a_robot_from_commanding_another(join: Join, fleet: Fleet) -> None:
    hub = join("console", "none", **fleet["console"])
    one, two = join("sim-1", **fleet["sim-1"]), join("sim-2", **fleet["sim-2"])
    one.sees("sim-2")
    hub.sees("sim-1", "sim-2")
    assert one.ask("ping", "sim-2", 0.5)["status"] == "timeout"
    assert hub.ask("ping", "sim-2")["status"] == "ok"
    eventually(lambda: two.ask("reachable"))


def test_a_certificate_may_not_announce_another_peer(join: Join, fleet: Fleet, tmp_path: Path) -> None:
    console = join("console", "none", **fleet["console"])
    join("sim-2", "world", **fleet["sim-1"])
    join("sim-1", "world", **fleet["sim-1"])
    console.sees("sim-1")
    assert console.ask("zid", "sim-2") is None
    assert console.ask("cert", "sim-2") is None


@pytest.mark.parametrize("outsider", ["another authority", "no certificate"])
def test_peer_of_another_fleet_gets_no_link(join: Join, fleet: Fleet, tmp_path: Path, port: int, outsider: str) -> None:
    console = join("console", "none", **fleet["console"])
    other: dict[str, str] = {"ZENOH_CONNECT": f"tcp/127.0.0.1:{port}"}
    if outsider == "another authority":
        foreign = tmp_path / "foreign"
        config.make_authority(foreign)
        other = {**config.issue_certificate(foreign, "sim-1").settings(), "ZENOH_CONNECT": f"tls/127.0.0.1:{port}"}
    stranger = join("sim-1", "world", **other)
    with pytest.raises(AssertionError):
        console.sees("sim-1", within=1.5)
    assert stranger.ask("reachable") == []


def certified(authority: Authority, peer_id: str, seconds: float) -> dict[str, str]:
    """Settings of a peer whose certificate lasts for so long from now on."""
    made = authority.issue(peer_id, lasts=timedelta(seconds=seconds))
    return {
        "STRANDS_MESH_TLS_CA": str(made.ca),
        "STRANDS_MESH_TLS_CERT": str(made.cert),
        "STRANDS_MESH_TLS_KEY": str(made.key),
    }


def test_an_expired_certificate_gets_no_link(join: Join, tmp_path: Path, port: int) -> None:
    authority = Authority(tmp_path / "fleet")
    console = join("console", "none", **certified(authority, "console", 3600))
    valid = join("sim-1", **certified(authority, "sim-1", 3600))
    stated = {"ZENOH_CONNECT": f"tls/127.0.0.1:{port}"}
    expired = join("sim-2", **certified(authority, "sim-2", -10), **stated)
    console.sees("sim-1")
    valid.sees("console")
    with pytest.raises(AssertionError):
        console.sees("sim-2", within=1.5)
    assert expired.ask("reachable") == []


def test_a_peer_whose_certificate_expires_is_cut_off_at_that_time(join: Join, tmp_path: Path) -> None:
    authority = Authority(tmp_path / "fleet")
    console = join("console", "none", **certified(authority, "console", 3600))
    sim = join("sim-1", **certified(authority, "sim-1", 25))
    console.sees("sim-1")
    assert console.ask("ping", "sim-1")["status"] == "ok"
    eventually(lambda: console.ask("reachable") == [], within=60)
    assert console.ask("ping", "sim-1", 0.5)["status"] == "timeout"
    assert sim.ask("alive") is not None


def test_leaving_loopback_without_certificates_is_refused_by_name(tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir(mode=0o700)
    settings = {"ZENOH_LISTEN": f"tcp/0.0.0.0:{free_port()}", "STRANDS_STATE_DIR": str(state)}
    with MeshPeer("sim-1", "world", settings) as peer:
        assert peer.ask("alive") is False


def test_the_fleet_of_the_guide_works_with_rules_and_stated_endpoints(join: Join, fleet: Fleet, port: int) -> None:
    endpoint = f"tls/127.0.0.1:{port}"
    one = join("sim-1", ZENOH_CONNECT=endpoint, **fleet["sim-1"])
    console = join("console", "none", ZENOH_LISTEN=endpoint, **fleet["console"])
    two = join("sim-2", ZENOH_CONNECT=endpoint, **fleet["sim-2"])
    for peer, others in ((console, ("sim-1", "sim-2")), (one, ("console", "sim-2")), (two, ("console", "sim-1"))):
        peer.sees(*others)
    assert console.ask("ping", "sim-1")["status"] == console.ask("ping", "sim-2")["status"] == "ok"
    assert one.ask("ping", "sim-2", 0.5)["status"] == "timeout"
    one.ask("start", "wave")
    # A robot may not command, but its emergency stop counts for every peer.
    two.ask("estop")
    eventually(lambda: one.ask("epoch") == console.ask("epoch") == two.ask("epoch"))
    eventually(lambda: one.ask("moving") == [], what="it stands still")
    two.kill()
    eventually(lambda: "sim-2" not in console.ask("reachable"))
    eventually(lambda: "sim-2" not in one.ask("reachable"))
