"""The same arms and the same hand on the bare framework: ``python -m benchmarks.safety_bare ORDER``.

The order: ``backend``, ``urls``, ``tenant``, ``id`` and ``robots``, without which it is the controller, and ``hz``.
The verbs are those of :mod:`fixtures.stop_robots` and :mod:`fixtures.stop_controller`, as far as there are such.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import resource
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any

from device_connect_edge import DeviceRuntime
from device_connect_edge.drivers import DeviceDriver, emit, on, rpc
from fixtures.child import serve
from fixtures.moving_arm import BusyThreads, MovingArm
from fixtures.stop_controller import at_hz
from fixtures.waiting import eventually


class BareArm(DeviceDriver):  # type: ignore[misc]  # the framework has no type information
    """An arm as the framework's own examples would write it: the stop is one of its events."""

    device_type = "bare_arm"

    def __init__(self, arm: MovingArm) -> None:
        super().__init__()
        self.arm = arm

    @rpc()  # type: ignore[untyped-decorator]
    async def slow(self) -> dict[str, Any]:
        """Take as long as the benchmark says."""
        await asyncio.sleep(self.arm.read_s)
        return {}

    @on(event_name="emergencyStop")  # type: ignore[untyped-decorator]
    async def onEmergencyStop(self, device_id: str, event_name: str, payload: dict[str, Any]) -> None:
        """Halt."""
        self.arm.halt()


class BareHand(DeviceDriver):  # type: ignore[misc]  # the framework has no type information
    """A device that calls, emits telemetry and stops."""

    device_type = "bare_hand"

    @emit()  # type: ignore[untyped-decorator]
    async def tick(self, n: int = 0) -> None:
        """Telemetry.

        Args:
            n: its number
        """

    @emit()  # type: ignore[untyped-decorator]
    async def emergencyStop(self, reason: str = "") -> None:
        """Stop.

        Args:
            reason: why
        """


class Bare:
    """The runtimes of one process on one event loop, and the verbs of both roles."""

    def __init__(self, order: Mapping[str, Any]) -> None:
        self.arms = {name: MovingArm(name, order["hz"]) for name in order["robots"]}
        self.hand = BareHand()
        self._busy = BusyThreads()
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        drivers = {name: BareArm(arm) for name, arm in self.arms.items()} or {order["id"]: self.hand}
        asyncio.run_coroutine_threadsafe(self._start(order, drivers), self._loop).result(60)

    async def _start(self, order: Mapping[str, Any], drivers: Mapping[str, DeviceDriver]) -> None:
        self._tasks = []
        for name, driver in drivers.items():
            quiet = logging.getLogger(f"device_connect_edge.device.{name}")
            quiet.addHandler(logging.NullHandler())
            runtime = DeviceRuntime(
                driver=driver,
                device_id=name,
                tenant=order["tenant"],
                messaging_backend=order["backend"],
                messaging_urls=order["urls"] or None,
                allow_insecure=True,
            )
            self._tasks.append(asyncio.create_task(runtime.run()))
            await asyncio.sleep(0.1)
        await asyncio.sleep(1.5)

    def move(self) -> None:
        before = {name: arm.writes for name, arm in self.arms.items()}
        for arm in self.arms.values():
            arm.start_task("move", duration=600)
        eventually(lambda: all(arm.writes > before[name] for name, arm in self.arms.items()), what="every arm moves")

    def facts(self) -> dict[str, Any]:
        return {name: arm.facts() for name, arm in self.arms.items()}

    def halt(self) -> None:
        for arm in self.arms.values():
            arm.halt()

    def block(self, seconds: float, times: int = 1) -> None:
        held = threading.Event()
        self._loop.call_soon_threadsafe(held.set)
        for _ in range(times):
            self._loop.call_soon_threadsafe(time.sleep, seconds)
        held.wait(10)

    def slow_reads(self, seconds: float) -> None:
        for arm in self.arms.values():
            arm.read_s = seconds

    def wedge(self, name: str, seconds: float) -> None:
        self.arms[name].wedge(seconds)

    def busy(self, count: int) -> None:
        if count:
            self._busy.start(count)
        else:
            self._busy.stop()

    def stop(self, expected: list[str], deadline_s: float = 3.0) -> dict[str, Any]:
        began = time.monotonic()
        asyncio.run_coroutine_threadsafe(self.hand.emergencyStop(reason="bench"), self._loop)
        return {"at": began}

    def slow_calls(self, devices: list[str]) -> None:
        async def call(name: str) -> None:
            await self.hand.invoke_remote(name, "slow")

        for name in devices:
            asyncio.run_coroutine_threadsafe(call(name), self._loop)

    def telemetry(self, hz: float, seconds: float) -> None:
        def tell(number: int) -> None:
            asyncio.run_coroutine_threadsafe(self.hand.tick(n=number), self._loop)

        at_hz(tell, hz, seconds)


def _main(order: Mapping[str, Any]) -> None:
    logging.disable(logging.CRITICAL)
    # A fleet of bare Zenoh peers is a full mesh of links.
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(16384, hard) if hard > 0 else 16384, hard))
    bare = Bare(order)
    verbs = ("move", "facts", "halt", "block", "slow_reads", "wedge", "busy", "stop", "slow_calls", "telemetry")
    serve({verb: getattr(bare, verb) for verb in verbs})
    os._exit(0)


if __name__ == "__main__":
    _main(json.loads(sys.argv[1]))
