"""Zenoh sessions of every network: loaded late, TLS alone, and sockets that are closed without waiting."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.waiting import eventually

from strands_robots import zenoh_session
from strands_robots.zenoh_session import (
    LEASE_MS,
    LINGER,
    TRY_MS,
    change_links,
    close_in_background,
    for_stops,
    transport_config,
    use_tls,
)


@pytest.fixture
def open_sockets() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def made(stack: ExitStack, on: int, seconds: int) -> socket.socket:
    each = stack.enter_context(socket.socket())
    each.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.pack(on, seconds))
    return each


def linger(each: socket.socket) -> tuple[int, int]:
    on, seconds = LINGER.unpack(each.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER.size))
    return on, seconds


def test_a_link_with_zenohs_linger_is_closed_in_the_background(open_sockets: ExitStack) -> None:
    link = made(open_sockets, 1, 10)
    assert change_links() >= 1
    assert linger(link)[0] == 0
    assert link.fileno() >= 0


@pytest.mark.parametrize(("on", "seconds"), [(0, 10), (1, 0), (1, 5), (1, 30)])
def test_a_socket_with_a_linger_of_its_own_keeps_it(open_sockets: ExitStack, on: int, seconds: int) -> None:
    own = made(open_sockets, on, seconds)
    before = linger(own)
    change_links()
    assert linger(own) == before


def test_search_leaves_sockets_blocking_where_the_process_has_a_default_timeout(open_sockets: ExitStack) -> None:
    link, other = made(open_sockets, 1, 10), made(open_sockets, 0, 0)
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(5.0)
    try:
        change_links()
    finally:
        socket.setdefaulttimeout(before)
    assert os.get_blocking(link.fileno()) and os.get_blocking(other.fileno())


def test_links_that_come_up_together_cost_one_search_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    searches = list[int]()
    monkeypatch.setattr(zenoh_session, "GATHER_S", 0.5)
    monkeypatch.setattr(zenoh_session, "change_links", lambda: searches.append(threading.get_ident()))
    for _ in range(100):
        close_in_background()
    assert searches == []
    eventually(lambda: searches)
    assert len(searches) == 1 and searches[0] != threading.get_ident()
    close_in_background()
    eventually(lambda: len(searches) == 2)


def test_a_system_without_a_folder_of_descriptors_changes_nothing(
    open_sockets: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = made(open_sockets, 1, 10)
    monkeypatch.setattr(zenoh_session, "DESCRIPTORS", Path("/nowhere"))
    assert change_links() == 0
    assert linger(link) == (1, 10)


def test_search_that_got_no_thread_is_tried_again_at_the_next_link(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> int:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(zenoh_session._thread, "start_new_thread", refuse)
        zenoh_session.close_in_background()
    searched = threading.Event()
    monkeypatch.setattr(zenoh_session, "change_links", searched.set)
    zenoh_session.close_in_background()
    assert searched.wait(20)


def test_import_needs_no_zenoh() -> None:
    program = "import sys; sys.modules['zenoh'] = None; import strands_robots.zenoh_session"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


@pytest.mark.parametrize(("mode", "tries"), [("client", {"timeout_ms": TRY_MS}), ("peer", {})])
def test_session_of_stops_has_queues_of_its_own_and_a_bounded_lease(mode: str, tries: dict[str, int]) -> None:
    config = for_stops({"mode": mode, "connect": {}, "transport": transport_config(("data",), 500)})
    link = config["transport"]["link"]["tx"]
    assert link["lease"] == LEASE_MS
    assert link["queue"] == {"size": {"real_time": 16, "interactive_high": 16}}
    assert {key: config["connect"][key] for key in config["connect"] if key != "retry"} == tries


def test_certificates_leave_tls_alone() -> None:
    config = {"transport": transport_config(("data",), 500)}
    tls = use_tls(config, ca="/ca.pem", cert="-----BEGIN CERTIFICATE-----", key="/key.pem")
    assert config["transport"]["link"]["protocols"] == ["tls"]
    assert tls["enable_mtls"] is True
    assert tls["root_ca_certificate"] == "/ca.pem"
    assert "connect_certificate" not in tls and tls["connect_certificate_base64"]
