"""A yes of a user moves what the user was asked about, whoever else may command the robot."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.approval_attack import EVIL, GOOD, Spammer, approve, certified_mesh, grant_beside_spam, started
from fixtures.mcp_site import McpSite

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

YESES = 16


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[McpSite]:
    state = tmp_path_factory.mktemp("state")
    state.chmod(0o700)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STRANDS_STATE_DIR", os.fspath(state))
        patch.setenv("DEVICE_CONNECT_RPC_ALLOW", "mcp,second")
        made = McpSite(Path(state), simulated=False)
        yield made
        made.close()


@pytest.fixture(autouse=True)
def still(site: McpSite, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("STRANDS_STATE_DIR", os.fspath(site.state))
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "mcp,second")
    site.metal.answers.clear()
    yield
    site.still()


# The long variants run with `make test-all`.
@pytest.mark.parametrize("source", ["mcp", *(pytest.param("second", marks=pytest.mark.system) for _ in range(2))])
async def test_a_yes_to_one_motion_starts_no_other_and_is_not_kept_from_starting_it(site: McpSite, source: str) -> None:
    with Spammer(site.port, "metal-1", source) as spammer:
        spammer.begin()
        good, refused = await approve(site, YESES)
        told = spammer.end()
    assert (started(site, EVIL), started(site, GOOD)) == (0, YESES), (told, refused)
    assert good == YESES, refused
    assert told.total() > YESES, "the second caller was not there"
    assert not list((site.state / "grants").glob("*"))


def test_a_grant_for_a_certified_sender_moves_nothing_of_another(tmp_path: Path) -> None:
    with certified_mesh(tmp_path) as peers:
        for again in (1, 2):
            began, evil = grant_beside_spam(peers, tmp_path / "arm-1", YESES)
            assert began == [f"{GOOD} {number}" for _ in range(again) for number in range(YESES)]
            assert evil > YESES
