"""Endpoints that could never be reached are refused before anything is dialled."""

from __future__ import annotations

import pytest

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.backends.config import host_of
from strands_robots.utils import ValidationError


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
def test_an_endpoint_of_zenoh_is_accepted(endpoint: str) -> None:
    assert LinkConfig(listen=(endpoint,)).listen == (endpoint,)


@pytest.mark.parametrize(
    "endpoint",
    [
        *("tcp/999.0.0.1:1", "tcp/1.2.3:1", "tcp/host", "tcp/host:", "tcp/host:x", "tcp/host:65536", "tcp/:7447"),
        *("nonsense", "", "tcp/a b:1", "tcp/host:-1", "tcp/host:²"),
    ],
)
def test_an_endpoint_that_is_none_is_refused_by_name(endpoint: str) -> None:
    with pytest.raises(ValidationError, match="listen must be like tcp/host:port"):
        LinkConfig(listen=(endpoint,))
    with pytest.raises(ValidationError, match="connect must be like tcp/host:port"):
        LinkConfig(connect=(endpoint,))


@pytest.mark.parametrize("url", ["nats://127.0.0.1:4222", "tls://broker", "broker", "nats://user:word@broker:1"])
def test_a_server_of_nats_is_accepted(url: str) -> None:
    assert LinkConfig(transport="nats", connect=(url,)).connect == (url,)


@pytest.mark.parametrize("url", ["http://broker", "nats://", "nats://broker:x", "nats://b:70000", "nats://1.2.3:1", ""])
def test_a_server_that_is_none_is_refused_by_name(url: str) -> None:
    with pytest.raises(ValidationError, match="connect must be like nats://host:port"):
        LinkConfig(transport="nats", connect=(url,))


def test_a_refusal_does_not_show_a_password() -> None:
    with pytest.raises(ValidationError) as refused:
        LinkConfig(transport="nats", connect=("nats://user:secret@broker:x",))
    assert "secret" not in str(refused.value)


@pytest.mark.parametrize(
    ("endpoint", "host"),
    [("tcp/[::1]:7", "::1"), ("nats://user:word@127.0.0.1:4222", "127.0.0.1"), ("tls/robot.local:7447", "robot.local")],
)
def test_the_host_is_found_in_every_spelling(endpoint: str, host: str) -> None:
    assert host_of(endpoint) == host
