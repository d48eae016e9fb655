"""Networks of a caller, and which of them are missed where they are not there."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.waiting import free_port

from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.profiles import networks_of


@pytest.fixture(autouse=True)
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without a mesh."""
    monkeypatch.setenv("STRANDS_MESH_PORT", str(free_port()))


@pytest.mark.parametrize(
    ("settings", "options", "missed"),
    [
        ({}, {}, False),
        ({}, {"mesh": True}, True),
        ({"STRANDS_MESH": "true"}, {}, True),
        ({"STRANDS_MESH_CONNECT": "tcp/192.0.2.1:7447"}, {}, True),
        ({"STRANDS_MESH_MULTICAST": "true"}, {}, True),
        ({"STRANDS_MESH_MULTICAST": "false"}, {}, False),
        ({"STRANDS_MESH": "false"}, {}, False),
        ({"STRANDS_MESH": "false"}, {"mesh": True}, True),
        ({"STRANDS_MESH_CONNECT": "tcp/192.0.2.1:7447"}, {"mesh": False}, False),
    ],
)
def test_mesh_is_missed_only_where_someone_asked_for_it(
    monkeypatch: pytest.MonkeyPatch, settings: dict[str, str], options: dict[str, Any], missed: bool
) -> None:
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    networks = networks_of(None, {}, "tester", stays=True, **options)
    networks.absent |= {DEVICE_CONNECT: "down", MESH: "down"}
    assert (MESH in networks.missing) is missed
    assert DEVICE_CONNECT in networks.missing
