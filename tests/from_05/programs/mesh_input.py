"""A leader device publishes its joints, and a simulated arm on the same mesh follows them."""

import time

from strands_robots import Robot
from strands_robots.mesh import InputPublisher, InputReceiver, init_mesh


class Slider:
    """A teleoperator of one joint."""

    def __init__(self):
        self.reads = 0

    def get_action(self):
        self.reads += 1
        return {"shoulder_pan.pos": 0.001 * self.reads}


follower = Robot("so100", mesh=True, peer_id="arm-1")
leader = init_mesh(None, peer_id="leader-1")
assert leader is not None
deadline = time.time() + 20
while follower.mesh.get_peer("leader-1") is None and time.time() < deadline:
    time.sleep(0.1)

publisher = InputPublisher(leader, Slider(), device_name="leader", method="arm", hz=30.0)
receiver = InputReceiver(follower.mesh, follower, "leader-1", device_name="leader")
publisher.start()
receiver.start()
print("refused:", receiver.start_refusal)
while receiver.stats["frames_received"] < 10 and time.time() < deadline:
    time.sleep(0.1)
print("topic:", publisher.topic == receiver.topic, "frames:", receiver.stats["frames_received"] >= 10)
receiver.stop()
print("published:", publisher.stop()["frames"] > 0)
leader.stop()
follower.mesh.stop()
