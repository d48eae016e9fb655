"""Exact requests, and every error of the daemon as an error of its own kind."""

from __future__ import annotations

import socket
from typing import Any

import httpx
import pytest
import respx
from fixtures.reachy_daemon.body import recorded

from strands_robots.drivers.reachy.rest import (
    BackendDown,
    DaemonBusy,
    DaemonError,
    DaemonFault,
    DaemonRefused,
    DaemonUnknown,
    DaemonUnreachable,
    RestClient,
    api,
    dialled,
)
from strands_robots.utils import ValidationError

HERE = "http://127.0.0.1:8000"
RECORDED = [each for each in recorded("daemon_1.13.0_lite.json")["rest"] if each["status"] >= 400]
KINDS = {
    400: DaemonRefused,
    403: DaemonRefused,
    404: DaemonUnknown,
    405: DaemonRefused,
    409: DaemonBusy,
    422: DaemonRefused,
    500: DaemonFault,
    503: BackendDown,
}


@respx.mock
def test_a_post_is_json_without_an_origin_to_the_hosts_address() -> None:
    route = respx.post(f"{HERE}/api/move/stop").mock(return_value=httpx.Response(200, json={"message": "ok"}))
    assert RestClient("127.0.0.1").post("/api/move/stop", {"uuid": "u"}) == {"message": "ok"}
    request = route.calls.last.request
    assert request.content == b'{"uuid":"u"}'
    assert request.headers["content-type"] == "application/json"
    assert request.headers["host"] == "127.0.0.1:8000"
    assert "origin" not in request.headers


@respx.mock
@pytest.mark.parametrize("told", RECORDED, ids=lambda each: f"{each['status']}-{each['path'][:40]}")
def test_a_recorded_error_is_of_its_kind_and_keeps_the_daemons_words(told: dict[str, Any]) -> None:
    answer = httpx.Response(told["status"], text=told["body"], headers={"content-type": told["content_type"]})
    respx.route().mock(return_value=answer)
    with pytest.raises(KINDS[told["status"]]) as error:
        RestClient("127.0.0.1").request(told.get("method", "GET"), told["path"].partition("?")[0])
    assert error.value.status == told["status"]


@respx.mock
@pytest.mark.parametrize("status", [403, 405, 409, 418, 502])
def test_every_other_refusal_is_an_error_too(status: int) -> None:
    respx.route().mock(return_value=httpx.Response(status, json={"detail": "Daemon is busy."}))
    with pytest.raises(KINDS.get(status, DaemonFault), match="Daemon is busy"):
        RestClient("127.0.0.1").get("/x")


@respx.mock
@pytest.mark.parametrize(
    "fault", [httpx.ConnectError("refused"), httpx.ReadTimeout("late"), httpx.RemoteProtocolError("cut"), OSError("x")]
)
def test_a_lost_connection_is_unreachable_and_the_next_request_opens_a_new_one(fault: Exception) -> None:
    respx.get(f"{HERE}/x").mock(side_effect=[fault, httpx.Response(200, json=[])])
    client = RestClient("127.0.0.1")
    with pytest.raises(DaemonUnreachable, match="did not answer GET /x"):
        client.get("/x")
    assert client.get("/x") == []


@respx.mock
def test_a_body_that_is_no_json_is_a_fault() -> None:
    respx.get(f"{HERE}/x").mock(return_value=httpx.Response(200, text="<html>"))
    with pytest.raises(DaemonFault, match="not JSON"):
        RestClient("127.0.0.1").get("/x")


@pytest.mark.parametrize("host", ["127.0.0.1/foo", "", "a b", "http://x", "x:80", None, "robot@evil"])
def test_a_host_that_is_no_host_is_refused(host: Any) -> None:
    with pytest.raises(ValidationError, match="host"):
        RestClient(host)


@pytest.mark.parametrize("port", [0, 65536, True, "8000", 80.0, None])
def test_a_port_that_is_no_port_is_refused(port: Any) -> None:
    with pytest.raises(ValidationError, match="api_port"):
        RestClient("localhost", port)


def test_a_plain_name_is_dialled_by_its_address_so_that_the_daemon_trusts_it(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", ("192.0.2.7", 0))]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *a, **k: found)
    assert dialled("reachy.lab.example.org") == "192.0.2.7"
    assert dialled("reachy-mini.local") == "reachy-mini.local"
    assert dialled("localhost") == "localhost"
    assert dialled("[::1]") == "[::1]"


def test_a_name_without_an_address_is_unreachable(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*args: Any, **options: Any) -> None:
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(DaemonUnreachable, match="no address"):
        dialled("nowhere.example.org")


@respx.mock
def test_api_answers_and_never_raises() -> None:
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


def test_every_kind_is_a_daemon_error() -> None:
    assert all(issubclass(kind, DaemonError) for kind in (*KINDS.values(), DaemonUnreachable))
