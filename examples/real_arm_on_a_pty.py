"""The whole way of a real arm, without one: an agent drives an SO-101 whose servos are emulated, and a stop ends it.

``make real-arm`` makes the environment with LeRobot's own driver; then::

    .venv-lerobot/bin/python -m examples.real_arm_on_a_pty

agent (another process) -> Device Connect -> RobotDeviceDriver -> LeRobot's SO-101 driver -> serial bytes on a
pseudo-terminal -> six emulated STS3215 servos -> the arm in MuJoCo. With an arm on /dev/ttyACM0 the only difference is
the port. The picture shows the gripper's path, blue where it began and red where it was stopped.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from fixtures.feetech_bus import FeetechBus, arm_servos, write_calibration
from fixtures.feetech_bus.twin import ArmTwin

from strands_robots.device_connect import init_device_connect_sync, stop_device_connect
from strands_robots.device_connect.backends.config import usual_link
from strands_robots.robot import Robot
from strands_robots.simulation.rendering import Recording

PICTURE = Path(os.environ.get("PICTURE", "demo-output/real-arm.png"))
AGENT = Path(__file__).with_name("drive_from_agent.py")
TRACE_S = 0.04


def main() -> int:
    # This process is the operator's: it approves what an agent may do with the arm.
    os.environ.setdefault("DEVICE_CONNECT_RPC_ALLOW", "*,anonymous")
    os.environ.setdefault("STRANDS_ROBOT_COMMAND_ALLOW", "execute")
    # No policy is trained here: slow waves show the way of a command.
    os.environ.setdefault("STRANDS_ALLOW_MOCK", "true")
    twin = ArmTwin("so101")
    with tempfile.TemporaryDirectory() as folder, FeetechBus(arm_servos(), plant=twin) as bus:
        print(f"Six servos answer on {bus.port}.")
        calibration = write_calibration(Path(folder) / "calibration.json")
        arm = Robot("so101", mode="real", port=bus.port, calibration=calibration, calibration_dir=folder)
        runtime = init_device_connect_sync(arm, peer_id="so101-bench", link=usual_link())
        recording = Recording(twin.world)
        agent = subprocess.Popen([sys.executable, AGENT])
        try:
            while agent.poll() is None:
                bus.shafts()
                recording.trace()
                time.sleep(TRACE_S)
            ended = time.monotonic()
            time.sleep(0.3)
            late = [write for write in bus.writes if write.at > ended]
            print(f"{len(bus.writes)} register writes reached the servos, {len(late)} after the agent's stop.")
            print(f"The joints: {arm.get_state()['joints']}")
            print(f"The path of the gripper: {recording.save_picture(PICTURE)}")
        finally:
            agent.kill()
            code = agent.wait()
            stop_device_connect(runtime)
            arm.cleanup()
            twin.close()
        return 1 if code or late else 0


if __name__ == "__main__":
    sys.exit(main())
