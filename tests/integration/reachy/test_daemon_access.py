"""A daemon behind a gateway: TLS with a certificate made on the fly, and a bearer token, on both of its interfaces."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.certificates import Authority
from fixtures.reachy_daemon.process import Daemon, Kind
from fixtures.waiting import eventually

from strands_robots.drivers.reachy import ReachyDriver, make_reachy
from strands_robots.drivers.reachy.links import WebSocketLink
from strands_robots.drivers.reachy.rest import DaemonRefusedError, DaemonUnreachableError, RestClient, tls_context

pytestmark = pytest.mark.timeout(120)

TOKEN = "a-token-of-the-lab"


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("gateway"))


@pytest.fixture(scope="module")
def gateway(authority: Authority) -> Iterator[Daemon]:
    with Daemon(Kind("1.13.0"), authority.issue("reachy"), TOKEN) as daemon:
        yield daemon


@pytest.fixture
def trusted(authority: Authority, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The authority of the gateway among those of this machine."""
    yield from _with_authorities(authority.ca, monkeypatch)


@pytest.fixture
def stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Another authority among those of this machine, and not that of the gateway."""
    yield from _with_authorities(Authority(tmp_path, "stranger").ca, monkeypatch)


def _with_authorities(file: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("SSL_CERT_FILE", str(file))
    tls_context.cache_clear()
    yield
    tls_context.cache_clear()


def state(monkeypatch: pytest.MonkeyPatch, **stated: str) -> None:
    for name, value in stated.items():
        monkeypatch.setenv(name, value)


def test_robot_moves_and_stops_over_tls_with_the_token(
    gateway: Daemon, trusted: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    state(monkeypatch, REACHY_DAEMON_TLS="1", REACHY_DAEMON_TOKEN=TOKEN)
    reachy = ReachyDriver("127.0.0.1", api_port=gateway.port)
    try:
        reachy.connect(within_s=20)
        assert reachy.connection.link().kind == "websocket"
        reachy.send_action({"antenna_left": 0.4})
        eventually(lambda: any(frame["type"] == "set_antennas" for frame in gateway.frames()))
        assert reachy.halt("test").stopped is True
    finally:
        reachy.disconnect()


def test_host_name_of_the_certificate_is_dialled_as_it_is(
    gateway: Daemon, trusted: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    state(monkeypatch, REACHY_DAEMON_TLS="1", REACHY_DAEMON_TOKEN=TOKEN)
    assert RestClient("localhost", gateway.port).get("/api/daemon/status")["state"] == "running"


def test_missing_or_wrong_token_is_refused_on_both_interfaces(
    gateway: Daemon, trusted: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    state(monkeypatch, REACHY_DAEMON_TLS="1")
    for token in ("", "another"):
        state(monkeypatch, REACHY_DAEMON_TOKEN=token)
        with pytest.raises(DaemonRefusedError, match="401 token required"):
            RestClient("127.0.0.1", gateway.port).get("/api/daemon/status")
        with pytest.raises(DaemonUnreachableError, match="did not open"):
            WebSocketLink("127.0.0.1", gateway.port).open(lambda kind, text: None)


def test_certificate_of_a_stranger_is_refused_unless_the_check_is_off(
    gateway: Daemon, stranger: None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    state(monkeypatch, REACHY_DAEMON_TLS="1", REACHY_DAEMON_TOKEN=TOKEN)
    with pytest.raises(DaemonUnreachableError, match="certificate"):
        RestClient("127.0.0.1", gateway.port).get("/api/daemon/status")
    with pytest.raises(DaemonUnreachableError, match="certificate"):
        WebSocketLink("127.0.0.1", gateway.port).open(lambda kind, text: None)
    state(monkeypatch, REACHY_DAEMON_TLS_INSECURE="1")
    assert RestClient("127.0.0.1", gateway.port).get("/api/daemon/status")["state"] == "running"
    link = WebSocketLink("127.0.0.1", gateway.port)
    link.open(lambda kind, text: None)
    link.close()
    assert "whoever answers at 127.0.0.1 is taken for the daemon" in caplog.text


def test_plain_request_to_a_tls_gateway_is_unreachable(gateway: Daemon) -> None:
    with pytest.raises(DaemonUnreachableError):
        RestClient("127.0.0.1", gateway.port).get("/api/daemon/status")


def test_robot_of_the_environment_is_found_without_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    with Daemon(Kind("1.13.0")) as daemon:
        state(monkeypatch, REACHY_HOST="127.0.0.1", REACHY_PORT=str(daemon.port))
        reachy = make_reachy()
        try:
            reachy.connect(within_s=20)
        finally:
            reachy.disconnect()
