"""Sockets of Zenoh's links are closed without waiting; no other socket is touched."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from strands_robots import zenoh_sockets
from strands_robots.zenoh_sockets import LINGER, close_in_background


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
    assert close_in_background() == 1
    assert linger(link)[0] == 0
    assert link.fileno() >= 0
    assert close_in_background() == 0


@pytest.mark.parametrize(("on", "seconds"), [(0, 10), (1, 0), (1, 5), (1, 30)])
def test_a_socket_with_a_linger_of_its_own_keeps_it(open_sockets: ExitStack, on: int, seconds: int) -> None:
    own = made(open_sockets, on, seconds)
    before = linger(own)
    assert close_in_background() == 0
    assert linger(own) == before


def test_a_system_without_a_folder_of_descriptors_changes_nothing(
    open_sockets: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    made(open_sockets, 1, 10)
    monkeypatch.setattr(zenoh_sockets, "DESCRIPTORS", Path("/nowhere"))
    assert close_in_background() == 0
