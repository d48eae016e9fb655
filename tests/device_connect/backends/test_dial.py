"""Why an endpoint is silent: a reason for each, within its time."""

from __future__ import annotations

import threading
from typing import Any

import pytest
import zenoh
from device_connect_edge.messaging.exceptions import MessagingConnectionError

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.backends import zenoh as backend
from strands_robots.device_connect.backends import zenoh as zenoh_backend
from strands_robots.device_connect.backends.dial import endpoint_problem
from strands_robots.device_connect.backends.zenoh import ZenohBackend

LINK = LinkConfig(mode="client", connect=("tcp/127.0.0.1:7447",), multicast=False)


@pytest.mark.parametrize("endpoint", [f"tcp/{'a' * 64}.example:7447", "tcp/a..example:7447"])
def test_host_that_is_no_name_is_a_reason(endpoint: str) -> None:
    assert endpoint_problem(LINK, endpoint) == "its host or port cannot be read"


async def test_look_up_that_hangs_holds_no_connect_back(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = threading.Event()

    def refused(_link: LinkConfig) -> Any:
        raise zenoh.ZError("unable to connect")

    def hangs(_link: LinkConfig) -> str:
        ended.wait(20.0)
        return "too late"

    monkeypatch.setattr(zenoh_backend, "acquire", refused)
    monkeypatch.setattr(backend, "why_silent", hangs)
    monkeypatch.setattr(backend, "WHY_S", 0.05)
    try:
        with pytest.raises(MessagingConnectionError, match="no answer in time"):
            await ZenohBackend(LINK).connect(servers=[])
    finally:
        ended.set()
