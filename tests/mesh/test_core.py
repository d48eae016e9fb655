"""What a mesh peer answers to its own program."""

from __future__ import annotations

import json

import pytest
from fixtures.waiting import eventually
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


def test_safety_event_of_a_program_is_recorded_and_published_without_its_severity(peers: Fleet) -> None:
    mesh, received = peers.join(None, "arm-1"), []
    peers.stranger().declare_subscriber("strands/arm-1/safety/event", lambda sample: received.append(sample.payload))
    mesh.publish_safety_event("limit_reached", "critical", {"joint": "pan", "event": "limit", "severity": "mild"})
    eventually(lambda: received, what="the event")
    event = json.loads(received[0])
    assert (event["type"], event["severity"], event["payload"]["joint"]) == ("limit_reached", "info", "pan")
    assert peers.events("limit_reached") == [{"joint": "pan", "event": "limit", "severity": "critical"}]
    mesh.stop()
    mesh.publish_safety_event("limit_reached")
    assert len(peers.events("limit_reached")) == 1


def test_safety_event_without_a_name_is_refused(peers: Fleet) -> None:
    mesh = peers.join(None, "arm-1")
    with pytest.raises(ValueError, match="event_type must be text"):
        mesh.publish_safety_event("")
