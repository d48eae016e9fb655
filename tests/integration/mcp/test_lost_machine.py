"""Connections over HTTP of a client whose machine vanished without a word."""

from __future__ import annotations

import socket

import pytest

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

from strands_robots.mcp.connections import KEEPALIVE, listener

GONE_S = 5


def test_connections_of_the_server_end_five_seconds_after_the_last_sign_of_a_machine() -> None:
    with listener("127.0.0.1", 0) as listening:
        with socket.create_connection(listening.getsockname()), listening.accept()[0] as accepted:
            assert accepted.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
            kept = {
                name: accepted.getsockopt(socket.IPPROTO_TCP, getattr(socket, name))
                for name in KEEPALIVE
                if hasattr(socket, name)
            }
    assert kept == {name: KEEPALIVE[name] for name in kept}
    assert kept["TCP_KEEPIDLE"] + kept["TCP_KEEPCNT"] * kept["TCP_KEEPINTVL"] == GONE_S
    assert kept["TCP_USER_TIMEOUT"] == GONE_S * 1000


def test_answers_of_the_server_do_not_wait_for_more() -> None:
    with listener("127.0.0.1", 0) as listening:
        with socket.create_connection(listening.getsockname()), listening.accept()[0] as accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == 1


def test_server_listens_on_the_sixth_version_of_the_address() -> None:
    try:
        listening = listener("::1", 0)
    except OSError:
        pytest.skip("this machine has no ::1")
    with listening:
        assert listening.family == socket.AF_INET6
