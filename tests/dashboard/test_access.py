"""Who may open the page: Host, Origin, tokens, roles."""

from __future__ import annotations

import pytest
import segno

from strands_robots.dashboard.access import (
    OPERATOR,
    VIEWER,
    Access,
    is_local,
    loopback_origins,
    qr_code,
    remote_address,
)
from strands_robots.utils import ValidationError

HERE = loopback_origins(8800)
PAGE = {"host": "127.0.0.1:8800", "origin": "http://127.0.0.1:8800"}


@pytest.mark.parametrize("host", ["127.0.0.1:8800", "localhost:8800", "[::1]:8800", "LOCALHOST:8800"])
def test_page_answers_at_every_name_of_loopback(host: str) -> None:
    assert Access(HERE).refusal({"host": host}, websocket=False) == ""


@pytest.mark.parametrize(
    "host", ["", "evil.example", "evil.example:8800", "127.0.0.1:8801", "127.0.0.1.evil.example:8800"]
)
def test_other_host_is_refused_so_that_a_rebound_name_reaches_nothing(host: str) -> None:
    assert "Host" in Access(HERE).refusal({**PAGE, "host": host}, websocket=False)


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "https://127.0.0.1:8800", "http://127.0.0.1:9000", "http://localhost:8800"],
)
def test_other_origin_is_refused(origin: str) -> None:
    for websocket in (True, False):
        assert "Origin" in Access(HERE).refusal({**PAGE, "origin": origin}, websocket=websocket)


def test_websocket_without_origin_is_refused() -> None:
    assert "Origin" in Access(HERE).refusal({"host": PAGE["host"]}, websocket=True)


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_request_that_another_site_caused_is_refused(site: str) -> None:
    assert "Another site" in Access(HERE).refusal({"host": PAGE["host"], "sec-fetch-site": site}, websocket=False)


def test_token_gives_its_role_and_no_other_token_gives_one() -> None:
    access = Access(HERE, {"secret-1": OPERATOR, "secret-2": VIEWER})
    assert access.role("secret-1", local=False) == OPERATOR
    assert access.role("secret-2", local=False) == VIEWER
    for wrong in ("", "secret", None, 7, "sécret", "\ud800", ["secret-1"]):
        assert access.role(wrong, local=False) is None
    assert access.role("wrong", local=True) is None


def test_loopback_needs_no_token_and_may_be_a_viewer() -> None:
    assert Access(HERE).role(None, local=True) == OPERATOR
    assert Access(HERE, {}, VIEWER).role(None, local=True) == VIEWER


@pytest.mark.parametrize(
    ("client", "local"),
    [(("127.0.0.1", 1), True), (("::1", 1), True), (("10.0.0.7", 1), False), (None, False), (("", 0), False)],
)
def test_local_is_an_address_of_loopback(client: object, local: bool) -> None:
    assert is_local(client) is local


@pytest.mark.parametrize("address", ["127.0.0.1", "localhost", "LOCALHOST"])
def test_loopback_is_refused_as_a_second_address_of_the_page(address: str) -> None:
    with pytest.raises(ValidationError, match=r"--listen must be an address besides .* served anyway"):
        remote_address(address, 8800)


def test_qr_code_on_a_dark_terminal_has_the_modules_of_the_address() -> None:
    url = "https://192.0.2.10:8800/#token=" + "x" * 32
    light = {"█": (True, True), "▀": (True, False), "▄": (False, True), " ": (False, False)}
    rows: list[list[bool]] = []
    for line in qr_code(url).splitlines():
        pairs = [light[each] for each in line]
        rows += [[not upper for upper, _ in pairs], [not lower for _, lower in pairs]]
    rows.pop()  # the last line has the one row that is left of an odd number
    modules = [[bool(each) for each in row] for row in segno.make(url, error="l").matrix]
    assert [row[2:-2] for row in rows[2 : 2 + len(modules)]] == modules
    assert not any(rows[0] + rows[-1]), "it has a light border"
    assert not any(row[0] or row[1] or row[-1] for row in rows), "at its sides, too"
