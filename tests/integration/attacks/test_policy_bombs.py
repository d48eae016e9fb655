"""A policy server that answers with megabytes of nothing: its robot is stopped, and the process stays small."""

from __future__ import annotations

import time

import pytest
from fixtures.hostile_policy_server import hostile
from fixtures.policy_site import policy_site
from fixtures.waiting import eventually

MEMORY_MAX_MB = 100
KINDS = ("openpi", "remote", "remote msgpack", "groot")


# The long variants run with `make test-all`.
@pytest.mark.parametrize("kind", [KINDS[0], *(pytest.param(kind, marks=pytest.mark.system) for kind in KINDS[1:])])
def test_robots_are_stopped_and_memory_stays_while_a_policy_server_sends_bombs(
    kind: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    state = str(tmp_path_factory.mktemp("state"))
    with (
        hostile(kind) as server,
        policy_site(["arm-1"], kind, server.ask("port"), STRANDS_STATE_DIR=state) as site,
    ):
        before = site.ask("peak_mb")
        site.ask("attack")

        def all_sent() -> bool:
            site.ask("clear")
            site.ask("move")
            assert all(stopped is True for stopped, _ in site.ask("stop"))
            facts = site.ask("facts")
            assert facts["arm-1"]["locked"]
            assert not facts["arm-1"]["moving"]
            site.ask("clear")
            sent = server.ask("sent")
            # A robot that is locked asks nothing, so every round leaves it some time.
            time.sleep(0.3)
            return all(sent.values())

        eventually(all_sent, 90.0, "every bomb")
        errors = site.ask("errors")
        assert site.ask("tries") > 0, errors
        assert any("cannot be read: it has" in text or "unreadable answer: it has" in text for text in errors), errors
        assert all(len(text) < 600 for text in errors), errors
        assert site.ask("peak_mb") - before <= MEMORY_MAX_MB
