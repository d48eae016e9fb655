"""What a mesh peer answers to its own program."""

from __future__ import annotations

import pytest
from tests.mesh.peers import Fleet

from strands_robots.mesh import Mesh


def test_publish_of_a_peer_that_is_not_on_the_mesh_is_dropped(peers: Fleet, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG", "strands_robots.mesh.core")
    mesh = Mesh(None, "console", parts=peers.parts("console"))
    mesh.publish("strands/console/x", {"value": 1})
    mesh.start()
    mesh.stop()
    mesh.publish("strands/console/x", {"value": 1})
    assert caplog.messages.count("publish strands/console/x: console is not on the mesh.") == 2
    mesh.close()
