"""Attacks on approvals: a second allowed caller that asks for EVIL while GOOD is approved."""

from __future__ import annotations

import asyncio
import os
from contextlib import ExitStack
from unittest.mock import patch

from fixtures.approval_attack import EVIL, GOOD, Spammer, approve, certified_mesh, grant_beside_spam, started
from fixtures.mcp_site import McpSite

from benchmarks.attacks_robots import state_folder
from benchmarks.table import Row

TRIES, TRIES_QUICK = 100, 16
MUST = "0 EVIL, each GOOD"


def rows(quick: bool) -> list[Row]:
    """Measure and give the rows of the table."""
    tries = TRIES_QUICK if quick else TRIES
    return [_yeses(tries, "second", "a second allowed caller"), _yeses(tries, "mcp", "the asker's name"), _mesh(tries)]


def _yeses(tries: int, source: str, who: str) -> Row:
    """Yeses of the user of an MCP client to GOOD."""
    with ExitStack() as stack:
        state = state_folder(stack)
        allowed = {"STRANDS_STATE_DIR": str(state), "DEVICE_CONNECT_RPC_ALLOW": "mcp,second"}
        stack.enter_context(patch.dict(os.environ, allowed))
        site = McpSite(state, simulated=False)
        stack.callback(site.close)
        spammer = stack.enter_context(Spammer(site.port, "metal-1", source))
        spammer.begin()
        good, _ = asyncio.run(approve(site, tries))
        told = spammer.end()
        evil = started(site, EVIL)
    text = f"{evil} EVIL in {told.total()} tries, {good} GOOD"
    return Row(f"MCP: {tries} yeses beside EVIL of {who}", text, "", None, MUST, not evil and good == tries)


def _mesh(tries: int) -> Row:
    """Grants to one certified console of the mesh."""
    with ExitStack() as stack:
        folder = state_folder(stack)
        peers = stack.enter_context(certified_mesh(folder))
        began, asked = grant_beside_spam(peers, folder / "arm-1", tries)
    evil = began.count(EVIL)
    good = sum(each.startswith(GOOD) for each in began)
    text = f"{evil} EVIL in {asked} tries, {good} GOOD"
    what = f"Zenoh mesh: {tries} grants to a certified console beside EVIL of another"
    return Row(what, text, "", None, MUST, not evil and good == tries)
