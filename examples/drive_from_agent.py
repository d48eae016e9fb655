"""Drive a robot with an agent's tools: find it, start a motion, follow it, stop it.

Serve one in another terminal first::

    strands-robots serve so100

This side needs only Device Connect's own tools, which every agent framework can load.
With Strands: ``Agent(tools=[robot_mesh])`` from ``strands_robots.tools`` does the same with one tool.
"""

from __future__ import annotations

import os
import sys
import time

# The loopback port where local robots meet; on a network, name a server or a router instead.
os.environ.setdefault("ZENOH_CONNECT", f"tcp/127.0.0.1:{os.environ.get('STRANDS_DC_PORT', '7447')}")
os.environ.setdefault("DEVICE_CONNECT_DISCOVERY_MODE", "d2d")

from device_connect_agent_tools import connect, disconnect, discover_devices, invoke_device, subscribe


def main() -> int:
    connect(request_timeout=5.0)
    try:
        robots = [device for device in discover_devices() if "execute" in {f["name"] for f in device["functions"]}]
        if not robots:
            print("No robot answers. Start one: strands-robots serve so100")
            return 1
        robot = robots[0]["device_id"]
        print(f"Driving {robot}.")
        with subscribe(f"device({robot}).event(streamStep)") as steps:
            wanted = {"instruction": "wave", "duration": 10.0}
            print(invoke_device(robot, "execute", wanted)["result"]["content"][0]["text"])
            time.sleep(1.5)
            print(f"Saw {len(steps.read())} steps.")
        stopped = invoke_device(robot, "stop")["result"]
        print(stopped["content"][0]["text"])
        return 0 if stopped["status"] == "success" else 1
    finally:
        disconnect()


if __name__ == "__main__":
    sys.exit(main())
