"""A developer wraps a robot of their own in Device Connect's driver and calls its functions in a test."""

import asyncio

from strands_robots.device_connect import RobotDeviceDriver


class Turntable:
    """A robot with the methods that 0.5 asked for, and no more."""

    tool_name_str = "turntable"

    def __init__(self):
        self.turning = False

    def start_task(self, instruction, policy_port=None, policy_host="localhost", policy_provider="mock", duration=30.0):
        self.turning = True
        return {"status": "success", "content": [{"text": f"turning: {instruction}"}]}

    def stop_task(self):
        self.turning = False
        return {"status": "success", "content": [{"text": "still"}]}

    def get_task_status(self):
        return {"status": "success", "content": [{"text": "turning" if self.turning else "still"}]}


async def main():
    driver = RobotDeviceDriver(Turntable())
    print("identity:", driver.identity.device_type, driver.identity.model)
    print("availability:", driver.status.availability)
    await driver.connect()
    print("status:", (await driver.getStatus())["status"])
    print("stop:", (await driver.stop())["status"])
    print("features:", sorted(await driver.getFeatures()))
    await driver.disconnect()


asyncio.run(main())
