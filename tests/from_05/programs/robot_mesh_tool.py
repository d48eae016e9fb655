"""A script calls the agent's tool by itself: who is there, what do they say, stop them all."""

import time

from strands_robots import Robot
from strands_robots.tools.robot_mesh import robot_mesh

arm = Robot("so100", mesh=True, peer_id="arm-1")
time.sleep(2.0)
for call in (
    {"action": "peers"},
    {"action": "status"},
    {"action": "subscribe", "target": "strands/arm-1/state", "name": "states"},
    {"action": "inbox", "name": "states"},
    {"action": "unsubscribe", "target": "states"},
    {"action": "ping", "target": "arm-1"},
    {"action": "tell", "target": "arm-1", "instruction": "wave", "policy_provider": "mock"},
    {"action": "emergency_stop"},
):
    answer = robot_mesh(**call)
    assert set(answer) >= {"status", "content"}, answer
    print(call["action"], answer["status"], answer["content"][0]["text"].splitlines()[0])
arm.mesh.stop()
