"""Endpoints and certificates of a session, and refusals that name the remedy."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from strands_robots.mesh import topics
from strands_robots.mesh.transport import TransportError, config
from strands_robots.mesh.transport.config import Posture


@pytest.fixture(autouse=True)
def usual_port(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STRANDS_MESH_PORT")


def test_without_any_setting_the_mesh_stays_on_loopback_without_certificates() -> None:
    posture = Posture.from_settings()
    assert posture.hub == "tcp/127.0.0.1:7447"
    assert posture.credentials is None
    stated = config.hub(posture)
    assert stated["scouting"]["multicast"]["enabled"] is False
    assert stated["namespace"] == "strands"
    assert stated["adminspace"]["enabled"] is False
    assert stated["transport"]["unicast"]["max_sessions"] == 512
    limits = {key: rule["size_limit"] for rule in stated["low_pass_filter"] for key in rule["key_exprs"]}
    assert limits["strands/strands/*/cmd"] == 16 * 1024
    assert limits["strands/strands/safety/estop"] == 4 * 1024


@pytest.mark.parametrize("setting", ["ZENOH_CONNECT", "ZENOH_LISTEN"])
@pytest.mark.parametrize(
    "endpoint", ["tcp/10.0.0.1:7447", "tcp/0.0.0.0:7447", "udp/robot.example:7447", "tcp/[::]:7447"]
)
def test_leaving_loopback_names_the_command_to_run(
    monkeypatch: pytest.MonkeyPatch, setting: str, endpoint: str
) -> None:
    monkeypatch.setenv(setting, endpoint)
    with pytest.raises(TransportError, match="strands-robots mesh keys init"):
        Posture.from_settings()
    monkeypatch.setenv("STRANDS_MESH_LOCAL_DEV", "true")
    assert Posture.from_settings().hub is None


def test_multicast_leaves_loopback_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_MULTICAST", "true")
    with pytest.raises(TransportError, match="multicast"):
        Posture.from_settings()


def test_auth_mode_none_needs_its_opt_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENOH_CONNECT", "tcp/10.0.0.1:7447")
    monkeypatch.setenv("STRANDS_MESH_AUTH_MODE", "none")
    with pytest.raises(TransportError):
        Posture.from_settings()
    monkeypatch.setenv("STRANDS_MESH_I_KNOW_THIS_IS_INSECURE", "true")
    assert Posture.from_settings().connect == ("tcp/10.0.0.1:7447",)


@pytest.mark.parametrize(
    ("endpoint", "inside"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tls/localhost:7447", True),
        ("tcp/[::1]:7447", True),
        ("unixsock-stream//tmp/x", True),
        ("tcp/192.168.1.2:7447", False),
        ("tcp/localhost.evil.example:7447", False),
        ("nonsense", False),
    ],
)
def test_loopback_is_recognised_by_the_address(endpoint: str, inside: bool) -> None:
    assert config.is_loopback(endpoint) is inside


def use(monkeypatch: pytest.MonkeyPatch, issued: config.TlsCredentials) -> None:
    for name, value in issued.settings().items():
        monkeypatch.setenv(name, value)


def test_certificates_bring_mutual_tls_and_access_control(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    config.make_authority(tmp_path)
    use(monkeypatch, config.issue_certificate(tmp_path, "arm-1", ["192.168.1.2", "arm.example"]))
    posture = Posture.from_settings()
    assert posture.hub == "tls/127.0.0.1:7447"
    stated = config.hub(posture)
    assert stated["transport"]["link"]["protocols"] == ["tls"]
    tls = stated["transport"]["link"]["tls"]
    assert tls["enable_mtls"] and tls["verify_name_on_connect"] and tls["close_link_on_expiration"]
    assert stated["access_control"]["default_permission"] == "deny"


def test_files_that_others_may_read_or_that_are_links_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    config.make_authority(tmp_path)
    issued = config.issue_certificate(tmp_path, "arm-1")
    use(monkeypatch, issued)
    issued.key.chmod(0o640)
    with pytest.raises(TransportError, match="chmod 600"):
        Posture.from_settings()
    issued.key.chmod(0o600)
    link = tmp_path / "link.pem"
    link.symlink_to(issued.cert)
    monkeypatch.setenv("STRANDS_MESH_TLS_CERT", str(link))
    with pytest.raises(TransportError, match="symbolic link"):
        Posture.from_settings()
    monkeypatch.delenv("STRANDS_MESH_TLS_CERT")
    with pytest.raises(TransportError, match="STRANDS_MESH_TLS_CERT is not set"):
        Posture.from_settings()


def test_access_rules_that_allow_by_default_need_the_opt_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    config.make_authority(tmp_path)
    use(monkeypatch, config.issue_certificate(tmp_path, "arm-1"))
    rules = tmp_path / "acl.json5"
    monkeypatch.setenv("STRANDS_MESH_ACL_FILE", str(rules))
    rules.write_text("{enabled: true, /* hm */ default_permission: 'allow', rules: [], subjects: [], policies: []}")
    with pytest.raises(TransportError, match="STRANDS_MESH_ACCEPT_PERMISSIVE_ACL"):
        config.hub(Posture.from_settings())
    monkeypatch.setenv("STRANDS_MESH_ACCEPT_PERMISSIVE_ACL", "true")
    assert config.hub(Posture.from_settings())["access_control"]["default_permission"] == "allow"
    rules.write_text("nonsense")
    with pytest.raises(TransportError, match="no access control"):
        config.hub(Posture.from_settings())
    rules.write_text(" " * (257 * 1024))
    with pytest.raises(TransportError, match="256 KiB"):
        Posture.from_settings()


def test_an_authority_and_a_certificate_are_made_once(tmp_path: Path) -> None:
    config.make_authority(tmp_path)
    issued = config.issue_certificate(tmp_path, "arm-1")
    assert issued.key.stat().st_mode & 0o777 == 0o600
    with pytest.raises(FileExistsError):
        config.make_authority(tmp_path)
    with pytest.raises(FileExistsError):
        config.issue_certificate(tmp_path, "arm-1")
    with pytest.raises(ValueError, match="peer_id"):
        config.issue_certificate(tmp_path, "../arm")
    with pytest.raises(FileNotFoundError):
        config.issue_certificate(tmp_path / "nowhere", "arm-2")


def test_access_rules_name_every_peer_and_nothing_else() -> None:
    rules = json.loads(config.named_rules(["arm-1"], ["console"]))
    granted = {policy["subjects"][0]: policy["rules"] for policy in rules["policies"]}
    assert "command" not in granted["arm-1"]
    assert "command" in granted["console"]
    with pytest.raises(ValueError, match="at least one"):
        config.named_rules([])


def test_every_topic_has_a_size_and_only_telemetry_is_downsampled() -> None:
    for topic in topics.TABLE:
        assert topic.max_bytes > 0
        if topic.name in ("cmd", "broadcast", "response", "estop", "resume", "input"):
            assert topic.ceiling_hz is None


def test_stated_endpoints_route_for_others_and_are_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZENOH_CONNECT", "tcp/127.0.0.1:7447")
    stated = config.explicit(Posture.from_settings())
    assert stated["mode"] == "router"
    assert stated["connect"]["exit_on_failure"] is False
    assert stated["connect"]["timeout_ms"] == -1
    assert stated["connect"]["retry"] == {"period_init_ms": 1000, "period_max_ms": 8000, "period_increase_factor": 2}
    for scout in ("gossip", "multicast"):
        assert stated["scouting"][scout]["autoconnect"]["router"] == ["router", "peer"]
