"""A teleoperation here that others follow over the mesh."""

from __future__ import annotations

import time

from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.hardware import HardwareRobot
from strands_robots.mesh.input import InputReceiver, MeshInputSink
from strands_robots.teleoperators.leader import ScriptedLeader


def test_the_frames_of_a_local_leader_move_a_follower_elsewhere(peers: Fleet) -> None:
    peers.clock = time.time  # type: ignore[assignment]  # these peers live in real time
    here, there = HardwareRobot(RecordingDevice()), HardwareRobot(RecordingDevice())
    here.connect()
    there.connect()
    mesh = peers.join(here, "lead")
    follower = InputReceiver(peers.join(there, "follower"), there, "lead")
    follower.start()
    assert follower.start_refusal is None
    assert here.attach_teleop(ScriptedLeader({"pan.pos": (10.0, 5.0, 0.5)}))["status"] == "success"
    assert "no network" in here.teleoperate(publish=True)["reason"]
    here.input_sink = MeshInputSink(mesh)
    assert here.teleoperate(publish=True)["status"] == "success"
    eventually(lambda: follower.stats["frames_received"] > 20)
    assert here.stop_teleoperate()["status"] == "success"
    told = follower.stop()
    assert told["errors"] == 0
    assert told["out_of_order"] == 0
    written = [write.action["pan.pos"] for write in there.device.writes]
    assert len(set(written)) > 10
    assert all(5.0 <= value <= 15.0 for value in written)
    here.cleanup()
    there.cleanup()
