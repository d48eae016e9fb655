"""What a link is made of."""

import json

import pytest

from strands_robots.device_connect.backends import LinkConfig, link_from_environment, loopback_config
from strands_robots.device_connect.backends.config import endpoints, host_of
from strands_robots.utils import ValidationError


def test_link_without_settings_is_a_multicast_peer():
    link = link_from_environment()
    assert link.is_peer
    assert link.uses_multicast
    assert not link.authenticated
    assert not link.loopback_only


def test_zenoh_endpoint_makes_a_client(monkeypatch):
    monkeypatch.setenv("ZENOH_CONNECT", "tcp/10.0.0.1:7447, tls/10.0.0.2:7447")
    link = link_from_environment()
    assert not link.is_peer
    assert link.connect == ("tcp/10.0.0.1:7447", "tls/10.0.0.2:7447")
    assert link.zenoh()["mode"] == "client"
    assert link.zenoh()["listen"]["endpoints"] == []


def test_nats_url_makes_a_nats_link_without_naming_the_backend(monkeypatch):
    monkeypatch.setenv("NATS_URL", "nats://10.0.0.1:4222")
    assert link_from_environment().transport == "nats"


def test_listen_endpoint_makes_a_peer_that_listens_there(monkeypatch):
    monkeypatch.setenv("ZENOH_LISTEN", "tcp/127.0.0.1:7000")
    link = link_from_environment()
    assert link.is_peer
    assert link.listeners == ("tcp/127.0.0.1:7000",)


def test_unknown_backend_is_refused_by_name(monkeypatch):
    monkeypatch.setenv("MESSAGING_BACKEND", "mqtt")
    with pytest.raises(ValidationError, match="mqtt"):
        link_from_environment()


def test_credentials_file_configures_the_whole_link(monkeypatch, tmp_path):
    file = tmp_path / "a.creds.json"
    section = {"urls": ["tls/10.0.0.1:7447"], "tls": {"ca_pem": "-----BEGIN X", "cert_pem": "c", "key_pem": "k"}}
    file.write_text(json.dumps({"device_id": "a", "tenant": "lab", "zenoh": section}))
    monkeypatch.setenv("MESSAGING_CREDENTIALS_FILE", str(file))
    link = link_from_environment()
    assert (link.tenant, link.connect, link.cert) == ("lab", ("tls/10.0.0.1:7447",), "c")
    assert link.authenticated


def test_nats_creds_file_is_read(monkeypatch, tmp_path):
    file = tmp_path / "a.creds"
    file.write_text(
        "-----BEGIN NATS USER JWT-----\neyJ0\n------END NATS USER JWT------\n\n*** keep it secret ***\n"
        "-----BEGIN USER NKEY SEED-----\nSUAC\n------END USER NKEY SEED------\n"
    )
    monkeypatch.setenv("NATS_CREDENTIALS_FILE", str(file))
    monkeypatch.setenv("NATS_URL", "nats://10.0.0.1:4222")
    link = link_from_environment()
    assert (link.jwt, link.nkey_seed) == ("eyJ0", "SUAC")


def test_missing_credentials_file_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("MESSAGING_CREDENTIALS_FILE", str(tmp_path / "none.json"))
    with pytest.raises(ValidationError, match=r"none\.json"):
        link_from_environment()


@pytest.mark.parametrize("content", [b"# a page of prose", b"\xff\xfe\x00", b"[]", b'{"nats": 3}'])
def test_file_that_holds_no_credentials_is_named(monkeypatch, tmp_path, content):
    file = tmp_path / "page.md"
    file.write_bytes(content)
    monkeypatch.setenv("MESSAGING_CREDENTIALS_FILE", str(file))
    with pytest.raises(ValidationError, match=r"page\.md"):
        link_from_environment()


@pytest.mark.parametrize("tenant", ["*", "**", "a.b", "a b", ""])
def test_tenant_with_a_wildcard_is_refused(tenant):
    with pytest.raises(ValidationError, match="tenant must be"):
        LinkConfig(tenant=tenant)


def test_loopback_link_stays_on_this_machine(monkeypatch):
    monkeypatch.setenv("STRANDS_DC_PORT", "7555")
    link = loopback_config()
    assert link.loopback_only
    assert link.meeting_point == "tcp/127.0.0.1:7555"
    assert link.zenoh(meet=True)["listen"]["endpoints"] == ["tcp/127.0.0.1:0", "tcp/127.0.0.1:7555"]
    assert link.zenoh()["connect"]["endpoints"] == ["tcp/127.0.0.1:7555"]
    assert not link.zenoh()["scouting"]["multicast"]["enabled"]


def test_peer_with_certificates_uses_tls_only():
    link = LinkConfig(mode="peer", ca="ca.pem", cert="c.pem", key="k.pem", listen=("tls/0.0.0.0:7447",))
    assert link.zenoh()["transport"]["link"]["protocols"] == ["tls"]
    assert link.zenoh()["transport"]["link"]["tls"]["enable_mtls"]
    assert not link.loopback_only


@pytest.mark.parametrize(
    "fields",
    [
        {"transport": "mqtt"},
        {"mode": "router"},
        {"meet_port": 0},
        {"meet_port": True},
        {"cert": "c.pem", "ca": "ca.pem"},
        {"cert": "c.pem", "key": "k.pem"},
        {"jwt": "x"},
    ],
)
def test_link_that_cannot_work_is_refused(fields):
    with pytest.raises(ValidationError):
        LinkConfig(**fields)


def test_nats_link_is_authenticated_by_tls_and_credentials_together():
    assert not LinkConfig("nats", connect=("nats://h:4222",)).authenticated
    assert not LinkConfig("nats", connect=("nats://user:word@h:4222",)).authenticated
    assert not LinkConfig("nats", jwt="x", nkey_seed="y").authenticated
    assert not LinkConfig("nats", connect=("tls://h:4222",)).authenticated
    assert not LinkConfig("nats", connect=("tls://user:word@h:4222", "tls://other:4222")).authenticated
    assert LinkConfig("nats", connect=("tls://user:word@h:4222",)).authenticated
    assert LinkConfig("nats", connect=("nats://user:word@h:4222",), ca="ca.pem").authenticated
    assert LinkConfig("nats", connect=("wss://h:443",), jwt="x", nkey_seed="y").authenticated
    assert LinkConfig("nats", ca="ca.pem", cert="c.pem", key="k.pem").authenticated


def test_name_of_a_server_is_checked_from_the_environment_too(monkeypatch):
    monkeypatch.setenv("NATS_URL", "tls://h:4222")
    assert link_from_environment().verify_hostname


def test_repr_hides_secrets():
    link = LinkConfig(ca="ca", cert="c", key="SECRET-KEY", jwt="SECRET-JWT", nkey_seed="SECRET-SEED")
    assert "SECRET" not in repr(link)
    assert "SECRET" not in link.fingerprint


def test_endpoints_accepts_all_spellings_of_the_framework():
    spelled = ["zenoh://", "zenoh://h:1", "zenoh+tls://h", "tcp/h:2", "h:3", "tls/h:4"]
    assert endpoints(spelled) == ("tcp/h:1", "tls/h:7447", "tcp/h:2", "tcp/h:3", "tls/h:4")


@pytest.mark.parametrize(
    "endpoint",
    [
        *("tcp/127.0.0.1:7447", "tls/robot.local:7447", "tcp/[::1]:0", "quic/host:1", "udp/10.0.0.1:65535"),
        *(
            "tcp/127.0.0.1:7447#iface=lo",
            "tcp/0.0.0.0:7447?prio=1",
            "unixsock-stream//tmp/zenoh.sock",
            "serial//dev/tty0",
        ),
    ],
)
def test_zenoh_endpoint_is_accepted(endpoint: str) -> None:
    assert LinkConfig(listen=(endpoint,)).listen == (endpoint,)


@pytest.mark.parametrize(
    "endpoint",
    [
        *("tcp/999.0.0.1:1", "tcp/1.2.3:1", "tcp/host", "tcp/host:", "tcp/host:x", "tcp/host:65536", "tcp/:7447"),
        *("nonsense", "", "tcp/a b:1", "tcp/host:-1", "tcp/host:²"),
    ],
)
def test_malformed_zenoh_endpoint_is_refused_by_name(endpoint: str) -> None:
    with pytest.raises(ValidationError, match="listen must be like tcp/host:port"):
        LinkConfig(listen=(endpoint,))
    with pytest.raises(ValidationError, match="connect must be like tcp/host:port"):
        LinkConfig(connect=(endpoint,))


@pytest.mark.parametrize("url", ["nats://127.0.0.1:4222", "tls://broker", "broker", "nats://user:word@broker:1"])
def test_nats_url_is_accepted(url: str) -> None:
    assert LinkConfig(transport="nats", connect=(url,)).connect == (url,)


@pytest.mark.parametrize("url", ["http://broker", "nats://", "nats://broker:x", "nats://b:70000", "nats://1.2.3:1", ""])
def test_malformed_nats_url_is_refused_by_name(url: str) -> None:
    with pytest.raises(ValidationError, match="connect must be like nats://host:port"):
        LinkConfig(transport="nats", connect=(url,))


def test_refusal_hides_the_password() -> None:
    with pytest.raises(ValidationError) as refused:
        LinkConfig(transport="nats", connect=("nats://user:secret@broker:x",))
    assert "secret" not in str(refused.value)


@pytest.mark.parametrize(
    ("endpoint", "host"),
    [("tcp/[::1]:7", "::1"), ("nats://user:word@127.0.0.1:4222", "127.0.0.1"), ("tls/robot.local:7447", "robot.local")],
)
def test_host_of_reads_all_spellings(endpoint: str, host: str) -> None:
    assert host_of(endpoint) == host
