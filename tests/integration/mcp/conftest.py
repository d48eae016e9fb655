"""Robots that the tests of a file share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.mcp_site import McpSite
from fixtures.waiting import free_port

from strands_robots.fleet.adapter import DEVICE_CONNECT


@pytest.fixture(scope="module")
def site(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[McpSite]:
    """Serve robots whose state is in a directory of their own; any caller may move them once approved.

    They are on Device Connect, or on the network that is the fixture's parameter.
    """
    state = tmp_path_factory.mktemp("state")
    state.chmod(0o700)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STRANDS_STATE_DIR", os.fspath(state))
        patch.setenv("DEVICE_CONNECT_RPC_ALLOW", "mcp,desk,first,second,gone")
        patch.setenv("STRANDS_MESH_PORT", str(free_port()))
        made = McpSite(Path(state), network=getattr(request, "param", DEVICE_CONNECT))
        yield made
        made.close()


@pytest.fixture(autouse=True)
def same_state(site: McpSite, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have robots read the state that the servers write, in each test."""
    monkeypatch.setenv("STRANDS_STATE_DIR", os.fspath(site.state))
