"""Drive a robot with an agent's tools: find it, start a motion, follow it, stop it.

Serve one in another terminal first::

    strands-robots serve so100

This side needs only Device Connect's own tools, which every agent framework can load.
With Strands: ``Agent(tools=[robot_mesh])`` from ``strands_robots.tools`` does the same with one tool.
"""

from __future__ import annotations

import sys
import time

from device_connect_agent_tools import disconnect, discover, invoke, subscribe

from strands_robots.device_connect import connect_agent


def main() -> int:
    # On this machine, unless the environment names a network: a NATS server or a Zenoh router.
    connect_agent(request_timeout=5.0)
    try:
        robots = discover("device(*).function(execute)")["results"]
        if not robots:
            print("No robot answers. Start one: strands-robots serve so100")
            return 1
        robot = robots[0]["device_id"]
        print(f"Driving {robot}.")
        with subscribe(f"device({robot}).event(streamStep)") as steps:
            wanted = {"instruction": "wave", "duration": 10.0}
            print(invoke(f"device({robot}).function(execute)", wanted)["result"]["content"][0]["text"])
            time.sleep(1.5)
            print(f"Saw {len(steps.read())} steps.")
        stopped = invoke(f"device({robot}).function(stop)")["result"]
        print(stopped["content"][0]["text"])
        return 0 if stopped["status"] == "success" else 1
    finally:
        disconnect()


if __name__ == "__main__":
    sys.exit(main())
