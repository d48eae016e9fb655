"""A console without a robot pings an arm, asks it for its state, tells it what to do and tells everybody to stop."""

import time

from strands_robots import Robot
from strands_robots.mesh import get_local_robots, init_mesh

arm = Robot("so100", mesh=True, peer_id="arm-1")
console = init_mesh(None, peer_id="console", peer_type="console")
assert console is not None
deadline = time.time() + 20
while console.get_peer("arm-1") is None and time.time() < deadline:
    time.sleep(0.1)

print("local:", sorted(get_local_robots()))
print("ping:", console.ping("arm-1", timeout=5.0)["status"])
print("state:", sorted(console.send("arm-1", {"action": "state"}, timeout=10.0)["result"]))
told = console.tell("arm-1", "wave at the visitor", policy_provider="mock", duration=1.0)
print("told:", told["type"], told["result"]["status"])
moving = console.send("arm-1", {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 30.0})
print("moving:", moving["result"]["status"])
for answer in console.broadcast({"action": "stop"}, timeout=3.0):
    print("stopped:", answer["responder_id"], answer["result"].get("ok", answer["result"].get("status")))
console.stop()
arm.mesh.stop()
