"""An arm is served on Device Connect, and an agent's functions find it, ask it, move it and stop it."""

import os
import time

os.environ["DEVICE_CONNECT_ALLOW_INSECURE"] = "true"
os.environ["DEVICE_CONNECT_RPC_ALLOW"] = "my-agent"

from strands_robots import Robot
from strands_robots.device_connect import init_device_connect_sync

arm = Robot("so100", peer_id="arm-1")
runtime = init_device_connect_sync(arm, peer_id="arm-1", peer_type="sim", allow_insecure=True)

from device_connect_agent_tools import connect, discover, invoke  # noqa: E402 - once there is a device

connect()
found = discover("device(*)")
deadline = time.time() + 20
while not found["results"] and time.time() < deadline:
    time.sleep(0.2)
    found = discover("device(*)")
print("found:", [each["device_id"] for each in found["results"]])
print("status:", invoke("device(arm-1).function(getStatus)")["success"])
moved = invoke("device(arm-1).function(execute)", {"instruction": "wave", "policy_provider": "mock", "duration": 5.0})
print("moved:", moved["success"])
print("stopped:", invoke("device(arm-1).function(stop)")["success"])
os._exit(0)
