"""A Reachy Mini looks up, moves its antennas, nods and reports its joints, as a Device Connect driver."""

import asyncio
import sys

from strands_robots import ReachyMiniDriver


async def main():
    driver = ReachyMiniDriver(host="127.0.0.1", prefix="reachy_mini", api_port=int(sys.argv[2]))
    await driver.connect()
    print("identity:", driver.identity.device_type)
    print("daemon:", (await driver.getDaemonStatus())["status"])
    print("look:", (await driver.look(pitch=10.0, yaw=-5.0))["status"])
    print("antennas:", (await driver.antennas(left=20.0, right=-20.0))["status"])
    print("nod:", (await driver.nod())["status"])
    print("joints:", (await driver.getJoints())["status"])
    print("stop:", (await driver.stopMotion())["status"])
    await driver.disconnect()


asyncio.run(main())
