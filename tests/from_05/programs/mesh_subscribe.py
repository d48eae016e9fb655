"""A monitor listens to an arm's states, in a callback and in its inbox, and publishes a note of its own."""

import time

from strands_robots import Robot
from strands_robots.mesh import init_mesh, put

heard = []
arm = Robot("so100", mesh=True, peer_id="arm-1")
monitor = init_mesh(None, peer_id="monitor")
assert monitor is not None
name = monitor.subscribe("strands/arm-1/state", lambda topic, data: heard.append((topic, data)))
box = monitor.subscribe("strands/*/presence", name="who")
monitor.on_stream("arm-1")

deadline = time.time() + 20
while not (heard and monitor.inbox.get("who")) and time.time() < deadline:
    time.sleep(0.1)
topic, state = heard[0]
print("state:", topic, sorted(state))
for topic, data in monitor.inbox["who"][-2:]:
    print("presence:", topic, data["robot_id"])
monitor.publish("strands/monitor/note", {"text": "all is well"})
put("strands/monitor/note", {"text": "all is still well"})
monitor.unsubscribe(name)
monitor.unsubscribe(box)
monitor.stop()
arm.mesh.stop()
