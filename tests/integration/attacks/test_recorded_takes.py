"""A take of an operator that was recorded takes the robot once, over every restart of its process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.child import Child
from fixtures.leased_robots import leased_robots
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually

from strands_robots.device_connect import FleetClient, LinkConfig
from strands_robots.safety import ed25519
from strands_robots.safety.resume import sign_take

KEY = Ed25519PrivateKey.generate()
RESTARTS = 5


class Site:
    """A robot in a process that can be killed and started again, and an operator beside a recorder."""

    def __init__(self, stack: ExitStack, state: Path) -> None:
        self._state, self._stack = state, stack
        self._server = stack.enter_context(NatsServer())
        link = LinkConfig(transport="nats", connect=(self._server.url,))
        self._operator = stack.enter_context(FleetClient(link, "operator"))
        self._robot = self._started()

    def restart(self) -> None:
        """Kill the robot's process and start it anew, with the same state directory."""
        self._robot.kill()
        self._robot = self._started()

    def call(self, verb: str, **arguments: Any) -> dict[str, Any]:
        """Return what the robot answers."""
        return dict(self._operator.call("arm-1", verb, arguments))

    def _started(self) -> Child:
        key = ed25519.encode(ed25519.public_half(KEY))
        variables = {
            "STRANDS_STATE_DIR": str(self._state),
            "STRANDS_MESH_RESUME_PUBLIC_KEY": key,
            "DEVICE_CONNECT_RPC_ALLOW": "*",
            "BYPASS_TOOL_CONSENT": "true",
        }
        child = self._stack.enter_context(leased_robots(self._server.url, {"arm-1": ""}, variables))
        eventually(self.reachable, what="the robot")
        return child

    def reachable(self) -> bool:
        """Return whether the robot answers."""
        try:
            return self.call("getControl")["status"] == "success"
        except Exception:  # noqa: BLE001 - it is not up yet
            return False


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    state = tmp_path / "state"
    state.mkdir(mode=0o700)
    with ExitStack() as stack:
        yield Site(stack, state)


def test_recorded_take_is_refused_after_each_of_five_restarts(site: Site) -> None:
    epoch = site.call("getControl")["epoch"]
    recorded = sign_take(KEY, "arm-1", epoch)
    assert site.call("takeControl", reason="wrong cup", assertion=recorded)["status"] == "success"
    assert site.call("takeControl", reason="again", assertion=recorded)["code"] == "not_proven"
    for _ in range(RESTARTS):
        site.restart()
        answer = site.call("takeControl", reason="again", assertion=recorded)
        assert (answer["status"], answer["code"]) == ("error", "not_proven")
        assert "names epoch" in answer["reason"]
        control = site.call("getControl")
        assert control["held"] is False
        assert control["epoch"] > epoch
        epoch = control["epoch"]
    fresh = sign_take(KEY, "arm-1", epoch)
    assert site.call("takeControl", reason="wrong cup", assertion=fresh)["status"] == "success"


def test_unused_take_of_a_process_that_was_killed_is_refused_by_the_next(site: Site) -> None:
    for _ in range(3):
        lease_id = site.call("acquireControl")["lease_id"]
        site.call("releaseControl", lease_id=lease_id)
    recorded = sign_take(KEY, "arm-1", site.call("getControl")["epoch"])
    site.restart()
    for _ in range(6):
        assert site.call("takeControl", reason="late", assertion=recorded)["code"] == "not_proven"
        site.call("releaseControl", lease_id=site.call("acquireControl")["lease_id"])
