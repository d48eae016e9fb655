"""Requests to the daemon, and an error class for each kind of its errors."""

from __future__ import annotations

import socket
from typing import Any

import httpx
import pytest
import respx
from fixtures.reachy_daemon.body import recorded

from strands_robots.drivers.reachy.rest import (
    BackendDownError,
    DaemonAccess,
    DaemonBusyError,
    DaemonError,
    DaemonFaultError,
    DaemonNotFoundError,
    DaemonRefusedError,
    DaemonUnreachableError,
    RestClient,
    api,
    url_host,
    warn_once,
)
from strands_robots.utils import ValidationError

LONG = b"[" + b"0," * 1_000_000 + b"0]"
HERE = "http://127.0.0.1:8000"
RECORDED = [each for each in recorded("daemon_1.13.0_lite.json")["rest"] if each["status"] >= 400]
KINDS = {
    400: DaemonRefusedError,
    401: DaemonRefusedError,
    403: DaemonRefusedError,
    404: DaemonNotFoundError,
    405: DaemonRefusedError,
    409: DaemonBusyError,
    422: DaemonRefusedError,
    500: DaemonFaultError,
    503: BackendDownError,
}


@respx.mock
def test_post_is_json_without_an_origin_to_the_hosts_address() -> None:
    route = respx.post(f"{HERE}/api/move/stop").mock(return_value=httpx.Response(200, json={"message": "ok"}))
    assert RestClient("127.0.0.1").post("/api/move/stop", {"uuid": "u"}) == {"message": "ok"}
    request = route.calls.last.request
    assert request.content == b'{"uuid":"u"}'
    assert request.headers["content-type"] == "application/json"
    assert request.headers["host"] == "127.0.0.1:8000"
    assert "origin" not in request.headers


@respx.mock
@pytest.mark.parametrize("exchange", RECORDED, ids=lambda each: f"{each['status']}-{each['path'][:40]}")
def test_recorded_error_raises_its_kind_with_the_status(exchange: dict[str, Any]) -> None:
    answer = httpx.Response(
        exchange["status"],
        text=exchange["body"],
        headers={"content-type": exchange["content_type"]},
    )
    respx.route().mock(return_value=answer)
    with pytest.raises(KINDS[exchange["status"]]) as error:
        RestClient("127.0.0.1").request(exchange.get("method", "GET"), exchange["path"].partition("?")[0])
    assert error.value.status == exchange["status"]


@respx.mock
@pytest.mark.parametrize("status", [401, 403, 405, 409, 418, 502])
def test_other_error_statuses_raise_with_the_daemons_message(status: int) -> None:
    respx.route().mock(return_value=httpx.Response(status, json={"detail": "Daemon is busy."}))
    with pytest.raises(KINDS.get(status, DaemonFaultError), match="Daemon is busy"):
        RestClient("127.0.0.1").get("/x")


@respx.mock
@pytest.mark.parametrize(
    "fault", [httpx.ConnectError("refused"), httpx.ReadTimeout("late"), httpx.RemoteProtocolError("cut"), OSError("x")]
)
def test_lost_connection_is_unreachable_and_the_next_request_reconnects(fault: Exception) -> None:
    respx.get(f"{HERE}/x").mock(side_effect=[fault, httpx.Response(200, json=[])])
    client = RestClient("127.0.0.1")
    with pytest.raises(DaemonUnreachableError, match="did not answer GET /x"):
        client.get("/x")
    assert client.get("/x") == []


@respx.mock
def test_body_that_is_no_json_is_a_fault() -> None:
    respx.get(f"{HERE}/x").mock(return_value=httpx.Response(200, text="<html>"))
    with pytest.raises(DaemonFaultError, match="not JSON"):
        RestClient("127.0.0.1").get("/x")


@respx.mock
def test_body_beyond_the_bound_is_not_read() -> None:
    respx.get(f"{HERE}/x").mock(return_value=httpx.Response(200, content=b"[" + b"1," * 100 + b"1]"))
    with pytest.raises(DaemonFaultError, match="longer than 100 bytes"):
        RestClient("127.0.0.1", longest=100).get("/x")


@pytest.mark.parametrize("host", ["127.0.0.1/foo", "", "a b", "http://x", "x:80", None, "robot@evil"])
def test_invalid_host_is_refused(host: Any) -> None:
    with pytest.raises(ValidationError, match="host"):
        RestClient(host)


@pytest.mark.parametrize("port", [0, 65536, True, "8000", 80.0, None])
def test_invalid_port_is_refused(port: Any) -> None:
    with pytest.raises(ValidationError, match="api_port"):
        RestClient("localhost", port)


def test_plain_name_is_dialled_by_the_address_that_the_daemon_accepts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    addresses = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("192.0.2.7", 0))]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *a, **k: addresses)
    assert url_host("reachy.lab.example.org") == "192.0.2.7"
    assert url_host("reachy-mini.local") == "reachy-mini.local"
    assert url_host("localhost") == "localhost"
    assert url_host("[::1]") == "[::1]"


def test_name_without_an_address_is_unreachable(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*args: Any, **options: Any) -> None:
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(DaemonUnreachableError, match="no address"):
        url_host("nowhere.example.org")


@respx.mock
def test_api_returns_errors_and_never_raises() -> None:
    respx.get(f"{HERE}/x").mock(return_value=httpx.Response(200, json={"a": 1}))
    respx.get(f"{HERE}/down").mock(return_value=httpx.Response(503, json={"detail": "Backend not running"}))
    respx.get(f"{HERE}/gone").mock(side_effect=httpx.ConnectError("refused"))
    assert api("127.0.0.1", 8000, "/x") == {"a": 1}
    assert api("127.0.0.1", 8000, "/down")["status_code"] == 503
    assert api("127.0.0.1", 8000, "/gone")["status_code"] == 0
    for bad in (
        ("a/b", 8000, "/x"),
        ("localhost", 0, "/x"),
        ("localhost", 8000, "x"),
        ("localhost", 8000, "/x", "HUG"),
    ):
        assert "error" in api(*bad)


def test_every_error_kind_is_a_daemon_error() -> None:
    assert all(issubclass(kind, DaemonError) for kind in (*KINDS.values(), DaemonUnreachableError))


@respx.mock
@pytest.mark.parametrize(
    ("size", "why"), [(len(LONG), "longer than 524288 bytes"), (200_000, "more than 20000 values")]
)
def test_answer_out_of_bounds_is_a_fault_and_not_parsed(size: int, why: str) -> None:
    respx.get(f"{HERE}/x").mock(return_value=httpx.Response(200, content=LONG[:size]))
    with pytest.raises(DaemonFaultError, match=why):
        RestClient("127.0.0.1").get("/x")


@respx.mock
def test_token_is_a_bearer_header_and_tls_another_scheme(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REACHY_DAEMON_TOKEN", "secret")
    plain = respx.get(f"{HERE}/x").mock(return_value=httpx.Response(200, json=[]))
    RestClient("127.0.0.1").get("/x")
    assert plain.calls.last.request.headers["authorization"] == "Bearer secret"
    monkeypatch.setenv("REACHY_DAEMON_TLS", "on")
    encrypted = respx.get("https://head.example:8000/x").mock(return_value=httpx.Response(200, json=[]))
    RestClient("head.example").get("/x")
    assert encrypted.calls.last.request.headers["authorization"] == "Bearer secret"
    monkeypatch.delenv("REACHY_DAEMON_TOKEN")
    RestClient("head.example").get("/x")
    assert "authorization" not in encrypted.calls.last.request.headers


def test_token_in_the_clear_warns_once_except_on_loopback(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    warn_once.cache_clear()
    monkeypatch.setenv("REACHY_DAEMON_TOKEN", "secret")
    for host in ("127.0.0.1", "localhost", "[::1]"):
        RestClient(host)
    assert not caplog.records
    for _ in range(2):
        RestClient("192.168.7.7")
    assert [each.getMessage() for each in caplog.records] == [
        "REACHY_DAEMON_TOKEN is sent to 192.168.7.7 unencrypted, where others can read it; set REACHY_DAEMON_TLS."
    ]
    monkeypatch.setenv("REACHY_DAEMON_TLS", "1")
    RestClient("192.168.7.8")
    assert len(caplog.records) == 1


def test_token_that_no_header_can_carry_is_refused_without_being_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REACHY_DAEMON_TOKEN", "geheim-ü")
    with pytest.raises(ValidationError, match="REACHY_DAEMON_TOKEN") as refused:
        RestClient("127.0.0.1")
    assert "geheim" not in str(refused.value)
    assert "REACHY_DAEMON_TOKEN" in api("127.0.0.1", 8000, "/x")["error"]


def test_misspelt_switch_encrypts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REACHY_DAEMON_TLS", "ture")
    assert DaemonAccess.stated("127.0.0.1").tls
    monkeypatch.setenv("REACHY_DAEMON_TLS_INSECURE", "ture")
    assert not DaemonAccess.stated("127.0.0.1").insecure
